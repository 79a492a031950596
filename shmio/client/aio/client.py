"""The client for asyncio."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from typing import Any, Self, Unpack

import grpc

from shmio.client import calls, injection, injections, replay
from shmio.client.aio.calls import receive
from shmio.client.aio.campaign import Campaign
from shmio.client.aio.injection import Shadow
from shmio.client.aio.model import Simulation, Step, serve
from shmio.client.aio.steps import Steps
from shmio.client.arrays import InjectResponse, ReadResponse, SimulateResponse, SubscribeResponse
from shmio.client.calls import Clock, Outcome, Target
from shmio.client.injections import Injection, Lifted
from shmio.client.layout import BlockLayout, layouts
from shmio.client.model import PATIENCE_S
from shmio.client.replay import Wish
from shmio.client.update import Snapshot, Tables, Update
from shmio.errors import CommandError
from shmio.model.replay_status import Playing
from shmio.wire import shmio_v1_pb2 as wire
from shmio.wire.shmio_v1_pb2_grpc import ShmioStub


class Client:
    """As :class:`shmio.client.Client`, to be made and used within an event loop. Close it, or use ``async with``."""

    def __init__(self, target: Target, timeout_s: float = 10.0) -> None:
        """``timeout_s``: of calls that are answered at once."""
        self.target = target
        self._timeout_s = timeout_s
        credentials = target.credentials
        self._channel = (
            grpc.aio.insecure_channel(target.address, calls.OPTIONS)
            if credentials is None
            else grpc.aio.secure_channel(target.address, credentials, calls.OPTIONS)
        )
        self._stub: Any = ShmioStub(self._channel)  # type: ignore[no-untyped-call]
        self._read = self._channel.unary_unary(
            f"/{calls.SERVICE}/Read", wire.ReadRequest.SerializeToString, ReadResponse.FromString
        )
        self._inject: Any = self._channel.stream_stream(f"/{calls.SERVICE}/Inject", None, InjectResponse.FromString)
        self._simulate: Any = self._channel.stream_stream(
            f"/{calls.SERVICE}/Simulate", None, SimulateResponse.FromString
        )
        self._subscribe = self._channel.unary_stream(
            f"/{calls.SERVICE}/Subscribe", wire.SubscribeRequest.SerializeToString, SubscribeResponse.FromString
        )

    async def layouts(self, *sources: str) -> dict[str, BlockLayout]:
        """The blocks of these sources, or of all, by source. PathError: no such source."""
        call = self._stub.GetLayouts(
            wire.GetLayoutsRequest(sources=sources), timeout=self._timeout_s, metadata=self.target.metadata
        )
        try:
            parts = [part async for part in call]
        except grpc.RpcError as error:
            self.target.fail(error)
        return {block.source: block for block in layouts(parts)}

    async def status(self) -> dict[str, Any]:
        """How the instance and its processes are, as ``shmio-supervisor status --json`` has it."""
        return calls.status(await self._call(self._stub.GetStatus, wire.GetStatusRequest()))

    async def read(self, *patterns: str, originals: bool = False) -> Snapshot:
        """As :meth:`shmio.client.Client.read`."""
        tables = Tables()
        request = calls.read_request(patterns, originals=originals, tables=())
        return Snapshot(tables.updates(await self._call(self._read, request)))

    def subscribe(
        self,
        *patterns: str,
        every_frame: bool = False,
        frames: bool = False,
        max_rate_hz: float = 0.0,
        deadband: float = 0.0,
    ) -> Subscription:
        """As :meth:`shmio.client.Client.subscribe`."""
        request = calls.subscribe_request(
            patterns, every_frame=every_frame, frames=frames, max_rate_hz=max_rate_hz, deadband=deadband
        )
        return Subscription(self._subscribe(request, metadata=self.target.metadata), self.target)

    async def write(
        self, values: Mapping[str, object], timeout_s: float | None = None, *, until_accepted: bool = False
    ) -> list[Outcome]:
        """As :meth:`shmio.client.Client.write`."""
        request = calls.write_request(values, timeout_s, until_accepted=until_accepted)
        answer = await self._call(self._stub.Write, request, (timeout_s or 0) + calls.WRITE_PATIENCE_S)
        return calls.outcomes(values, answer.outcomes)

    async def inject(
        self,
        *patterns: str,
        ranges: injection.Ranges = (),
        source: str = "",
        priority: int = 0,
        keep: bool = False,
        name: str = "",
        for_s: float | None = None,
        originals: bool = False,
    ) -> Shadow:
        """As :meth:`shmio.client.Client.inject`."""
        first = injection.lay(
            patterns, ranges=ranges, source=source, priority=priority, keep=keep, name=name, for_s=for_s,
            originals=originals,
        )  # fmt: skip
        call = self._inject(metadata=self.target.metadata)
        try:
            await call.write(first)
            found = await call.read()
        except grpc.RpcError as error:
            self.target.fail(error)
        return Shadow(call, injection.Held(found), self.target)

    async def declare(self, declarations: Iterable[Mapping[str, Any]], *, keep: bool = False) -> Campaign:
        """As :meth:`shmio.client.Client.declare`."""
        request = injections.declare_request(declarations, keep=keep)
        call = self._stub.Declare(request, metadata=self.target.metadata)
        try:
            first = await call.read()
        except grpc.RpcError as error:
            self.target.fail(error)
        return Campaign(call, first, self, keep=keep)

    async def injections(self, *sources: str) -> list[Injection]:
        """What stands at present, on these sources or all; of each the innermost first."""
        request = wire.ListInjectionsRequest(sources=sources)
        return injections.injections(await self._call(self._stub.ListInjections, request))

    async def lift(self, source: str, number: int) -> None:
        """Lift an injection, whoever laid it. PathError: there is none; CommandError: the source does not answer."""
        await self._call(self._stub.Lift, wire.LiftRequest(source=source, number=number))

    async def lift_all(self, *sources: str) -> list[Lifted]:
        """The emergency: lift all of these sources, or of all, whoever laid them. CommandError: some still stand."""
        found = injections.lifted(await self._call(self._stub.LiftAll, wire.LiftAllRequest(sources=sources)))
        if left := [one for one in found if one.failure]:
            raise CommandError(f"{len(left)} of {len(found)} injections still stand: {left[0].failure}")
        return found

    async def simulation(self, source: str, name: str = "") -> Simulation:
        """As :meth:`shmio.client.Client.simulation`."""
        return await Simulation.join(self._simulate, self.target, source, name)

    async def simulate(
        self,
        source: str,
        step: Step,
        *,
        name: str = "",
        start: Callable[[Simulation], object] | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        """As :meth:`shmio.client.Client.simulate`; ``step`` may be a coroutine function. Ends when it is cancelled."""
        await serve(lambda: self.simulation(source, name), step, start, patience_s)

    async def clock(self) -> Clock:
        """How time stands."""
        return Clock.of((await self._call(self._stub.GetStatus, wire.GetStatusRequest())).clock)

    async def step(self, dt_s: float | None = None) -> Clock:
        """Take time over, and move it by one step; it returns when all streams have what has changed in it.

        CommandError: the step failed, or another program owns time; ValueRangeError.
        """
        request = wire.StepRequest(dt_ns=calls.ns(dt_s))
        return Clock.of(await self._call(self._stub.Step, request, calls.STEP_PATIENCE_S))

    def steps(self, count: int = 0, dt_s: float | None = None) -> Steps:
        """As :meth:`shmio.client.Client.steps`."""
        return Steps(self._stub.Steps(metadata=self.target.metadata), self.target, count, dt_s)

    async def set_step_size(self, dt_s: float) -> Clock:
        """How far a step goes that does not say it; takes time over. CommandError, ValueRangeError."""
        return Clock.of(await self._call(self._stub.SetStepSize, wire.SetStepSizeRequest(dt_ns=calls.ns(dt_s))))

    async def play(self, rate: float = 1.0, dt_s: float | None = None) -> Clock:
        """Have time step by itself, ``rate`` times as fast as real time. CommandError, ValueRangeError."""
        return Clock.of(await self._call(self._stub.Play, wire.PlayRequest(dt_ns=calls.ns(dt_s), rate=rate)))

    async def pause(self) -> Clock:
        """Have time step no more by itself; takes it over. CommandError."""
        return Clock.of(await self._call(self._stub.Pause, wire.PauseRequest()))

    async def replay(self, **wish: Unpack[Wish]) -> list[Playing]:
        """Move the sources that play recordings (:class:`Wish`); without a wish only tell how they play.

        One that is over begins anew. ValueRangeError: a speed or a time; PathError: a source or a register;
        CommandError: nothing is played, what is looked for is not there, or a source does not answer.
        """
        found = await self._call(self._stub.Replay, replay.request(wish), replay.patience_s(wish))
        return replay.told(found)

    async def _call(self, method: Callable[..., Any], request: Any, timeout_s: float | None = None) -> Any:
        try:
            return await method(request, timeout=timeout_s or self._timeout_s, metadata=self.target.metadata)
        except grpc.RpcError as error:
            self.target.fail(error)

    async def close(self) -> None:
        """End all calls, and the connection."""
        await self._channel.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


class Subscription(AsyncIterator[Update]):
    """Updates as they come; ends when it, or its client, is closed."""

    def __init__(self, call: Any, target: Target) -> None:
        self._call = call
        self._target = target
        self._tables = Tables()
        self._waiting: Iterator[Update] = iter(())

    async def __anext__(self) -> Update:
        """As that of :class:`shmio.client.Subscription`."""
        while True:
            for update in self._waiting:
                return update
            self._waiting = self._tables.all_of(await receive(self._call, self._target.fail))

    def close(self) -> None:
        """End it."""
        self._call.cancel()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
