"""The delivery of a step to the streams of all services."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import ExitStack
from typing import Any, Final

import pytest

from shmio.endpoints.grpc.streams.feed import VirtualTime
from shmio.endpoints.grpc.streams.outbox import Outboxes, StateLane, StepStream
from shmio.endpoints.grpc.time import delivery as module
from shmio.endpoints.grpc.time.delivery import Delivery
from shmio.local.time_control import Step

PATIENCE_S: Final = 20.0


def run(test: Coroutine[Any, Any, None]) -> None:
    """Run a test, which fails if it hangs."""
    asyncio.run(asyncio.wait_for(test, PATIENCE_S))


class Receiver:
    """A service with one stream."""

    streams = 1

    def __init__(self) -> None:
        self.steps: list[int] = []
        self.on_taken: Callable[[StepStream], object] | None = None
        self.reason = ""

    def deliver(self, step: Step) -> list[StepStream]:
        self.steps.append(step.number)
        return [self]

    def release(self) -> None: ...

    def give_up(self, reason: str) -> None:
        self.reason = reason
        self.take()

    def take(self) -> None:
        assert self.on_taken is not None
        self.on_taken(self)


def test_each_stage_waits_for_the_streams_and_the_caller_may_be_gone() -> None:
    async def test() -> None:
        outboxes, receiver, marked, ended = Outboxes(), Receiver(), list[int](), list[bool]()
        time = VirtualTime()
        delivery = Delivery(time, {}, outboxes, lambda: ended.append(delivery.busy))
        delivery.receivers.append(receiver)
        with outboxes.opened() as outbox:
            lane = StateLane(outbox)

            def mark() -> None:
                marked.append(1)
                lane.keep(b"marker")

            lane.keep(b"value")
            delivery.begin(Step(1, 50, 50), mark)
            assert time.moment == (1, 50)
            caller = asyncio.ensure_future(delivery.over())
            await asyncio.sleep(0)
            assert await outbox.pop() == b"value"
            assert receiver.steps == []
            popping = asyncio.ensure_future(outbox.pop())
            await asyncio.sleep(0)
            assert (receiver.steps, marked) == ([1], [])
            caller.cancel()
            receiver.take()
            assert (await popping, marked, delivery.busy) == (b"marker", [1], True)
            other = asyncio.ensure_future(delivery.over())
            popping = asyncio.ensure_future(outbox.pop())
            await other
            assert ended == [False]
            popping.cancel()

    run(test())


def test_streams_that_take_nothing_end_and_others_continue(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PATIENCE_S", 0.05)

    async def test() -> None:
        outboxes, receiver = Outboxes(), Receiver()
        delivery = Delivery(VirtualTime(), {}, outboxes, lambda: None)
        delivery.receivers.append(receiver)
        with ExitStack() as stack:
            idle, reader, gone, none = (stack.enter_context(outboxes.opened()) for _ in range(4))
            for outbox in (idle, reader, gone):
                StateLane(outbox).keep(b"x")
            StateLane(none).deliver(b"of a device")
            delivery.begin(Step(1, 50, 50), lambda: None)
            assert await reader.pop() == b"x"
            popping = asyncio.ensure_future(reader.pop())
            gone.close()
            await delivery.over()
            reason = "the client has not taken the values of a step within 0.05 s"
            assert (idle.failure, receiver.reason) == (reason, reason)
            assert (reader.failure, gone.failure, none.failure) == ("", "", "")
            delivery.receivers.clear()
            delivery.begin(Step(2, 100, 50), lambda: None)
            assert not delivery.busy  # no stream has anything to take
            popping.cancel()

    run(test())


def test_the_marker_for_a_single_stream_does_not_wait_for_the_values() -> None:
    async def test() -> None:
        outboxes, marked, ended = Outboxes(), list[bool](), list[bool]()
        delivery = Delivery(VirtualTime(), {}, outboxes, lambda: ended.append(True))
        with outboxes.opened() as outbox:
            lane = StateLane(outbox)
            lane.keep(b"value")

            def mark() -> None:
                marked.append(True)
                lane.keep(b"marker")

            delivery.begin(Step(1, 50, 50), mark)
            assert marked
            assert [await outbox.pop() for _ in range(2)] == [b"value", b"marker"]
            assert not ended
            popping = asyncio.ensure_future(outbox.pop())
            await delivery.over()
            assert ended
            popping.cancel()

    run(test())


def test_each_step_has_the_whole_time_and_who_waits_waits_for_the_last_one(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        loop, start_s = asyncio.get_running_loop(), asyncio.get_running_loop().time()
        late_s = 0.0
        monkeypatch.setattr(loop, "time", lambda: start_s + late_s)
        outboxes, receiver = Outboxes(), Receiver()
        following = iter([Step(2, 100, 50)])

        def follow() -> None:
            nonlocal late_s
            late_s = 0.7 * module.PATIENCE_S
            for step in following:
                delivery.begin(step, lambda: None)

        delivery = Delivery(VirtualTime(), {}, outboxes, follow)
        delivery.receivers.append(receiver)
        delivery.begin(Step(1, 50, 50), lambda: None)
        waiting = asyncio.ensure_future(delivery.over())
        await asyncio.sleep(0)
        receiver.take()
        for share in (1.3, 1.6):
            late_s = share * module.PATIENCE_S
            for _ in range(5):
                await asyncio.sleep(0)
            assert (receiver.steps, receiver.reason, waiting.done()) == ([1, 2], "", False)
        late_s = 1.8 * module.PATIENCE_S
        await waiting
        assert "has not taken the values" in receiver.reason

    asyncio.run(test())  # without a bound of its own: the test has the clock


def test_a_delivery_that_is_stopped_lets_its_callers_go_and_does_not_end() -> None:
    async def test() -> None:
        receiver, ended = Receiver(), list[bool]()
        delivery = Delivery(VirtualTime(), {}, Outboxes(), lambda: ended.append(True))
        delivery.receivers.append(receiver)
        delivery.begin(Step(1, 50, 50), lambda: None)
        caller = asyncio.ensure_future(delivery.over())
        await asyncio.sleep(0)
        delivery.stop()
        await caller
        receiver.take()  # when the stream ends
        assert not ended

    run(test())
