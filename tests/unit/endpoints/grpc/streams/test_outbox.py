"""What waits for a stream: of one topic, and of many."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from types import SimpleNamespace

import pytest

from shmio.endpoints.grpc.streams import back_pressure
from shmio.endpoints.grpc.streams import outbox as module
from shmio.endpoints.grpc.streams.outbox import TOPIC_BOUND, EventLane, Outbox, Outboxes, StateLane


async def rest(outbox: Outbox) -> list[bytes]:
    """All that still waits."""
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


def test_one_that_is_far_behind_is_given_no_value_that_has_waited_as_long_as_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def test() -> None:
        outbox, now_s = Outbox(), 100.0
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s))
        lane, other = StateLane(outbox), StateLane(outbox)

        async def offered() -> list[bytes]:
            """What is left of four values, of which two come at once."""
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
        assert await offered() == [b"a", b"b", b"c", b"d"], "it is tried again"
        now_s += back_pressure.WINDOW_S
        assert await offered() == [b"a", b"b", b"c", b"d"], "it has lost none"

    asyncio.run(test())


def test_of_values_that_come_at_once_it_is_given_those_that_are_not_older_than_that() -> None:
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
def test_when_too_much_waits_in_all_each_topic_has_its_newest_value(
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


def test_events_wait_all_or_the_stream_ends(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_what_was_dropped_is_counted_also_of_streams_that_are_over() -> None:
    outboxes = Outboxes()
    with outboxes.opened() as one:
        lane = StateLane(one)
        lane.deliver(b"x")
        lane.lose()
        assert (len(outboxes), outboxes.dropped) == (1, 1)
    assert (len(outboxes), outboxes.dropped) == (0, 1)


def test_when_all_streams_hold_too_much_those_with_more_than_their_part_give_way(
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


def test_behind_its_end_it_begins_anew() -> None:
    async def test() -> None:
        outbox = Outbox()
        outbox.end()
        assert await outbox.pop() is None
        busy = [outbox.busy]
        popped = asyncio.ensure_future(outbox.pop())
        await asyncio.sleep(0)
        busy.append(outbox.busy)
        assert busy == [True, False], "busy while nobody waits for a message"
        assert not popped.done()
        StateLane(outbox).deliver(b"x")
        assert await popped == b"x"

    asyncio.run(test())


def test_of_its_failure_is_told_once_and_not_at_once() -> None:
    """Whoever is told may change what is just being gone through."""

    async def test() -> None:
        outbox, told = Outbox(), list[str]()
        outbox.on_failure = lambda: told.append(outbox.failure)
        outbox.fail("too slow")
        outbox.fail("too late")
        assert told == []
        await asyncio.sleep(0)
        assert told == ["too slow"]

    asyncio.run(test())


def test_values_of_a_step_are_all_kept_or_the_stream_ends(monkeypatch: pytest.MonkeyPatch) -> None:
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
        assert not outbox.owing

    asyncio.run(test())


def test_values_of_a_step_have_a_bound_in_bytes_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "STEP_BOUND_BYTES", 100)

    async def test() -> None:
        outbox = Outbox()
        lane = StateLane(outbox)
        lane.keep(bytes(101))  # a single one always has room
        assert await rest(outbox) == [bytes(101)]
        lane.keep(bytes(60))
        lane.keep(bytes(40))
        assert outbox.failure == ""
        lane.keep(b"1")
        assert outbox.failure == "2 values are waiting: too many values change in one step for this stream"

    asyncio.run(test())


def test_a_message_is_taken_when_the_reader_asks_for_the_next_one() -> None:
    async def test() -> None:
        outbox = Outbox()
        lane = StateLane(outbox)
        lane.deliver(b"before")
        lane.keep(b"a")
        lane.deliver(b"after")
        taken = asyncio.ensure_future(outbox.taken())
        for expected in (b"before", b"a"):
            assert await outbox.pop() == expected
            await asyncio.sleep(0)
            assert outbox.owing
            assert not taken.done()
        assert await outbox.pop() == b"after"
        await taken
        assert not outbox.owing

    asyncio.run(test())


def test_those_that_take_nothing_end_and_the_others_do_not() -> None:
    async def test() -> None:
        outboxes = Outboxes()
        with ExitStack() as stack:
            idle, reader, gone, none = (stack.enter_context(outboxes.opened()) for _ in range(4))
            for outbox in (idle, reader, gone):
                StateLane(outbox).keep(b"x")
            StateLane(none).deliver(b"of a device")
            waiting = asyncio.ensure_future(outboxes.taken(0.05))
            await asyncio.sleep(0)
            assert await reader.pop() == b"x"
            popping = asyncio.ensure_future(reader.pop())
            gone.close()
            await waiting
            assert idle.failure == "the client has not taken the values of a step within 0.05 s"
            assert (reader.failure, gone.failure, none.failure) == ("", "", "")
            await outboxes.taken(60)  # nobody owes anything
            popping.cancel()

    asyncio.run(test())
