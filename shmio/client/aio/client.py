"""The client for asyncio: calls, and streams of updates and steps."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Self, Unpack

import grpc
import msgspec

from shmio.client import calls, injection
from shmio.client.aio.events import Events
from shmio.client.aio.injection import Campaign, Shadow
from shmio.client.aio.transport import CLOSED, Channel, Duplex, Step, Stream, outputs_of, sleep
from shmio.client.calls import Stepped, Target
from shmio.client.layout import BlockLayout, layouts
from shmio.client.model import PATIENCE_S, RETRY_S, Member, Part, Rejoining, Work, join_request
from shmio.client.table import InjectResponse, ReadResponse, SimulateResponse, SubscribeResponse
from shmio.client.update import Snapshot, Tables, Update
from shmio.errors import (
    CommandError,
    ConflictError,
    PathError,
    RemoteError,
    ShmioError,
    SnapshotError,
    TimeError,
    ValueRangeError,
)
from shmio.layout.glob import choose
from shmio.model.clock import Clock
from shmio.model.injection import Injection, Lifted
from shmio.model.replay import ReplayChanges, ReplayStatus
from shmio.model.snapshot import SnapshotInfo
from shmio.model.values import Outcome, Reading
from shmio.wire import shmio_v1_pb2 as wire
from shmio.wire.shmio_v1_pb2_grpc import ShmioStub


class Client:
    """Client of an instance. Several tasks may use it. Close it, or use ``async with``.

    A client has all methods of :class:`shmio.Cell`, and others.

    Raises:
        PathError, ValueRangeError, CommandError, QualityError: In the same cases as for a local
            cell.
        EndpointError: The endpoint has reached a limit, for this client or for all.
        RemoteError: The endpoint cannot be reached, or refuses this client.
    """

    def __init__(self, target: Target, timeout_s: float = 10.0) -> None:
        """Create a client. ``timeout_s`` is the time-out in s of calls that the endpoint answers at once."""
        self.target = target
        self._channel = Channel(target, timeout_s)
        self._layouts: Mapping[str, BlockLayout] | None = None
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
        """Return the layouts of these sources, by source; of all sources if none is named.

        Raises:
            PathError: There is no such source.
        """
        request = wire.GetLayoutsRequest(sources=sources)
        parts = await Stream(self._channel, self._stub.GetLayouts, request, timeout_s=self._channel.timeout_s).to_list()
        return {block.source: block for block in layouts(parts)}

    @property
    async def sources(self) -> list[str]:
        """Return the names of the sources."""
        return list(await self.layouts())

    async def get(self, *patterns: str) -> list[Reading]:
        """Read the registers that match the patterns, whatever their quality: see :class:`shmio.Cell`.

        The first call, and the first call after each reload, also fetch the layouts.

        Raises:
            PathError: A pattern matches no register.
            ValueRangeError: The registers are too many for one call.
        """
        if self._layouts is not None:
            with suppress(PathError):  # the layouts may be out of date after a reload
                return await self._get(patterns, self._layouts)
        self._layouts = await self.layouts()
        return await self._get(patterns, self._layouts)

    async def _get(self, patterns: tuple[str, ...], layouts: Mapping[str, BlockLayout]) -> list[Reading]:
        chosen = choose(patterns, layouts)
        if not chosen:
            return []
        found = (await self.read(*patterns)).updates
        named = {(source, path) for source, update in found.items() for path in update.table.places}
        if named != {(source, register.path) for source, register in chosen} or any(
            update.table.hash != layouts[source].hash for source, update in found.items()
        ):
            raise PathError(f"{', '.join(patterns)}: a reload changed the registers while they were read; try again")
        return [
            found[source].reading(found[source].table.places[register.path], register) for source, register in chosen
        ]

    async def status(self) -> dict[str, Any]:
        """Return the status of the instance, as ``shmio-supervisor status --json`` prints it."""
        return calls.status(await self._call(self._stub.GetStatus, wire.GetStatusRequest()))

    async def read(self, *patterns: str, originals: bool = False) -> Snapshot:
        """Read registers. All values of one source come from one frame.

        Args:
            patterns: Paths, elements, slices, structures, globs, or the names of sources.
            originals: Whether to read, in addition, the values that the source delivered, without
                injections.

        Raises:
            PathError: A pattern matches no register.
            ValueRangeError: The registers are too many for one call.
        """
        request = calls.read_request(patterns, originals=originals)
        return Snapshot(Tables().updates(await self._call(self._read, request)))

    async def __getitem__(self, path: str) -> Any:
        """Return a register's value.

        Raises:
            QualityError: The quality is bad; the message gives the reason.
            PathError: There is no such register.
        """
        return (await self.read(path))[path]

    def subscribe(
        self,
        *patterns: str,
        every_frame: bool = False,
        frames: bool = False,
        max_rate_hz: float = 0.0,
        deadband: float = 0.0,
    ) -> Subscription:
        """Subscribe to registers: the first updates have the present values, later ones the changes.

        Args:
            patterns: As for :meth:`read`.
            every_frame: Whether to receive an update for each frame, in order, and a count of lost
                frames. Otherwise, each update is about the newest frame.
            frames: Whether to receive the raw frames of the sources instead of values.
            max_rate_hz: Maximum number of updates per second of each source; 0 for no limit.
            deadband: Changes of a number by at most this amount are not reported.

        Returns:
            An iterator over updates (:class:`Update`). If a pattern matches no register, the first
            iteration raises PathError.
        """
        request = calls.subscribe_request(
            patterns, every_frame=every_frame, frames=frames, max_rate_hz=max_rate_hz, deadband=deadband
        )
        return Subscription(Stream(self._channel, self._subscribe, request))

    async def events(self, *sources: str) -> Events:
        """Follow the events of these sources; of all sources if none is named.

        See :class:`shmio.Cell`.

        Raises:
            PathError: There is no such source.
            ValueRangeError: There are too many sources.
            EndpointError: Too many clients follow events.
            RemoteError: The endpoint cannot be reached, or refuses this client.
        """
        return await Events.begin(Stream(self._channel, self._stub.Events, wire.EventsRequest(sources=sources)))

    async def set(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Write values to one source, and wait for their outcomes: the same as :meth:`write`."""
        return await self.write(values, timeout_s)

    async def write(
        self, values: Mapping[str, object], timeout_s: float | None = None, *, until_accepted: bool = False
    ) -> list[Outcome]:
        """Write values to one source as one command: the source accepts all values or none.

        Args:
            values: Values by path: of registers, arrays or elements.
            timeout_s: Time in s that the values may wait for a cycle of the source; None for 2 s,
                or three cycles if that is longer.
            until_accepted: Whether to return as soon as the source has accepted the values, without
                waiting for the device.

        Returns:
            The outcome of each value.

        Raises:
            PathError: There is no such register; nothing was sent.
            ValueRangeError: A value does not fit; nothing was sent.
            CommandError: A register is not writable; nothing was sent.
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
        """Create an injection over registers of one source, for consumers or for the device.

        Patterns that end in ``/in`` cover values written to the device. All others cover the values
        that consumers see. All patterns must have the same direction. The injection is lifted when
        you close it, at the end of its ``async with`` block, when this program ends, or after
        ``for_s``.

        Args:
            patterns: Registers, elements, slices, structures or globs.
            ranges: Bytes and bits of a frame to cover, in addition to registers or instead of them.
            source: Source of the ranges if you give no pattern, such as ``cell`` or ``cell/in``.
            priority: Injections with a higher priority cover those with a lower one.
            keep: Whether the injection stays when this program ends, until a program lifts it.
            name: Name of the injection in events and lists.
            for_s: Time in s after which the injection is lifted; None for no limit.
            originals: Whether to receive the values that the injection covers. To read them,
                iterate over the injection.

        Raises:
            PathError: A pattern matches no register.
            ValueRangeError: An argument is out of range.
            CommandError: The source refuses the injection.
        """
        first = injection.inject_request(
            patterns, ranges=ranges, source=source, priority=priority, keep=keep, name=name, for_s=for_s,
            originals=originals,
        )  # fmt: skip
        return await Shadow.create(self._channel, self._inject, first)

    async def declare(
        self, declarations: Iterable[Mapping[str, Any] | msgspec.Struct], *, keep: bool = False
    ) -> Campaign:
        """Create all of these declared injections, or none. Their sources run them on their own.

        The injections are lifted when you close the campaign, at the end of its ``async with``
        block, or when this program ends. Iterate over the campaign to get the events of its
        injections.

        Args:
            declarations: Mappings with the keys of an ``[[injection]]`` table, or
                :class:`shmio.config.Declaration` objects.
            keep: Whether the injections stay when this program ends, until they are over or lifted.

        Raises:
            ValueRangeError: A declaration is invalid.
            CommandError: A source refuses an injection.
        """
        request = injection.declare_request(declarations, keep=keep)
        return await Campaign.create(Stream(self._channel, self._stub.Declare, request), self.lift, keep=keep)

    async def injections(self, *sources: str) -> list[Injection[Mapping[str, Any]]]:
        """Return the existing injections of these sources; of all sources if none is named.

        Within a source, the innermost injection comes first.
        """
        request = wire.ListInjectionsRequest(sources=sources)
        return injection.injections(await self._call(self._stub.ListInjections, request))

    async def lift(self, source: str, number: int) -> None:
        """Lift the injection with this number, whichever program created it.

        Raises:
            PathError: There is no such injection.
            CommandError: The source does not answer.
        """
        await self._call(self._stub.Lift, wire.LiftRequest(source=source, number=number))

    async def lift_all(self, *sources: str) -> list[Lifted]:
        """Lift all injections of these sources, whichever program created them.

        Without arguments, lift the injections of all sources. Return the result for each injection.

        Raises:
            CommandError: Some injections were not lifted.
        """
        found = injection.lifted(await self._call(self._stub.LiftAll, wire.LiftAllRequest(sources=sources)))
        if left := [one for one in found if one.failure]:
            raise CommandError(f"{len(left)} of {len(found)} injections were not lifted: {left[0].failure}")
        return found

    async def simulation(self, source: str, name: str = "") -> Simulation:
        """Join a source as the model that computes its steps.

        The source must have the connector ``remote``.

        Args:
            source: Name of the source.
            name: Name of the model in messages.

        Raises:
            PathError: There is no such source.
            CommandError: The source has another connector.
            ConflictError: The source already has a model.
            LostError: The endpoint has ended.
            RemoteError: The endpoint cannot be reached.
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
        """Compute the steps of a source, as its model, until this client is closed.

        After a lost connection, join the source again.

        Args:
            source: Name of the source.
            step: Called as ``step(time_s, dt_s, inputs)``; returns all or some outputs by path. If
                it raises an error, the step fails, and the logger ``shmio.client`` logs the reason.
            name: Name of the model in messages.
            start: Called with the :class:`Simulation` each time the model has joined; None: not
                called.
            patience_s: Time in s for which to try again if the instance does not run or the
                connection is lost.

        Raises:
            PathError, CommandError, ConflictError, LostError, RemoteError: As for
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
        """Return the state of the instance's clock."""
        return calls.clock((await self._call(self._stub.GetStatus, wire.GetStatusRequest())).clock)

    async def real_sources(self) -> list[str]:
        """Return the names of the sources that steps do not advance, such as real devices."""
        return [one["name"] for one in (await self.status())["processes"] if one.get("real_time")]

    async def step(self, dt_s: float | None = None, count: int = 1) -> Clock:
        """Take control of time, and advance it by steps.

        Return when the endpoint has sent the changes to all streams.

        Args:
            dt_s: Length of each step in s; None for the step size.
            count: Number of steps.

        Returns:
            The clock after the last step.

        Raises:
            TimeError: A step failed, or another program owns time.
            ValueRangeError: The count or the length is out of range.
        """
        if count < 1:  # 0 would mean endless steps
            raise ValueRangeError(f"the number of steps must be at least 1, not {count}")
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
        """Return an iterator that takes control of time and does ``count`` steps: see :class:`Steps`.

        Args:
            count: Number of steps; 0 if you will only call :meth:`Steps.step`.
            dt_s: Length of each step in s; None for the step size.

        Raises:
            ValueRangeError: The count or the step size is out of range.
        """
        requests = calls.steps_requests(count, dt_s)
        return Steps(Duplex(self._channel, self._stub.Steps, *requests), count)

    async def set_step_size(self, dt_s: float) -> Clock:
        """Take control of time, and set the step size, which is the default length of a step.

        Args:
            dt_s: The size in s.

        Raises:
            TimeError: Another program owns time.
            ValueRangeError: The size is out of range.
        """
        return await self._move(self._stub.SetStepSize, wire.SetStepSizeRequest(dt_ns=calls.ns(dt_s)))

    async def play(self, rate: float = 1.0, dt_s: float | None = None) -> Clock:
        """Take control of time, and let the endpoint step it continuously until :meth:`pause`.

        Args:
            rate: Speed of the clock relative to real time.
            dt_s: Length of each step in s; None for the step size.

        Raises:
            TimeError: Another program owns time.
            ValueRangeError: The rate or the length is out of range.
        """
        return await self._move(self._stub.Play, wire.PlayRequest(dt_ns=calls.ns(dt_s), rate=rate))

    async def pause(self) -> Clock:
        """Take control of time, and stop it. Raise TimeError if another program owns time."""
        return await self._move(self._stub.Pause, wire.PauseRequest())

    async def release(self) -> Clock:
        """Return to real time; the clock continues from the present virtual time.

        Raises:
            TimeError: Another program owns time, or time was virtual from the instance's start.
        """
        return await self._move(self._stub.Release, wire.ReleaseRequest())

    async def replay(self, **changes: Unpack[ReplayChanges]) -> list[ReplayStatus]:
        """Control the replays of recordings, and return their status.

        Without arguments, only return the status.

        Args:
            changes: Requested changes: see :class:`shmio.model.replay.ReplayChanges`. If you resume
                a replay at its end, it starts again.

        Raises:
            ValueRangeError: A speed or a time is out of range.
            PathError: There is no such source or register.
            CommandError: There is no replay, the search found nothing, or a source does not answer.
        """
        found = await self._call(self._stub.Replay, calls.replay_request(changes), calls.replay_patience_s(changes))
        return calls.replay_status(found)

    async def save_snapshot(self, name: str, *, partial: bool = False) -> SnapshotInfo:
        """Save the state of the instance, whose time must be virtual: see :class:`shmio.Cell`.

        Raises:
            SnapshotError: The snapshot cannot be saved; the message says why.
        """
        return await self._snapshot(self._stub.SaveSnapshot, wire.SaveSnapshotRequest(name=name, partial=partial))

    async def restore_snapshot(self, name: str) -> SnapshotInfo:
        """Restore a snapshot, which may set time back: see :class:`shmio.Cell`.

        Raises:
            SnapshotError: The snapshot cannot be restored; the message says why.
        """
        return await self._snapshot(self._stub.RestoreSnapshot, wire.RestoreSnapshotRequest(name=name))

    async def snapshots(self) -> list[SnapshotInfo]:
        """Return the instance's snapshots, the oldest first."""
        found = await self._call(self._stub.ListSnapshots, wire.ListSnapshotsRequest())
        return [calls.snapshot(one) for one in found.snapshots]

    async def delete_snapshot(self, name: str) -> None:
        """Delete a snapshot. Raise SnapshotError if there is none, or it cannot be deleted."""
        try:
            await self._call(self._stub.DeleteSnapshot, wire.DeleteSnapshotRequest(name=name))
        except CommandError as error:
            raise SnapshotError(str(error)) from None

    async def _snapshot(self, method: Callable[..., Any], request: Any) -> SnapshotInfo:
        try:
            return calls.snapshot(await self._call(method, request, calls.SNAPSHOT_S))
        except CommandError as error:
            raise SnapshotError(str(error)) from None

    async def _move(self, method: Callable[..., Any], request: Any, timeout_s: float | None = None) -> Clock:
        """Call a method that controls time. Raise TimeError if the endpoint refuses, or a step failed."""
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
    """Iterator over updates, for one task. It ends when the iterator or its client is closed.

    Any task may call :meth:`close`.
    """

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._tables = Tables()
        self._waiting: Iterator[Update] = iter(())

    async def __anext__(self) -> Update:
        """Wait for the next update, which overwrites the arrays of the previous update.

        Raises:
            RemoteError: The instance has ended.
            PathError, ValueRangeError, EndpointError: The endpoint refuses the subscription.
        """
        while True:
            for update in self._waiting:
                return update
            self._waiting = self._tables.all_of(await anext(self._stream))

    def close(self) -> None:
        """End the subscription."""
        self._stream.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


class Steps(AsyncIterator[Stepped]):
    """Steps time on one stream, which is cheaper than one call for each step.

    Use it in one task, and close it, or use ``async with``. Iterate over the steps that
    :meth:`Client.steps` requested. The iterator returns a step when the endpoint has sent its
    changes to all streams; meanwhile, the endpoint already computes the next steps. To do something
    between two steps, call :meth:`step` instead of iterating.
    """

    def __init__(self, stream: Duplex, count: int) -> None:
        """Create the iterator for a stream on which ``count`` steps have been requested."""
        self._stream = stream
        self._left = count
        self._waiting: Iterator[Any] = iter(())

    async def __anext__(self) -> Stepped:
        """Wait for the next finished step. The iteration ends after all requested steps.

        Raises:
            CommandError: The step failed, or another program owns time; no later step follows.
            ValueRangeError: The step size is out of range.
            RemoteError: The connection failed.
        """
        if not self._left:
            raise StopAsyncIteration
        while True:
            for found in self._waiting:
                self._left -= 1
                return Stepped.of(found)
            try:
                self._waiting = iter((await anext(self._stream)).steps)
            except ShmioError:
                self.close()
                raise

    async def step(self, dt_s: float | None = None) -> Stepped:
        """Request one more step, and wait until this step and all earlier ones are done.

        ``dt_s`` is the length of the step in s; None for the step size.

        Raises:
            ShmioError: As for the iteration.
        """
        await self._stream.write(*calls.steps_requests(1, dt_s))
        self._left += 1
        last = None
        async for done in self:
            last = done
        if last is None:
            raise CommandError("the stream of steps was closed")
        return last

    def close(self) -> None:
        """Cancel the requested steps. A step that has already started is completed."""
        self._left = 0
        self._stream.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


class Simulation(Member, AsyncIterator[Work]):
    """A source that this program computes: iterate over the requested steps, and answer each of them.

    Use it in one task, and close it, or use ``async with``. Other tasks may only call
    :meth:`close`.
    """

    def __init__(self, stream: Duplex, part: Part) -> None:
        super().__init__(part)
        self._stream = stream

    @classmethod
    async def join(cls, channel: Channel, method: Any, source: str, name: str) -> Self:
        """Join a source; see :meth:`Client.simulation`."""
        stream = Duplex(channel, method, join_request(source, name))
        try:
            return cls(stream, Part(await anext(stream, None)))
        except BaseException:
            stream.close()
            raise

    async def __anext__(self) -> Work:
        """Wait for the next step. The iteration ends when this object or its client is closed.

        Raises:
            LostError: The endpoint has ended, or a reload has changed the source.
            RemoteError: The connection failed for another reason.
        """
        self._work = self._part.take(await anext(self._stream))
        return self._work

    async def done(self, outputs: Mapping[str, object]) -> None:
        """Answer the present step with outputs by path. Missing outputs keep their values.

        Raises:
            PathError: There is no such output; nothing was sent.
            ValueRangeError: A value does not fit; nothing was sent.
        """
        await self._answer(self._part.done(self._present(), outputs))

    async def fail(self, reason: str) -> None:
        """Answer that the present step has failed. The outputs keep their values."""
        await self._answer(self._part.failed(self._present(), reason))

    async def compute(self, work: Work, step: Step, rejoining: Rejoining) -> None:
        """Call the function ``step`` for the requested step ``work``; answer with its outputs or its error."""
        rejoining.heed(self._part, work)
        try:
            outputs = await outputs_of(step(work.time_s, work.dt_s, work.inputs))
            answer = rejoining.answer(self._part, work, outputs)
        except Exception as error:  # noqa: BLE001  any error of the program's function fails the step
            answer = rejoining.failed(self._part, work, error)
        await self._answer(answer)

    async def _answer(self, data: bytes) -> None:
        self._work = None
        await self._stream.write(data)

    def close(self) -> None:
        """Leave the source. Its steps fail until another model joins it."""
        self._stream.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
