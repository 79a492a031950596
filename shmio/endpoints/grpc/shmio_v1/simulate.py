"""The call Simulate: a model in a remote program computes a source's values, step by step."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Mapping
from functools import partial
from typing import Any

import grpc
import numpy as np

from shmio.audit import trail
from shmio.endpoints.grpc.encoding import field
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.server.limits import time_sliced
from shmio.endpoints.grpc.shmio_v1.clock import clock
from shmio.endpoints.grpc.shmio_v1.selection import MAX_ELEMENTS, MAX_REGISTERS
from shmio.endpoints.grpc.shmio_v1.tables import KINDS, DecodedImage, Selection, pack
from shmio.endpoints.grpc.shmio_v1.write import FIELDS, MAX_VALUES, plain
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.wakeups import WakeUp
from shmio.errors import CommandError, ConflictError, PathError, SegmentError, ShmioError, ValueRangeError
from shmio.layout.image import initial_frame
from shmio.layout.model import Register, index_at
from shmio.layout.topic import find, holders, parse_topic, shorten
from shmio.layout.values.codec import RegisterCodec, codec
from shmio.model.values import Column
from shmio.segment import Block, Segment
from shmio.segment.model_channel import MAX_NAME_BYTES, ModelChannel, ModelRequest, model_ports
from shmio.wire import shmio_v1_pb2 as wire
from shmio.wording import printable, unknown


class OutputEncoder:
    """Encodes the outputs of a model into an image of the block. It caches what it has looked up."""

    def __init__(self, selection: Selection) -> None:
        self._selection = selection
        self._by_path = {register.path: register for register in selection.registers}
        self._slots: dict[tuple[Column, int], tuple[str, RegisterCodec]] = {}
        self._paths: dict[str, Register] = {}

    async def packed(self, values: wire.Values, image: bytearray) -> None:
        """Encode values that are given by slot. Other tasks may run in between.

        Raises:
            ValueRangeError: A slot or value does not fit the table.

        """
        for column, name in FIELDS.items():
            if not values.HasField(name):
                continue
            part = getattr(values, name)
            columns = self._selection.columns
            most = columns.sizes[column]
            slots = np.fromiter(part.slots or range(most), np.int64)
            if len(slots) != len(part.values):
                raise ValueRangeError(f"{name}: {len(part.values)} values are given for {len(slots)} slots")
            if len(slots) > max(1, most):  # otherwise one message could delay all clients
                raise ValueRangeError(
                    f"{name}: {len(slots)} values are given, but the table has {most}; give each value once"
                )
            if len(wrong := np.flatnonzero(slots >= most)):
                raise ValueRangeError(f"{name}: the table has no slot {slots[wrong[0]]}")
            left = np.arange(len(slots))
            if column in KINDS:
                left = columns.encode(column, slots, np.fromiter(part.values, KINDS[column]), image)
            async for at in time_sliced(left.tolist()):
                self._put(*self._at(column, int(slots[at])), part.values[at], image)

    async def decode_assignments(self, assignments: Any, image: bytearray) -> None:
        """Encode values that are given by path. Other tasks may run in between.

        Raises:
            PathError: The table has no such register.
            ValueRangeError: A value does not fit, or there are too many values.

        """
        if len(assignments) > (most := self._selection.elements):
            raise ValueRangeError(
                f"assignments: {len(assignments)} values are given, but the table has {most}; give each value once"
            )
        if len(assignments) > MAX_VALUES:  # because each is encoded by itself
            raise ValueRangeError(
                f"assignments: {len(assignments)} values are given by path, at most {MAX_VALUES} are allowed; use slots"
            )
        order = self._selection.block.layout.byte_order
        async for assignment in time_sliced(assignments):
            register = self._paths.get(assignment.path)
            if register is None:
                register = self._find(assignment.path)
                if len(self._paths) < self._selection.elements + len(self._by_path):
                    self._paths[assignment.path] = register
            self._put(register.path, codec(register, order), plain(assignment.value, register), image)

    @staticmethod
    def _put(path: str, encoder: RegisterCodec, value: object, image: bytearray) -> None:
        try:
            encoder.encode_into(value, image)
        except ValueRangeError as error:
            text = str(error)
            raise ValueRangeError(text if text.startswith(f"{path}:") else f"{path}: {text}") from None

    def _at(self, column: Column, slot: int) -> tuple[str, RegisterCodec]:
        found = self._slots.get((column, slot))
        if found is None:
            columns, layout = self._selection.columns, self._selection.block.layout
            place = columns.place(column, slot)
            if place is None:
                raise ValueRangeError(f"{FIELDS[column]}: the table has no slot {slot}")
            register = self._selection.registers[place]
            if register.dims:
                register = layout.element(register, index_at(register.dims, slot - columns.places[place][1]))
            found = self._slots[column, slot] = register.path, codec(register, layout.byte_order)
        return found

    def _find(self, text: str) -> Register:
        block = self._selection.block
        topic = parse_topic(text, (block.source,), block.source)
        if topic.source != block.source:
            raise PathError(f"{shorten(text)}: {topic.source} is reserved; begin the path with {block.source}")
        register = find(block.layout, topic.path)
        if self._by_path.keys().isdisjoint(holders(register.path)) or topic.direction == "in":
            raise PathError(f"{shorten(text)}: this is not an output of {block.source}")
        return register


_JOINED, _WORK = (wire.SimulateResponse.DESCRIPTOR.fields_by_name[name].number for name in ("joined", "work"))
_INPUTS, _OUTPUTS, _PRESENT = (
    wire.Joined.DESCRIPTOR.fields_by_name[name].number for name in ("inputs", "outputs", "values")
)
_VALUES, _INVALID = (wire.Do.DESCRIPTOR.fields_by_name[name].number for name in ("values", "invalid"))


class SimulateCalls:
    """Serves the call Simulate, which connects at most one model to each source."""

    def __init__(self, feeds: Mapping[str, Feed], segment: Segment) -> None:
        self._feeds = feeds
        self._segment = segment
        self._open: dict[int, SimulateCall] = {}  # by the section of their block
        for block in segment.blocks.values():
            if block.model_channel is not None:  # a model may have been connected to the previous process
                self._ring(block)

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handler of the call, by name."""
        decode = wire.SimulateRequest.FromString
        return {"Simulate": grpc.stream_stream_rpc_method_handler(self.simulate, decode)}

    async def simulate(self, requests: AsyncIterator[wire.SimulateRequest], context: Context) -> AsyncIterator[bytes]:
        """Send the source's steps to the client, and the client's outputs to the source.

        Statuses:
            NOT_FOUND: There is no such source.
            FAILED_PRECONDITION: The source does not accept models.
            ALREADY_EXISTS: Another model has joined the source.
            INVALID_ARGUMENT: The first message does not join a source, or a later message is not
                the answer to the pending step.
            UNAVAILABLE: A reload has changed the source.
        """
        taking: asyncio.Task[None] | None = None
        simulation: SimulateCall | None = None
        try:
            simulation = await self._joining(requests, context.peer())
            first = await simulation.join()
            trail.record("simulate", {"source": simulation.block.source, "model": simulation.name}, "done")
            self._ring(simulation.block)
            taking = asyncio.get_running_loop().create_task(simulation.take(requests))
            taking.add_done_callback(simulation.taken)
            # This also runs if the client does not read the end of the stream.
            taking.add_done_callback(partial(self._release, simulation))
            yield first
            async for message in simulation.messages():
                yield message
        except ShmioError as error:
            await refuse(context, error)
        finally:
            if taking is not None:
                taking.cancel()
            if simulation is not None:
                self._release(simulation)
        if simulation.failure is not None:
            await refuse(context, simulation.failure)

    async def _joining(self, requests: AsyncIterator[wire.SimulateRequest], peer: str) -> SimulateCall:
        """Read the first message, and return its call.

        Raises:
            PathError: There is no such source.
            CommandError: The source does not accept models.
            ConflictError: Another model has joined the source.
            ValueRangeError: The message does not join, or the name is too long.

        """
        async for request in requests:
            if request.WhichOneof("what") == "join":
                block, name = self._block(request.join.source), request.join.name or peer
                if len(name.encode()) > MAX_NAME_BYTES:
                    raise ValueRangeError(f"name: at most {MAX_NAME_BYTES} bytes are allowed")
                if before := self._open.get(block.section):
                    raise ConflictError(_taken(block, before.name, before.peer))
                simulation = self._open[block.section] = SimulateCall(block, self._segment, printable(name), peer)
                return simulation
            break
        raise ValueRangeError("the first message of Simulate must join a source, all others answer steps")

    def _block(self, source: str) -> Block:
        if source not in self._feeds:
            raise PathError(unknown("source", source, self._feeds))
        block = self._feeds[source].block
        if block.model_channel is None:
            can = (
                ", ".join(name for name, feed in self._feeds.items() if feed.block.model_channel is not None) or "none"
            )
            raise CommandError(
                f"{source}: no model can join it, because its connector is {block.attributes.connector!r}, not "
                f"'remote'; sources that a model can join: {can}"
            )
        return block

    def _release(self, simulation: SimulateCall, _: object = None) -> None:
        """Disconnect a model, so that another model can join its source."""
        if self._open.get(simulation.block.section) is simulation:
            del self._open[simulation.block.section]
            simulation.leave()
            self._ring(simulation.block)

    def _ring(self, block: Block) -> None:
        """Wake the source, so that it notices whether a model is connected."""
        for slot in self._segment.processes:
            if slot.name == block.source:
                self._segment.clock.slot_bell(slot.index).ring()

    def on_sources_replaced(self) -> None:
        """End the calls whose blocks a reload has retired."""
        for simulation in self._open.values():
            if simulation.block.retired:
                source = simulation.block.source
                simulation.end(SegmentError(f"{source}: a reload changed or removed this source; join again"))


class SimulateCall:
    """A Simulate call. Its client is the model of a source."""

    def __init__(self, block: Block, segment: Segment, name: str, peer: str) -> None:
        self.block = block
        self.name = name
        self.peer = peer
        self.failure: ShmioError | None = None
        """The error that ended the call; None if no error ended it."""
        self._segment = segment
        self._joined = False
        self._over = False
        self._wake = asyncio.Event()
        self._bell: WakeUp | None = None  # wakes the call when the source asks for a step
        self._handed = 0
        self._asked: ModelRequest | None = None  # the step that the model computes now
        self._given: DecodedImage | None = None
        self._image: bytearray | None = None  # the source's image with the model's latest outputs
        self._refused = ""

    @property
    def _link(self) -> ModelChannel:
        if self.block.model_channel is None:
            raise SegmentError(f"{self.block.source}: the source's block has no link to a model")
        return self.block.model_channel

    async def join(self) -> bytes:
        """Join the model channel of the source, and return the first message.

        Raises:
            ConflictError: Another model has joined the source.
            ValueRangeError: The source has too many registers or elements.

        """
        self._inputs, self._outputs = await asyncio.to_thread(_tables, self.block)  # takes seconds for a large layout
        self._encoder = OutputEncoder(self._outputs)
        link = self._link
        self._handed = link.asked.head()  # before joining: earlier requests are not for this model
        if not link.join(self.name):
            before = link.model()
            name, who = (before.name, f"pid {before.pid}") if before else ("another", "which is leaving")
            raise ConflictError(_taken(self.block, name, who))
        self._joined = True
        self._bell = WakeUp(link.asked, f"asked-{self.block.source}")
        self._bell.listeners[self._wake.set] = None
        frame = self.block.latest()
        image = frame.raw if frame is not None and frame.source_ns else bytes(initial_frame(self.block.layout)[0])
        joined = wire.Joined(
            computed=link.computed(), clock=clock(self._segment.clock.read()), period_ns=self.block.period_ns
        )
        parts = (
            field(_INPUTS, self._inputs.table)
            + field(_OUTPUTS, self._outputs.table)
            + field(_PRESENT, pack(self._outputs.columns.decode(image)))
        )
        return field(_JOINED, joined.SerializeToString() + parts)

    def leave(self) -> None:
        """Leave the model channel of the source."""
        self._over = True
        if self._joined:
            self._link.leave()
        if self._bell is not None:
            self._bell.stop()

    def end(self, failure: ShmioError | None = None) -> None:
        """End the stream. ``failure`` is the error that ends it; None if there is none."""
        self.failure = self.failure or failure
        self._over = True
        self._wake.set()

    # ---- requests to the model -----------------------------------------------------------------

    async def messages(self) -> AsyncIterator[bytes]:
        """Yield serialised SimulateResponses until the call ends."""
        while not self._over:
            self._wake.clear()  # before the checks, so that no wake-up is lost
            if self._asked is None and (ask := self._newest()) is not None:
                self._asked = ask
                yield field(_WORK, self._work(ask))
            else:
                await self._wake.wait()

    def _newest(self) -> ModelRequest | None:
        """Return the step that the source waits for.

        Returns:
            The step; None if there is none, if the model already has it, or if it is too late.

        """
        link = self._link
        if link.asked.head() == self._handed or (ask := link.newest()) is None:
            return None
        self._handed = ask.number
        return ask if ask.until_ns > time.monotonic_ns() else None

    def _work(self, ask: ModelRequest) -> bytes:
        """Return a serialised ``Do``, which requests a step.

        The first ``Do`` has all inputs; later messages have only the changed inputs.
        """
        before, now = self._given, self._inputs.columns.decode(ask.commanded)
        self._given = now
        work = wire.Do(
            step=ask.step, time_ns=ask.time_ns, dt_ns=ask.dt_ns, doubt=ask.doubt, refused=self._refused
        ).SerializeToString()
        if values := pack(now, before):
            work += field(_VALUES, values)
        if before is None or now.invalid != before.invalid:
            work += field(_INVALID, field(1, np.array(now.invalid, "<u4").tobytes()))
        return work

    # ---- answers of the model ------------------------------------------------------------------

    async def take(self, requests: AsyncIterator[wire.SimulateRequest]) -> None:
        """Process the model's answers until the client ends its side of the stream.

        Raises:
            ValueRangeError: A message is not the answer to the pending step.

        """
        async for request in requests:
            if request.WhichOneof("what") != "done":
                raise ValueRangeError("only the first message joins a source; all others must answer steps")
            await self._take(request.done)
        self.end()

    def taken(self, task: asyncio.Task[None]) -> None:
        """End the call. This is the done-callback of the task that runs :meth:`take`."""
        if not task.cancelled():
            error = task.exception()
            self.end(error if isinstance(error, ShmioError) else None)

    async def _take(self, done: wire.Done) -> None:
        ask = self._asked
        if ask is None or done.step != ask.step:
            asked = "no step is pending" if ask is None else f"step {ask.step} is pending"
            raise ValueRangeError(f"the model answered step {done.step}, but {asked}")
        self._refused = ""
        image = bytearray(ask.shown if self._image is None else self._image)
        failure = " ".join(done.failure.split()) if done.HasField("failure") else None
        if failure is None:
            try:
                await self._encoder.packed(done.values, image)
                await self._encoder.decode_assignments(done.assignments, image)
            except (PathError, ValueRangeError) as error:
                failure = str(error)
                self._refused = f"step {ask.step}: {failure}"
            else:
                self._image = image
        late_ns = (now_ns := time.monotonic_ns()) - ask.until_ns
        if late_ns < 0:
            self._link.answer(ask, now_ns, image, None if failure is None else printable(failure))
        else:  # do not pass on the answer: a source that is late as well might still use it
            self._refused = self._refused or f"step {ask.step}: the answer came {late_ns // 1_000_000} ms too late"
        self._asked = None
        self._wake.set()


def _tables(block: Block) -> tuple[Selection, Selection]:
    """Return the tables of inputs and outputs.

    Raises:
        ValueRangeError: A table is too large.
        ConfigError: The declared outputs do not fit the layout.

    """
    ends = model_ports(block.layout, block.attributes.outputs, block.attributes.inouts)
    tables = Selection(1, block, ends.inputs), Selection(2, block, ends.outputs)
    for table in tables:
        if len(table.registers) > MAX_REGISTERS or table.elements > MAX_ELEMENTS:
            raise ValueRangeError(
                f"{block.source} has more than {MAX_REGISTERS} registers or {MAX_ELEMENTS} elements, which is "
                "the maximum of a model; split the source into several"
            )
        _ = table.table
    return tables


def _taken(block: Block, name: str, who: str) -> str:
    return (
        f"{block.source}: model {name!r} ({who}) is connected already, and a source takes only one; end it first, or "
        "name another source"
    )
