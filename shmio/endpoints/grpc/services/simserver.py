"""Serves SimServerAPI, package ``com.ttsnetwork.simulator3``, which controls the instance's time."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable
from functools import partial
from typing import Any, Final

import grpc
from google.protobuf.empty_pb2 import Empty

from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.streams.outbox import Outboxes, StateLane
from shmio.endpoints.grpc.time.stepper import Stepper
from shmio.endpoints.grpc.time.timeline import TimeStatus
from shmio.errors import ShmioError
from shmio.wire import simserver_pb2 as wire

SERVICE: Final = wire.DESCRIPTOR.services_by_name["SimServerAPI"].full_name

_MS: Final = 1_000_000


class SimServer:
    """Serves the calls that control the instance's time."""

    name = SERVICE

    def __init__(self, stepper: Stepper, outboxes: Outboxes) -> None:
        self._stepper = stepper
        self._outboxes = outboxes
        self._lanes: dict[StateLane, None] = {}  # of the subscribers to the status
        stepper.timeline.watch(self._send)

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handlers of the service's calls."""
        unary = grpc.unary_unary_rpc_method_handler
        status = wire.SimStatus.SerializeToString
        calls: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "step": unary(self.step, wire.StepRequest.FromString, status),
            "start": unary(self.start, wire.StartRequest.FromString, status),
            "stop": unary(self.stop, Empty.FromString, status),
            "pause": unary(self.pause, Empty.FromString, status),
            "subscribe": grpc.unary_stream_rpc_method_handler(self.subscribe, Empty.FromString),
        }
        return calls

    async def step(self, request: wire.StepRequest, context: Context) -> wire.SimStatus:
        """Make a step. Answer when all streams have its values.

        Statuses:
            INVALID_ARGUMENT: The step is out of range.
            FAILED_PRECONDITION: The step failed, or another program controls time.
        """
        try:
            step = await self._stepper.step(_ns(request.deltaTime), context.peer())
        except ShmioError as error:
            await refuse(context, error)
        return _wire(self._stepper.timeline.status._replace(clock_ns=step.time_ns, dt_ns=step.dt_ns))

    async def start(self, request: wire.StartRequest, context: Context) -> wire.SimStatus:
        """Start playing in real time.

        Statuses:
            INVALID_ARGUMENT: The step is out of range.
            FAILED_PRECONDITION: Another program controls time.
        """
        return await self._answer(self._stepper.play(_ns(request.deltaTime)), context)

    async def stop(self, _: Empty, context: Context) -> wire.SimStatus:
        """Stop playing. Until the next step, the status has ``alive = False``."""
        return await self._answer(self._stepper.pause(end=True), context)

    async def pause(self, _: Empty, context: Context) -> wire.SimStatus:
        """Stop playing."""
        return await self._answer(self._stepper.pause(), context)

    async def subscribe(self, _: Empty, context: Context) -> AsyncIterator[bytes]:
        """Stream the state of time: one message for each step and each other change.

        Statuses:
            RESOURCE_EXHAUSTED: The client is too slow for the steps.
        """
        with self._outboxes.opened() as outbox:
            lane = StateLane(outbox)
            self._lanes[lane] = None
            outbox.on_failure = partial(self._lanes.pop, lane, None)
            try:
                await context.send_initial_metadata(())  # the client misses nothing from then on
                while (message := await outbox.pop()) is not None:
                    yield message
            finally:
                self._lanes.pop(lane, None)
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, outbox.failure)

    async def _answer(self, call: Awaitable[TimeStatus], context: Context) -> wire.SimStatus:
        try:
            return _wire(await call)
        except ShmioError as error:
            await refuse(context, error)

    def _send(self, status: TimeStatus) -> None:
        if self._lanes:
            message = _wire(status).SerializeToString()
            for lane in self._lanes:
                lane.keep(message)


def _ns(delta_ms: int) -> int | None:
    return delta_ms * _MS or None


def _wire(status: TimeStatus) -> wire.SimStatus:
    return wire.SimStatus(
        clock=status.clock_ns // _MS, deltaTime=status.dt_ns // _MS, alive=status.alive, playing=status.playing
    )
