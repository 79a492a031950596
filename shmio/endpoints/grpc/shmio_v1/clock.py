"""The calls of shmio.v1 about time: Step, Steps, SetStepSize, Play, Pause, Release, WatchClock."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable
from typing import Any, Final

import grpc

from shmio.endpoints.grpc.encoding import field
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.time.stepper import Stepper
from shmio.endpoints.grpc.time.timeline import TimeStatus
from shmio.errors import EndpointError, ShmioError, ValueRangeError
from shmio.model.clock import Clock
from shmio.segment import Segment
from shmio.wire import shmio_v1_pb2 as wire

MAX_ANSWERS: Final = 1024
"""Maximum number of answers that wait for the client. With that many waiting, no further step is made."""

STEPS: Final = wire.StepsResponse.DESCRIPTOR.fields_by_name["steps"].number


class StepsCall:
    """A Steps call: makes steps, and collects the answers to them."""

    def __init__(self, stepper: Stepper, peer: str) -> None:
        """Prepare the call; :meth:`messages` makes the steps.

        Args:
            stepper: Makes the steps.
            peer: The client, as gRPC names it.

        """
        self._stepper = stepper
        self._peer = peer
        self._answers: list[bytes] = []
        self._wake = asyncio.Event()  # set when there is an answer, or when no more answers will come
        self._room = asyncio.Event()

    async def messages(self, requests: AsyncIterator[wire.StepsRequest]) -> AsyncIterator[bytes]:
        """Yield serialised StepsResponses.

        While a response is being sent, the answers to further steps are collected for the next
        response.

        Raises:
            TimeError: A step failed. The answers to the earlier steps are yielded first.
            ValueRangeError: A step is out of range.

        """
        working = asyncio.get_running_loop().create_task(self._work(requests))
        working.add_done_callback(lambda _: self._wake.set())
        try:
            while self._answers or not working.done():
                if not self._answers:
                    self._wake.clear()
                    await self._wake.wait()
                    continue
                answers, self._answers = self._answers, []
                self._room.set()
                yield b"".join(answers)
            working.result()
        finally:
            working.cancel()

    async def _work(self, requests: AsyncIterator[wire.StepsRequest]) -> None:
        async for request in requests:
            for _ in range(request.count or 1):
                while len(self._answers) >= MAX_ANSWERS:
                    self._room.clear()
                    await self._room.wait()
                step = await self._stepper.step(request.dt_ns or None, self._peer)
                answer = wire.Step(number=step.number, time_ns=step.time_ns)
                self._answers.append(field(STEPS, answer.SerializeToString()))
                self._wake.set()


MAX_WATCHERS = 256
"""Maximum number of open WatchClock calls."""


class TimeCalls:
    """Serves the calls about time."""

    def __init__(self, segment: Segment, stepper: Stepper) -> None:
        self._segment = segment
        self._stepper = stepper
        self._watchers: set[asyncio.Event] = set()
        stepper.timeline.watch(self._wake_watchers)

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handlers of these calls, by name."""
        unary, clock = grpc.unary_unary_rpc_method_handler, wire.Clock.SerializeToString
        return {
            "Step": unary(self.step, wire.StepRequest.FromString, clock),
            "Steps": grpc.stream_stream_rpc_method_handler(self.steps, wire.StepsRequest.FromString),
            "SetStepSize": unary(self.set_step_size, wire.SetStepSizeRequest.FromString, clock),
            "Play": unary(self.play, wire.PlayRequest.FromString, clock),
            "Pause": unary(self.pause, wire.PauseRequest.FromString, clock),
            "Release": unary(self.release, wire.ReleaseRequest.FromString, clock),
            "WatchClock": grpc.unary_stream_rpc_method_handler(self.watch, wire.WatchClockRequest.FromString, clock),
        }

    async def step(self, request: wire.StepRequest, context: Context) -> wire.Clock:
        """Make one step. Answer when all streams have its changes.

        Statuses:
            INVALID_ARGUMENT: The step is out of range.
            FAILED_PRECONDITION: The step failed, or another program controls time.
        """
        try:
            step = await self._stepper.step(request.dt_ns or None, context.peer())
        except ShmioError as error:
            await refuse(context, error)
        found = clock(self._segment.clock.read())
        found.step, found.time_ns = step.number, step.time_ns
        return found

    async def steps(self, requests: AsyncIterator[wire.StepsRequest], context: Context) -> AsyncIterator[bytes]:
        """Make the steps that the client requests, until a step fails.

        Statuses:
            INVALID_ARGUMENT: A step is out of range.
            FAILED_PRECONDITION: A step failed, or another program controls time.
        """
        try:
            async for message in StepsCall(self._stepper, context.peer()).messages(requests):
                yield message
        except ShmioError as error:
            await refuse(context, error)

    async def set_step_size(self, request: wire.SetStepSizeRequest, context: Context) -> wire.Clock:
        """Set the step size: the length of each step whose request gives no length.

        Statuses:
            INVALID_ARGUMENT: The step size is out of range.
            FAILED_PRECONDITION: Another program controls time.
        """
        return await self._do(self._stepper.set_step_size(request.dt_ns), context)

    async def play(self, request: wire.PlayRequest, context: Context) -> wire.Clock:
        """Start playing, at a multiple of real time.

        Statuses:
            INVALID_ARGUMENT: The rate or the step is out of range.
            FAILED_PRECONDITION: Another program controls time.
        """
        rate = request.rate or 1.0
        if not 1e-3 <= rate <= 1e3 or math.isnan(rate):
            await refuse(context, ValueRangeError(f"rate: {rate} is not a number from 0.001 to 1000"))
        return await self._do(self._stepper.play(request.dt_ns or None, rate), context)

    async def pause(self, _: wire.PauseRequest, context: Context) -> wire.Clock:
        """Stop playing.

        Statuses:
            FAILED_PRECONDITION: Another program controls time.
        """
        return await self._do(self._stepper.pause(), context)

    async def release(self, _: wire.ReleaseRequest, context: Context) -> wire.Clock:
        """Return to real time.

        Statuses:
            FAILED_PRECONDITION: Another program controls time, or the instance has no real time.
        """
        return await self._do(self._stepper.release(), context)

    async def watch(self, _: wire.WatchClockRequest, context: Context) -> AsyncIterator[wire.Clock]:
        """Stream the state of time: the present state, and the state after each step or other change.

        A slow client gets only the newest state.

        Statuses:
            RESOURCE_EXHAUSTED: There are too many WatchClock calls.
        """
        if len(self._watchers) >= MAX_WATCHERS:
            await refuse(
                context,
                EndpointError(f"{MAX_WATCHERS} calls of WatchClock are open, which is the maximum; end one first"),
            )
        change = asyncio.Event()
        self._watchers.add(change)
        self._stepper.timeline.follow(followed=True)
        try:
            while True:
                change.clear()
                yield clock(self._segment.clock.read())
                await change.wait()
        finally:
            self._watchers.discard(change)
            self._stepper.timeline.follow(followed=bool(self._watchers))

    async def _do(self, work: Awaitable[object], context: Context) -> wire.Clock:
        try:
            await work
        except ShmioError as error:
            await refuse(context, error)
        return clock(self._segment.clock.read())

    def _wake_watchers(self, _: TimeStatus) -> None:
        for event in self._watchers:
            event.set()


def clock(state: Clock) -> wire.Clock:
    """Convert the state of the clock to a message."""
    return wire.Clock(
        virtual=state.virtual,
        step=state.done,
        time_ns=state.present_ns,
        step_size_ns=state.step_size_ns,
        playing=state.playing,
        rate=state.rate,
        note=state.note,
    )
