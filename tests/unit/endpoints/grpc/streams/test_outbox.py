"""Messages that wait for a stream: of one topic, and of many."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

from shmio.endpoints.grpc.streams import back_pressure
from shmio.endpoints.grpc.streams import outbox as module
from shmio.endpoints.grpc.streams.outbox import TOPIC_BOUND, EventLane, Outbox, Outboxes, StateLane


async def rest(outbox: Outbox) -> list[bytes]:
    """End the outbox and return all messages that still wait."""
    outbox.end()
    found = []
    while (message := await outbox.pop()) is not None:
        found.append(message)
    return found


def test_a_slow_reader_gets_the_newest_value_and_the_loss_is_counted() -> None:
    async def test() -> None:
        outbox = Outbox()
        lane = StateLane(outbox)
        for number in range(TOPIC_BOUND):
            lane.deliver(bytes([number]))
        assert [await outbox.pop() for _ in range(TOPIC_BOUND)] == [bytes([n]) for n in range(TOPIC_BOUND)]
        assert outbox.dropped == 0
        for number in range(TOPIC_BOUND + 1):
            lane.deliver(bytes([number]))
        assert await outbox.pop() == bytes([TOPIC_BOUND])
        assert outbox.dropped == TOPIC_BOUND
        popped = asyncio.ensure_future(outbox.pop())
        await asyncio.sleep(0)
        lane.deliver(b"x")
        assert await popped == b"x"

    asyncio.run(test())


def test_a_stream_far_behind_gets_no_old_values(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def test() -> None:
        outbox, now_s = Outbox(), 100.0
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s))
        lane, other = StateLane(outbox), StateLane(outbox)

        async def offered() -> list[bytes]:
            """Offer four values, two of them at once, and return the messages that are left."""
            nonlocal now_s
            for letter in (b"a", b"b", b"c"):
                lane.deliver(letter)
                now_s += 1.5 * back_pressure.LATE_S if letter != b"b" else 0
            other.deliver(b"d")
            return await rest(outbox)

        assert await offered() == [b"a", b"b", b"c", b"d"]
        for number in range(3 * TOPIC_BOUND):
            lane.deliver(bytes([number]))
        await rest(outbox)
        now_s += back_pressure.WINDOW_S
        assert await offered() == [b"b", b"c", b"d"]
        now_s += back_pressure.BEHIND_S
        assert await offered() == [b"a", b"b", b"c", b"d"], "it is retried"
        now_s += back_pressure.WINDOW_S
        assert await offered() == [b"a", b"b", b"c", b"d"], "it has lost none, so it is no longer behind"

    asyncio.run(test())


def test_of_values_that_come_at_once_a_stream_far_behind_gets_the_recent_ones() -> None:
    async def test() -> None:
        outbox = Outbox()
        lane = StateLane(outbox)
        for behind, left in ((False, [b"a", b"b", b"c"]), (True, [b"b", b"c"])):
            outbox.losses.behind = behind
            for letter, at_s in (
                (b"a", 7.0),
                (b"b", 7.0 + back_pressure.LATE_S),
                (b"c", 7.0 + 1.5 * back_pressure.LATE_S),
            ):
                lane.deliver(letter, at_s)
                outbox.losses.behind = behind
            assert await rest(outbox) == left

    asyncio.run(test())


def test_topics_share_a_stream_in_the_order_of_their_values() -> None:
    async def test() -> None:
        outbox = Outbox()
        first, second = StateLane(outbox, lambda message: b"1" + message), EventLane(outbox, "", lambda m: b"2" + m)
        for letter in (b"a", b"b", b"c"):
            first.deliver(letter)
            second.deliver(letter)
        assert await outbox.pop() == b"1a"
        first.lose()
        first.deliver(b"d")
        assert await rest(outbox) == [b"2a", b"2b", b"2c", b"1d"]
        assert outbox.dropped == 2

    asyncio.run(test())


@pytest.mark.parametrize(("bound", "count"), [("STATE_BOUND", 6), ("BOUND_BYTES", 60)])
def test_beyond_the_streams_bound_each_topic_keeps_its_newest_value(
    monkeypatch: pytest.MonkeyPatch, bound: str, count: int
) -> None:
    monkeypatch.setattr(back_pressure if bound == "BOUND_BYTES" else module, bound, count)

    async def test() -> None:
        outbox = Outbox()
        lanes = [StateLane(outbox) for _ in range(4)]
        for number in range(20):
            for lane in lanes:
                lane.deliver(b"%10d" % number)
        assert outbox.states.count <= 6
        assert outbox.states.size == 10 * outbox.states.count
        kept = [int(message) for message in await rest(outbox)]
        assert kept == sorted(kept)
        assert kept[-4:] == [19] * 4
        assert outbox.dropped == 80 - len(kept)
        assert (outbox.states.count, outbox.states.size) == (0, 0)

    asyncio.run(test())


def test_all_events_are_queued_or_the_stream_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "EVENT_BOUND", 3)
    monkeypatch.setattr(back_pressure, "BOUND_BYTES", 10)

    async def test() -> None:
        outbox = Outbox()
        lane = EventLane(outbox, "cell/x/in")
        for text in (b"much longer than that", b""):
            lane.deliver(text)
            assert await outbox.pop() == text
        for number in range(3):
            lane.deliver(bytes([number]))
        assert [await outbox.pop() for _ in range(3)] == [b"\x00", b"\x01", b"\x02"]
        assert (outbox.failure, outbox.dropped) == ("", 0)
        lane.deliver(b"123456")
        lane.deliver(b"12345")
        StateLane(outbox).deliver(b"too late")
        assert await outbox.pop() is None
        assert outbox.failure.startswith("cell/x/in: 1 messages are waiting")
        assert outbox.dropped == 3
        many = Outbox()
        lane = EventLane(many, "")
        for _ in range(5):
            lane.deliver(b"")
        assert await many.pop() is None
        assert many.dropped == 5

    asyncio.run(test())


def test_dropped_values_of_ended_streams_are_still_counted() -> None:
    outboxes = Outboxes()
    with outboxes.opened() as one:
        lane = StateLane(one)
        lane.deliver(b"x")
        lane.lose()
        assert (len(outboxes), outboxes.dropped) == (1, 1)
    assert (len(outboxes), outboxes.dropped) == (0, 1)


def test_beyond_the_total_bound_streams_above_their_share_drop_values(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(back_pressure, "TOTAL_BYTES", 100)
    outboxes = Outboxes()
    with outboxes.opened() as hog, outboxes.opened() as modest, outboxes.opened() as slow:
        hogging, small, events = StateLane(hog), StateLane(modest), EventLane(slow, "cell/x/in")
        for _ in range(10):
            hogging.deliver(bytes(20))
            assert outboxes.waiting_bytes <= 120
        assert hog.dropped == 6
        for _ in range(3):
            small.deliver(bytes(10))
        assert (modest.dropped, modest.states.count) == (0, 3)
        for _ in range(4):
            events.deliver(bytes(10))
        assert slow.failure.startswith("cell/x/in: 3 messages are waiting")
    assert outboxes.waiting_bytes == 0
    assert outboxes.dropped == hog.dropped + slow.dropped


def test_an_ended_outbox_can_be_used_again() -> None:
    async def test() -> None:
        outbox = Outbox()
        outbox.end()
        assert await outbox.pop() is None
        busy = [outbox.busy]
        popped = asyncio.ensure_future(outbox.pop())
        await asyncio.sleep(0)
        busy.append(outbox.busy)
        assert busy == [True, False], "busy until a reader waits for a message"
        assert not popped.done()
        StateLane(outbox).deliver(b"x")
        assert await popped == b"x"

    asyncio.run(test())


def test_a_failure_is_reported_once_in_a_later_turn() -> None:
    """The callback must not run at once, because it may change collections that the caller is iterating over."""

    async def test() -> None:
        outbox, told = Outbox(), list[str]()
        outbox.on_failure = lambda: told.append(outbox.failure)
        outbox.fail("too slow")
        outbox.fail("too late")
        assert told == []
        await asyncio.sleep(0)
        assert told == ["too slow"]

    asyncio.run(test())


def test_all_values_of_a_step_are_queued_or_the_stream_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "STEP_BOUND", TOPIC_BOUND + 5)

    async def test() -> None:
        outbox = Outbox()
        lane, other = StateLane(outbox), StateLane(outbox)
        for number in range(TOPIC_BOUND + 5):
            (lane if number % 50 else other).keep(bytes([number]))
        assert await rest(outbox) == [bytes([number]) for number in range(TOPIC_BOUND + 5)]
        assert (outbox.failure, outbox.dropped) == ("", 0)
        for number in range(TOPIC_BOUND + 6):
            lane.keep(bytes([number]))
        assert await outbox.pop() is None
        assert (
            outbox.failure
            == f"{TOPIC_BOUND + 5} values are waiting: too many values change in one step for this stream"
        )
        assert not outbox.delivery_pending

    asyncio.run(test())


def test_values_of_a_step_are_limited_in_bytes_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "STEP_BOUND_BYTES", 100)

    async def test() -> None:
        outbox = Outbox()
        lane = StateLane(outbox)
        lane.keep(bytes(101))  # a single value always fits
        assert await rest(outbox) == [bytes(101)]
        lane.keep(bytes(60))
        lane.keep(bytes(40))
        assert outbox.failure == ""
        lane.keep(b"1")
        assert outbox.failure == "2 values are waiting: too many values change in one step for this stream"

    asyncio.run(test())


def test_a_message_counts_as_taken_when_the_reader_asks_for_the_next() -> None:
    async def test() -> None:
        outbox = Outbox()
        lane = StateLane(outbox)
        lane.deliver(b"before")
        lane.keep(b"a")
        lane.deliver(b"after")
        taken: list[object] = []
        outbox.on_taken = taken.append
        for expected in (b"before", b"a"):
            assert await outbox.pop() == expected
            assert outbox.delivery_pending
            assert not taken
        assert await outbox.pop() == b"after"
        assert taken == [outbox]
        assert not outbox.delivery_pending

    asyncio.run(test())
