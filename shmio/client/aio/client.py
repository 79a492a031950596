"""The client for asyncio."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Self, Unpack

import grpc
import msgspec

from shmio.client import calls, injection, injections, replay
from shmio.client.aio.campaign import Campaign
from shmio.client.aio.injection import Shadow
from shmio.client.aio.model import Simulation
from shmio.client.aio.steps import Steps
from shmio.client.aio.transport import CLOSED, Channel, Duplex, Step, Stream, sleep
from shmio.client.arrays import InjectResponse, ReadResponse, SimulateResponse, SubscribeResponse
from shmio.client.calls import Target
from shmio.client.layout import BlockLayout, layouts
from shmio.client.model import PATIENCE_S, RETRY_S, Rejoining
from shmio.client.update import Snapshot, Tables, Update
from shmio.errors import CommandError, ConflictError, PathError, RemoteError, TimeError
from shmio.layout.glob import choose
from shmio.layout.model import Layout
from shmio.model.clock import Clock
from shmio.model.injection import Injection, Lifted
from shmio.model.outcome import Outcome
from shmio.model.reading import Reading
from shmio.model.replay import Playing, Wish
from shmio.wire import shmio_v1_pb2 as wire
from shmio.wire.shmio_v1_pb2_grpc import ShmioStub


class Client:
    """An instance at the other end of a connection. Several tasks may use it. Close it, or use ``async with``.

    It has the methods of :class:`shmio.Cell`, and more.

    Errors are those of a local program: PathError, ValueRangeError, CommandError, QualityError; EndpointError: more
    than the endpoint gives to one client, or all; RemoteError: it cannot be reached, or does not let us.
    """

    def __init__(self, target: Target, timeout_s: float = 10.0) -> None:
        """``timeout_s``: of calls that are answered at once."""
        self.target = target
        self._channel = Channel(target, timeout_s)
        self._layouts: Mapping[str, Layout] | None = None
        connection = self._channel.grpc
        self._stub: Any = ShmioStub(connection)  # type: ignore[no-untyped-call]
        self._read = connection.unary_unary(
            f"/{calls.SERVICE}/Read", wire.ReadRequest.SerializeToString, ReadResponse.FromString
        )
        self._subscribe = connection.unary_stream(
            f"/{calls.SERVICE}/Subscribe", wire.SubscribeRequest.SerializeToString, SubscribeResponse.FromString
        )
        self._inject: Any = connection.stream_stream(f"/{calls.SERVICE}/Inject", None, InjectResponse.FromString)
        self._simulate: Any = connection.stream_stream(f"/{calls.SERVICE}/Simulate", None, SimulateResponse.FromString)

    async def layouts(self, *sources: str) -> dict[str, BlockLayout]:
        """The blocks of these sources, or of all, by source. PathError: no such source."""
        request = wire.GetLayoutsRequest(sources=sources)
        parts = await Stream(self._channel, self._stub.GetLayouts, request, timeout_s=self._channel.timeout_s).to_list()
        return {block.source: block for block in layouts(parts)}

    @property
    async def sources(self) -> list[str]:
        """Names of the sources."""
        return list(await self.layouts())

    async def get(self, *patterns: str) -> list[Reading]:
        """Read the registers that patterns name, whatever their quality: see :class:`shmio.Cell`.

        The layouts are fetched with the first call, and when a reload has changed them. PathError: a pattern names
        nothing; ValueRangeError: too much for one call.
        """
        if self._layouts is not None:
            with suppress(PathError):  # as of the layouts before a reload
                return await self._get(patterns, self._layouts)
        self._layouts = await self.layouts()
        return await self._get(patterns, self._layouts)

    async def _get(self, patterns: tuple[str, ...], layouts: Mapping[str, Layout]) -> list[Reading]:
        chosen = choose(patterns, layouts)
        if not chosen:
            return []
        found = (await self.read(*patterns)).updates
        if {(source, path) for source, update in found.items() for path in update.table.places} != {
            (source, register.path) for source, register in chosen
        }:
            raise PathError(f"{', '.join(patterns)}: a reload has changed what this names; try again")
        return [
            found[source].reading(found[source].table.places[register.path], register) for source, register in chosen
        ]

    async def status(self) -> dict[str, Any]:
        """How the instance and its processes are, as ``shmio-supervisor status --json`` has it."""
        return calls.status(await self._call(self._stub.GetStatus, wire.GetStatusRequest()))

    async def read(self, *patterns: str, originals: bool = False) -> Snapshot:
        """Registers as of now: paths, elements, slices, structures, globs, or a source; of each source one frame.

        ``originals``: what the source delivered, too, where an injection shows something else. PathError,
        ValueRangeError: too much for one call.
        """
        tables = Tables()
        request = calls.read_request(patterns, originals=originals, tables=())
        return Snapshot(tables.updates(await self._call(self._read, request)))

    async def __getitem__(self, path: str) -> Any:
        """A register's good value; PathError, and QualityError with the reason when there is none."""
        return (await self.read(path))[path]

    def subscribe(
        self,
        *patterns: str,
        every_frame: bool = False,
        frames: bool = False,
        max_rate_hz: float = 0.0,
        deadband: float = 0.0,
    ) -> Subscription:
        """The present values of all, then what changes: see :class:`Update`. PathError comes with the first one.

        ``every_frame``: all frames in order, losses counted; else the newest, at most ``max_rate_hz`` a second of
        each source, and of numbers only what differs from what came before by more than ``deadband``. ``frames``: raw
        frames of the sources instead of values.
        """
        request = calls.subscribe_request(
            patterns, every_frame=every_frame, frames=frames, max_rate_hz=max_rate_hz, deadband=deadband
        )
        return Subscription(Stream(self._channel, self._subscribe, request))

    async def set(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Write values to one source as one command, and wait for the outcomes: :meth:`write` without its options."""
        return await self.write(values, timeout_s)

    async def write(
        self, values: Mapping[str, object], timeout_s: float | None = None, *, until_accepted: bool = False
    ) -> list[Outcome]:
        """Write registers, arrays or elements of one source, all or none; what became of each, by the source.

        ``timeout_s``: how long the source may take until it begins; default: 2 s, or three of its cycles.
        ``until_accepted``: do not wait for what the device says. PathError, ValueRangeError, CommandError: nothing has
        been sent.
        """
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
        """Lay a shadow over registers, elements, slices, structures or patterns of one source, all /out or all /in.

        It is lifted when it is closed, at the end of its ``async with`` block, when this program ends, or ``for_s``
        later; with ``keep`` only when somebody lifts it. ``originals``: iterate over it for what it stands over.
        ``ranges``: bytes and bits of a frame besides, or alone: then ``source`` says whose, as ``cell`` or
        ``cell/in``. PathError, ValueRangeError; CommandError: the source refuses it.
        """
        first = injection.lay(
            patterns, ranges=ranges, source=source, priority=priority, keep=keep, name=name, for_s=for_s,
            originals=originals,
        )  # fmt: skip
        return await Shadow.lay(self._channel, self._inject, first)

    async def declare(
        self, declarations: Iterable[Mapping[str, Any] | msgspec.Struct], *, keep: bool = False
    ) -> Campaign:
        """Lay injections that their sources run by themselves, all or none: tables as ``[[injection]]`` has them.

        They are lifted when it is closed, at the end of its ``async with`` block, or when this program ends; with
        ``keep`` when they are over, or somebody lifts them. Iterate over it for what is done with them.
        ValueRangeError: one that cannot be; CommandError: a source refuses it.
        """
        request = injections.declare_request(declarations, keep=keep)
        return await Campaign.lay(Stream(self._channel, self._stub.Declare, request), self.lift, keep=keep)

    async def injections(self, *sources: str) -> list[Injection[Mapping[str, Any]]]:
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
        """Join a source of the connector ``remote`` as its model, to be told its steps and to answer them.

        ``name``: for messages. PathError: no such source; CommandError: it has no model elsewhere; ConflictError: it
        has another one already; LostError, RemoteError.
        """
        return await Simulation.join(self._channel, self._simulate, source, name)

    async def simulate(
        self,
        source: str,
        step: Step,
        *,
        name: str = "",
        start: Callable[[Simulation], object] | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        """Be the model of a source until this client is closed, or its task is interrupted.

        ``step(time_s, dt_s, inputs)`` gives outputs by their paths, all or some; what it raises is the reason why the
        step failed, which the log of ``shmio.client`` tells, too. ``start`` is called with the :class:`Simulation`
        whenever it has joined. An instance that is not there, or goes, is waited for ``patience_s``. Errors as of
        :meth:`simulation`.
        """
        rejoining = Rejoining(patience_s)
        while True:
            try:
                async with await self.simulation(source, name) as simulation:
                    if start is not None:
                        start(simulation)
                    rejoining.joined()
                    async for work in simulation:
                        await simulation.compute(work, step, rejoining)
                    return
            except (RemoteError, ConflictError) as error:
                if not self._channel.closed and not rejoining.patient(error):
                    raise
            except CLOSED:
                if not self._channel.closed:
                    raise
            if self._channel.closed:
                return
            await sleep(RETRY_S)

    async def clock(self) -> Clock:
        """How time stands."""
        return calls.clock((await self._call(self._stub.GetStatus, wire.GetStatusRequest())).clock)

    async def real_sources(self) -> list[str]:
        """Return the names of the sources that steps do not move, such as those with a device."""
        return [one["name"] for one in (await self.status())["processes"] if one.get("real_time")]

    async def step(self, dt_s: float | None = None, count: int = 1) -> Clock:
        """Take control of time, and move it by steps; it returns when all streams have what changed in them.

        ``dt_s``: length of each step; None: the step size. Returns the clock after the last step. TimeError: a step
        failed, or another program owns time; ValueRangeError.
        """
        if count == 1:
            return await self._move(self._stub.Step, wire.StepRequest(dt_ns=calls.ns(dt_s)), calls.STEP_PATIENCE_S)
        try:
            async with self.steps(count, dt_s) as steps:
                async for _ in steps:
                    pass
        except CommandError as error:
            raise TimeError(str(error)) from None
        return await self.clock()

    def steps(self, count: int = 0, dt_s: float | None = None) -> Steps:
        """Take time over, and move it by so many steps, by one call: see :class:`Steps`. ValueRangeError."""
        requests = calls.steps_requests(count, dt_s)
        return Steps(Duplex(self._channel, self._stub.Steps, *requests), count)

    async def set_step_size(self, dt_s: float) -> Clock:
        """How far a step goes that does not say it; takes time over. TimeError, ValueRangeError."""
        return await self._move(self._stub.SetStepSize, wire.SetStepSizeRequest(dt_ns=calls.ns(dt_s)))

    async def play(self, rate: float = 1.0, dt_s: float | None = None) -> Clock:
        """Have time step by itself, ``rate`` times as fast as real time. TimeError, ValueRangeError."""
        return await self._move(self._stub.Play, wire.PlayRequest(dt_ns=calls.ns(dt_s), rate=rate))

    async def pause(self) -> Clock:
        """Have time step no more by itself; takes it over. TimeError."""
        return await self._move(self._stub.Pause, wire.PauseRequest())

    async def release(self) -> Clock:
        """Have time go by itself again, from where it stands; how it stands then. TimeError."""
        return await self._move(self._stub.Release, wire.ReleaseRequest())

    async def replay(self, **wish: Unpack[Wish]) -> list[Playing]:
        """Move the sources that play recordings (:class:`Wish`); without a wish only tell how they play.

        One that is over begins anew. ValueRangeError: a speed or a time; PathError: a source or a register;
        CommandError: nothing is played, what is looked for is not there, or a source does not answer.
        """
        found = await self._call(self._stub.Replay, replay.request(wish), replay.patience_s(wish))
        return replay.told(found)

    async def _move(self, method: Callable[..., Any], request: Any, timeout_s: float | None = None) -> Clock:
        """Call what moves time. TimeError: the endpoint refuses, or a step failed."""
        try:
            return calls.clock(await self._call(method, request, timeout_s))
        except CommandError as error:
            raise TimeError(str(error)) from None

    async def _call(self, method: Callable[..., Any], request: Any, timeout_s: float | None = None) -> Any:
        try:
            return await method(request, timeout=timeout_s or self._channel.timeout_s, metadata=self.target.metadata)
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
    """Updates as they come; ends when it, or its client, is closed. For one task, :meth:`close` for any."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._tables = Tables()
        self._waiting: Iterator[Update] = iter(())

    async def __anext__(self) -> Update:
        """The next one, waited for. The arrays of its table change with the one after it.

        RemoteError: the instance has ended; PathError, ValueRangeError, EndpointError: it refuses.
        """
        while True:
            for update in self._waiting:
                return update
            self._waiting = self._tables.all_of(await anext(self._stream))

    def close(self) -> None:
        """End it."""
        self._stream.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
