"""What waits for a stream: of one topic, and of many."""

from __future__ import annotations

import asyncio

import pytest

from shmio.endpoints.grpc import load
from shmio.endpoints.grpc import outbox as module
from shmio.endpoints.grpc.outbox import TOPIC_BOUND, EventLane, Outbox, Outboxes, StateLane


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
    monkeypatch.setattr(load if bound == "BOUND_BYTES" else module, bound, count)

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
    monkeypatch.setattr(load, "BOUND_BYTES", 10)

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
        assert outbox.failure.startswith("cell/x/in: 1 messages wait to be read")
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
    monkeypatch.setattr(load, "TOTAL_BYTES", 100)
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
        assert slow.failure.startswith("cell/x/in: 3 messages wait to be read")
    assert outboxes.waiting_bytes == 0
    assert outboxes.dropped == hog.dropped + slow.dropped
