"""The calls about injections: Inject, Declare (with ``declare``), ListInjections, Lift and LiftAll."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Collection, Coroutine, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import grpc
import msgspec
import numpy as np

from shmio.config import Declaration
from shmio.endpoints.grpc.commands import command_client
from shmio.endpoints.grpc.commands.injections import InjectionBase, InjectionFollower
from shmio.endpoints.grpc.encoding import field
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.shmio_v1.declare import DeclareCall
from shmio.endpoints.grpc.shmio_v1.selection import MAX_PATTERNS, Selections, SourceDirection
from shmio.endpoints.grpc.shmio_v1.tables import NO_STATUSES, VALUES, Array, head, head_of, pack, pack_slots
from shmio.endpoints.grpc.shmio_v1.write import MAX_VALUES, decode_assignments, outcome, packed
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outbox import SendQueue
from shmio.endpoints.grpc.topics import Topics
from shmio.endpoints.grpc.wakeups import WakeUps
from shmio.errors import CommandError, EndpointError, PathError, ShmioError, ValueRangeError
from shmio.layout.topic import Topic, shorten
from shmio.layout.values.write import Write, covering, merge
from shmio.messages import declaration_to_wire
from shmio.model.injection import Running
from shmio.segment import Block, Direction, EventKind, Frame
from shmio.segment.commands import MAX_NAME_BYTES, CommandWrites, End, apply, worst
from shmio.segment.injection_list import InjectionEntry
from shmio.wire import shmio_v1_pb2 as wire

MAX_INJECTIONS: Final = 256
"""Maximum number of open Inject and Declare calls."""
MAX_OPEN: Final = 32
"""Maximum number of a stream's values that are in flight; further values wait."""
MAX_LIFETIME_MS: Final = 86_400_000

_ORIGINALS, _ANSWERS = (wire.InjectResponse.DESCRIPTOR.fields_by_name[name].number for name in ("originals", "answers"))
_RANGES: Final = wire.Table.DESCRIPTOR.fields_by_name["ranges"].number
_PIECES: Final = wire.Update.DESCRIPTOR.fields_by_name["pieces"].number


class InjectTarget(NamedTuple):
    """What an injection covers: a source and a direction, and in it topics and byte ranges."""

    place: SourceDirection
    topics: tuple[Topic, ...]
    ranges: tuple[wire.Range, ...]


def target_of(topics: Topics, options: wire.Lay) -> InjectTarget:
    """Return the target that the options of an Inject call describe.

    Raises:
        PathError: There is no such source, or the patterns differ in source or direction.
        ValueRangeError: There is no target, there are too many patterns or ranges, or the direction
            is not valid.

    """
    if not (options.patterns or options.ranges):
        raise ValueRangeError("no pattern and no range is given; name the registers to inject into")
    for name, given in (("patterns", len(options.patterns)), ("ranges", len(options.ranges))):
        if given > MAX_PATTERNS:
            raise ValueRangeError(
                f"{given} {name} are given, but at most {MAX_PATTERNS} are allowed; use stars or structures"
            )
    found = tuple(dict.fromkeys(topics.topic(pattern) for pattern in options.patterns))
    places = {SourceDirection(topic.source, topic.direction == "in") for topic in found}
    if len({place.source for place in places}) > 1:
        raise PathError("an injection covers one source; create one for each source, each with its own stream")
    if len(places) > 1:
        raise PathError(f"{shorten(options.patterns[0])}, …: an injection covers /out or /in, not both")
    if options.direction not in wire.Direction.values():
        raise ValueRangeError(f"direction: {options.direction} is invalid; 0 is /out, 1 is /in")
    if options.source:
        topic = topics.topic(options.source)
        if topic.path or topic.direction:
            raise PathError(f"source: {shorten(options.source)} is not a source's name")
        places.add(
            SourceDirection(topic.source, places.pop().inward if places else options.direction == wire.DIRECTION_IN)
        )
    if len(places) != 1:
        raise PathError("source: this field is needed for ranges without a pattern")
    return InjectTarget(places.pop(), found, tuple(options.ranges))


class ByteRanges:
    """The byte ranges that an injection covers, in addition to registers. A range may have a mask of bits."""

    def __init__(self, ranges: Iterable[wire.Range], size: int) -> None:
        """Check the ranges.

        Args:
            ranges: The ranges of the request.
            size: Size of the block, in bytes.

        Raises:
            ValueRangeError: A range is empty or exceeds the block, or its mask exceeds a byte.

        """
        self._spans: list[tuple[slice, int]] = []
        self._bits = np.zeros(size, np.uint8)
        for one in ranges:
            if not one.size or one.offset + one.size > size:
                raise ValueRangeError(
                    f"ranges: expected at least one byte, within the block of {size} bytes; found {one.size} bytes "
                    f"from byte {one.offset} on"
                )
            if one.mask > 0xFF:
                raise ValueRangeError(f"ranges: the mask {one.mask} has more than 8 bits")
            span, mask = slice(one.offset, one.offset + one.size), one.mask or 0xFF
            self._spans.append((span, mask))
            self._bits[span] |= mask

    @property
    def bits(self) -> bytes:
        """An image-sized mask in which the bits of the ranges are set."""
        return self._bits.tobytes()

    @property
    def table(self) -> bytes:
        """The ranges as fields of a serialised ``Table``."""
        return b"".join(
            field(_RANGES, wire.Range(offset=span.start, size=span.stop - span.start, mask=mask).SerializeToString())
            for span, mask in self._spans
        )

    def differing(self, image: bytes, before: bytes | None) -> bytes:
        """Return the changed part of each range, as fields of an ``Update``: from its first to its last changed byte.

        If ``before`` is None, all bytes count as changed.
        """
        new = np.frombuffer(image, np.uint8)
        changed = np.full(len(image), 0xFF, np.uint8) if before is None else new ^ np.frombuffer(before, np.uint8)
        return b"".join(self._pieces(new, changed))

    def pieces(self, image: bytes, mask: bytes) -> bytes:
        """Return the masked part of each range, as fields of an ``Update``: from its first to its last masked byte."""
        return b"".join(self._pieces(np.frombuffer(image, np.uint8), np.frombuffer(mask, np.uint8)))

    def _pieces(self, image: Array, changed: Array) -> Iterator[bytes]:
        for span, mask in self._spans:
            places = np.flatnonzero(changed[span] & mask)
            if len(places):
                start, stop = span.start + int(places[0]), span.start + int(places[-1]) + 1
                data = (image[start:stop] & mask).tobytes()
                yield field(_PIECES, wire.Piece(offset=start, data=data, mask=mask).SerializeToString())


def raw_writes(pieces: Collection[wire.Piece], bits: bytes) -> list[Write]:
    """Convert raw bytes from a client to writes.

    Args:
        pieces: The raw bytes.
        bits: An image-sized mask in which the bits that the injection covers are set.

    Raises:
        ValueRangeError: The injection does not cover all of the bytes, or there are too many
            pieces.

    """
    if len(pieces) > MAX_VALUES:
        raise ValueRangeError(
            f"pieces: the message has {len(pieces)}, but at most {MAX_VALUES} are allowed; join adjacent pieces, or "
            "send them in several messages"
        )
    cover = np.frombuffer(bits, np.uint8)
    image, given = np.zeros(len(bits), np.uint8), np.zeros(len(bits), np.uint8)
    spans = []
    for piece in pieces:
        span = slice(piece.offset, piece.offset + len(piece.data))
        wanted = cover[span] & (piece.mask or 0xFF if piece.mask <= 0xFF else 0)
        if not piece.data or span.stop > len(bits) or not wanted.all():
            raise ValueRangeError(
                f"pieces: the injection does not cover all bits of bytes {piece.offset} to {span.stop - 1}"
            )
        image[span] ^= (image[span] ^ np.frombuffer(piece.data, np.uint8)) & wanted
        given[span] |= wanted
        spans.append((span.start, span.stop))
    return merge(image.tobytes(), given.tobytes(), spans)


class InjectCall(InjectionFollower):
    """An Inject call, with its injection."""

    def __init__(self, topics: Topics, selections: Selections, wake_ups: WakeUps, options: wire.Lay) -> None:
        """Check the request.

        Raises:
            PathError: There is no such source, or the patterns differ in source or direction.
            ValueRangeError: An option is not valid, or there is no target.

        """
        _check(options)
        self._topics = topics
        self._selections = selections
        self._wake_ups = wake_ups
        self._options = options
        self.over = ""
        """Why the call must end; empty if it need not.

        For example, another client has lifted the injection, or this client does not read.
        """
        self._lifted = self._ended = False
        self._lifting: asyncio.Task[None] | None = None
        self._target = target_of(topics, options)
        self._wake = asyncio.Event()
        self._waiting = SendQueue()  # serialised fields of an InjectResponse
        self.failure: ShmioError | None = None
        """The error in the client's messages that ended the call; None if no error ended it."""
        self._giving: set[asyncio.Task[None]] = set()
        self._room = asyncio.Semaphore(MAX_OPEN)
        self._shown: Frame | None = None
        self._shown_image = b""
        self._sent: Frame | None = None  # the frame of the last originals
        self._timer: asyncio.TimerHandle | None = None
        self._in_order = asyncio.Lock()

    @property
    def source(self) -> str:
        """Name of the source that the injection is over."""
        return self._target.place.source

    @property
    def _inward(self) -> bool:
        return self._target.place.inward

    async def open(self) -> bytes:
        """Create the injection, and return the first message.

        Raises:
            PathError: There is no such register.
            ValueRangeError: There are too many registers, or a range is not valid.
            CommandError: The source refused the injection, or does not answer.
            EndpointError: All clients together use too many registers.

        """
        self._view = view = await self._selections.registers({self._target.place: self._target.topics})
        size = view.block.layout.size
        self._ranges = ByteRanges(self._target.ranges, size)
        registers = covering(view.registers, size)
        self._bits = bytes(a | b for a, b in zip(registers, self._ranges.bits, strict=True))
        self._base = InjectionBase(view.block)
        self._commands = self._selections.commands(self.source)
        if self._commands.block is not view.block:
            raise CommandError(f"{self.source}: a reload changed this source concurrently; try again")
        options = self._options
        self._base.number = await command_client.inject(
            self._commands,
            self._bits,
            self,
            direction=Direction.IN if self._inward else Direction.OUT,
            priority=options.priority,
            keep=options.keep,
            name=options.name,
        )
        self.restack()
        if options.lifetime_ms:
            self._timer = asyncio.get_running_loop().call_later(options.lifetime_ms / 1000, self._end)
        if self._originals:
            self._wake_ups.join(view.block, self._wake.set)
        created = wire.Laid(number=self._base.number).SerializeToString()
        return field(1, created + field(2, view.table + self._ranges.table))

    @property
    def _originals(self) -> bool:
        """True if the call sends originals, and takes them from frames."""
        return not (self._inward or self._options.quiet)

    async def close(self) -> None:
        """Lift the injection, unless the client has asked to keep it. Retry until that succeeds."""
        for task in self._giving:
            task.cancel()
        if self._timer is not None:
            self._timer.cancel()
        if self._originals:
            self._wake_ups.leave(self._view.block, self._wake.set)
        number = self._base.number
        if self._options.keep or self._lifted:
            self._commands.followers.remove(number)
        else:
            self._lifting = self._lifting or self._lift()
            await self._lifting

    def _lift(self) -> asyncio.Task[None]:
        name = f"{self.source}: {self._options.name}"
        return asyncio.get_running_loop().create_task(
            command_client.have_lifted(self._commands, self._base.number, name)
        )

    def _end(self) -> None:
        self._ended = True
        self._wake.set()

    async def messages(self) -> AsyncIterator[bytes]:
        """Yield serialised InjectResponses, until the injection or its lifetime has ended."""
        while True:
            self._wake.clear()  # before the checks, so that no wake-up is lost
            if self._waiting:
                yield self._waiting.all()
            elif original := self._original():
                yield field(_ORIGINALS, original)
            elif self._ended or self.over:
                return
            else:
                await self._wake.wait()

    # ---- given values --------------------------------------------------------------------------

    async def take(self, requests: AsyncIterator[wire.InjectRequest]) -> None:
        """Send the values of the client's messages to the source, in order.

        If a message with a sequence number has an error, an answer reports the error. In a message
        without a sequence number, an error ends the stream.

        Raises:
            ValueRangeError: A message does not give values.

        """
        async for request in requests:
            if request.WhichOneof("what") != "shadow":
                raise ValueRangeError("the first message creates an injection, all others must give values")
            await self._room.acquire()
            task = asyncio.get_running_loop().create_task(self._give(request.shadow))
            self._giving.add(task)
            task.add_done_callback(self._given)
        await asyncio.gather(*self._giving, return_exceptions=True)
        self._end()

    def _given(self, task: asyncio.Task[None]) -> None:
        self._room.release()
        self._giving.discard(task)
        self.taken(task)

    def taken(self, task: asyncio.Task[None]) -> None:
        """End the stream if a task that handles the client's messages has failed."""
        if not task.cancelled() and isinstance(error := task.exception(), ShmioError):
            self.failure = error
            self._end()

    async def _give(self, shadow: wire.Shadow) -> None:
        try:
            async with self._in_order:  # no message may overtake a large one, which is read in time slices
                values, raw = await self._values(shadow)
            ends: Sequence[End] = await command_client.give(self._commands, self._base.number, values, raw)
        except ShmioError as error:
            if not shadow.sequence:
                raise
            self._answer(shadow, (EventKind.REJECTED, str(error)))
            return
        if shadow.sequence:
            self._answer(shadow, worst(ends))

    def _answer(self, shadow: wire.Shadow, end: End) -> None:
        answer = wire.Answer(sequence=shadow.sequence, outcome=outcome(*end))
        self._queue(field(_ANSWERS, answer.SerializeToString()))

    async def _values(self, shadow: wire.Shadow) -> tuple[Mapping[str, object], Sequence[Write]]:
        values = packed(shadow.values, self._view) if shadow.HasField("values") else {}
        if shadow.assignments:
            source, named = await decode_assignments(shadow.assignments, self._topics)
            if source != self.source:
                raise PathError(f"the injection covers {self.source}, but the values are for {source}")
            values |= named
        raw = raw_writes(shadow.pieces, self._bits)
        if not (values or raw):
            raise ValueRangeError("no value is given")
        return values, raw

    # ---- originals -----------------------------------------------------------------------------

    def _original(self) -> bytes | None:
        """Return an update with the changes of the image that the injection replaces.

        Returns:
            The serialised update, or None if nothing has changed.

        """
        if not self._originals:
            return None
        block, shown = self._view.block, self._shown
        frame = block.latest() if shown is None or block.ring.head() != shown.number else shown
        if frame is None:
            return None
        image = self._base.image(frame.raw)
        if shown is not None and image == self._shown_image and frame.quality == shown.quality:
            self._shown = frame
            return None
        before = self._shown_image if shown is not None and shown.source_ns else None
        body, statuses = b"", NO_STATUSES
        if frame.source_ns:
            columns = self._view.columns
            values = pack(columns.decode(image), None if before is None else columns.decode(before))
            body = (field(VALUES, values) if values else b"") + self._ranges.differing(image, before)
            statuses = self._view.statuses(frame, None if before is None else self._sent)
        quality = shown is None or frame.quality != shown.quality
        self._shown, self._shown_image = frame, image
        if not (body or quality or statuses.codes):
            return None
        self._sent = frame
        return head(self._view.number, frame, whole=before is None) + body + statuses.field

    def divert(self, diverted: CommandWrites) -> None:
        """Handle diverted values: over ``/in`` those of writers, over ``/out`` those of inner injections."""
        self._base.divert(diverted.writes)
        if not self._inward:
            self.restack()
        elif not self._options.quiet:
            mask = bytearray(len(self._bits))
            apply(mask, (write._replace(data=b"\xff" * len(write.data)) for write in diverted.writes))
            image, changed = bytes(self._base.given), bytes(mask)
            columns = self._view.columns
            values = pack_slots(columns.decode(image), columns.of_bits(changed))
            body = (field(VALUES, values) if values else b"") + self._ranges.pieces(image, changed)
            self._queue(field(_ORIGINALS, head_of(self._view.number, diverted.event) + body))

    def _queue(self, message: bytes) -> None:
        if not self.over and (reason := self._waiting.add(message)):
            self._give_up(reason)
        self._wake.set()

    def _give_up(self, reason: str) -> None:
        """Lift the injection at once: a client that does not read could delay the stream's end."""
        self.over = self.over or reason
        if self._base.number and not (self._options.keep or self._lifted):
            self._lifting = self._lifting or self._lift()
        self._wake.set()

    def restack(self) -> None:
        """Handle a change of the source's injections, this one included."""
        if not self._inward:
            self._base.restack()
            self._wake.set()

    def lifted(self, reason: str) -> None:
        """Handle the end of the injection, if this call did not request it."""
        self._lifted = True
        self.over = f"it was lifted: {reason}" if reason != "lifted" else "another program has lifted it"
        self._wake.set()

    def fail(self, reason: str) -> None:
        """Handle the loss of events. Over ``/in``, end the call, because writes are missing.

        Over ``/out``, nothing is missing, because the originals come from frames.
        """
        if self._inward and not self._options.quiet:
            self._give_up(reason)


def _check(options: wire.Lay) -> None:
    """Raise ValueRangeError if options are not valid or exclude each other."""
    if len(options.name.encode()) > MAX_NAME_BYTES:
        raise ValueRangeError(f"name: at most {MAX_NAME_BYTES} bytes are allowed")
    if options.lifetime_ms > MAX_LIFETIME_MS:
        raise ValueRangeError(f"lifetime_ms: at most {MAX_LIFETIME_MS} (a day) is allowed")
    if options.keep and options.lifetime_ms:
        raise ValueRangeError("keep and lifetime_ms exclude each other: a kept injection stays until somebody lifts it")


class InjectionCalls:
    """Serves the calls about injections."""

    def __init__(self, topics: Topics, feeds: Mapping[str, Feed], selections: Selections, wake_ups: WakeUps) -> None:
        self._topics = topics
        self._feeds = feeds
        self._selections = selections
        self._wake_ups = wake_ups
        self._open: set[InjectCall | DeclareCall] = set()
        self._lock = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handlers of these calls, by name."""
        unary = grpc.unary_unary_rpc_method_handler
        return {
            "Inject": grpc.stream_stream_rpc_method_handler(self.inject, wire.InjectRequest.FromString),
            "Declare": grpc.unary_stream_rpc_method_handler(self.declare, wire.DeclareRequest.FromString),
            "ListInjections": unary(
                self.list_injections,
                wire.ListInjectionsRequest.FromString,
                wire.ListInjectionsResponse.SerializeToString,
            ),
            "Lift": unary(self.lift, wire.LiftRequest.FromString, wire.LiftResponse.SerializeToString),
            "LiftAll": unary(self.lift_all, wire.LiftAllRequest.FromString, wire.LiftResponse.SerializeToString),
        }

    async def inject(self, requests: AsyncIterator[wire.InjectRequest], context: Context) -> AsyncIterator[bytes]:
        """Create an injection that ends with the stream, unless the client has asked to keep it.

        The call streams the originals to the client. The client streams values to replace them.

        Statuses:
            NOT_FOUND: There is no such register.
            INVALID_ARGUMENT: The injection is not valid, or does not cover a given value.
            FAILED_PRECONDITION: The source refuses the injection; the message says why.
            RESOURCE_EXHAUSTED: There are too many streams.
            ABORTED: Another client has lifted the injection, or this client does not read the
                originals.
        """
        opening: asyncio.Task[bytes] | None = None
        taking: asyncio.Task[None] | None = None
        try:
            injection = await self._injection(requests)
            opening = asyncio.get_running_loop().create_task(injection.open())
            yield await asyncio.shield(opening)
            taking = asyncio.get_running_loop().create_task(injection.take(requests))
            taking.add_done_callback(injection.taken)
            async for message in injection.messages():
                yield message
            taking.cancel()
            await asyncio.shield(self._spawn(self._close(injection, opening)))  # lift it before the stream ends
            opening = None
        except ShmioError as error:
            await refuse(context, error)
        finally:
            if taking is not None:
                taking.cancel()
            if opening is not None:
                self._spawn(self._close(injection, opening))
        if injection.failure is not None:
            await refuse(context, injection.failure)
        if injection.over:
            await context.abort(grpc.StatusCode.ABORTED, f"{injection.source}: {injection.over}")

    async def _injection(self, requests: AsyncIterator[wire.InjectRequest]) -> InjectCall:
        """Read the first message, and return its call.

        Raises:
            PathError: There is no such source, or the patterns differ in source or direction.
            ValueRangeError: The message does not create an injection, or an option is not valid.
            EndpointError: There are too many calls.

        """
        self._check_room()
        async for request in requests:
            if request.WhichOneof("what") == "lay":
                injection = InjectCall(self._topics, self._selections, self._wake_ups, request.lay)
                self._open.add(injection)
                return injection
            break
        raise ValueRangeError("the first message of Inject must create an injection, all others give values")

    def _check_room(self) -> None:
        """Raise EndpointError if there are too many calls."""
        if len(self._open) >= MAX_INJECTIONS:
            raise EndpointError(
                f"{MAX_INJECTIONS} calls of Inject and Declare are open, which is the maximum; end one first"
            )

    async def _close(self, one: InjectCall | DeclareCall, opening: asyncio.Task[bytes]) -> None:
        try:
            await asyncio.wait((opening,))
            if not opening.cancelled() and opening.exception() is None:
                await one.close()
        finally:
            self._open.discard(one)

    async def declare(self, request: wire.DeclareRequest, context: Context) -> AsyncIterator[bytes]:
        """Create declared injections: all or none.

        The injections end with the stream, unless the client has asked to keep them. The call
        streams a record of their events.

        Statuses:
            INVALID_ARGUMENT: A declaration is not valid; the message names the key.
            FAILED_PRECONDITION: A source refuses an injection; the message says why.
            RESOURCE_EXHAUSTED: There are too many streams.
            ABORTED: The client does not read the record, or the record would have a gap.
        """
        opening: asyncio.Task[bytes] | None = None
        try:
            self._check_room()
            campaign = DeclareCall(self._feeds, request, self._lock)
            self._open.add(campaign)
            opening = asyncio.get_running_loop().create_task(campaign.open())
            yield await asyncio.shield(opening)
            async for message in campaign.messages():
                yield message
        except ShmioError as error:
            await refuse(context, error)
        finally:
            if opening is not None:
                campaign.abandon()
                self._spawn(self._close(campaign, opening))
        if campaign.over:
            await context.abort(grpc.StatusCode.ABORTED, campaign.over)

    async def list_injections(
        self, request: wire.ListInjectionsRequest, context: Context
    ) -> wire.ListInjectionsResponse:
        """List the injections on the requested sources; on all sources if the request names none.

        Statuses:
            NOT_FOUND: There is no such source.
        """
        found = wire.ListInjectionsResponse()
        try:
            for block in self._topics.blocks(request.sources):
                found.injections.extend(_describe(block, one) for one in block.injections.read())
        except ShmioError as error:
            await refuse(context, error)
        return found

    async def lift(self, request: wire.LiftRequest, context: Context) -> wire.LiftResponse:
        """Lift one injection.

        Statuses:
            NOT_FOUND: There is no such injection.
            FAILED_PRECONDITION: The source does not answer.
        """
        try:
            (block,) = self._topics.blocks([request.source])
            present = [one for one in block.injections.read() if one.number == request.number and not one.lifted]
            if not present:
                raise PathError(f"{request.source}: there is no injection {request.number}; ListInjections lists them")
            lifted = await self._lift(block, present[0])
            if lifted.failure:
                raise CommandError(f"{request.source}: {lifted.failure}")
            return wire.LiftResponse(lifted=[lifted])
        except ShmioError as error:
            await refuse(context, error)

    async def lift_all(self, request: wire.LiftAllRequest, context: Context) -> wire.LiftResponse:
        """Lift all injections on the requested sources; on all sources if the request names none.

        The answer gives the reason for each injection that was not lifted.

        Statuses:
            NOT_FOUND: There is no such source.
        """
        try:
            blocks = self._topics.blocks(request.sources)
        except ShmioError as error:
            await refuse(context, error)
        present = [(block, one) for block in blocks for one in block.injections.read() if not one.lifted]
        lifted = await asyncio.gather(*(self._lift(block, one) for block, one in present))
        return wire.LiftResponse(lifted=lifted)

    async def _lift(self, block: Block, one: InjectionEntry) -> wire.Lifted:
        failure = await command_client.lift(self._topics.feed(block.source).commands, one.number)
        return wire.Lifted(source=block.source, number=one.number, name=one.name, failure=failure)

    def _spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _describe(block: Block, one: InjectionEntry) -> wire.Injection:
    """Convert an injection on a block to a message."""
    return wire.Injection(
        source=block.source,
        number=one.number,
        direction=wire.DIRECTION_IN if one.direction == "in" else wire.DIRECTION_OUT,
        priority=one.priority,
        keep=one.keep,
        name=one.name,
        pid=one.pid,
        writer=one.writer,
        ranges=[wire.Range(offset=offset, size=size, mask=mask) for offset, size, mask in one.ranges],
        running=None if one.running is None else _running(one.running),
        cell=one.cell,
    )


def _running(running: Running[Declaration]) -> wire.Running:
    """Convert the state of a declared injection to a message."""
    declaration = running.declaration
    return wire.Running(
        declaration=declaration_to_wire(msgspec.to_builtins(declaration), declaration.name),
        state=f"STATE_{running.state.upper()}",
        seed=running.seed,
        runs=running.runs,
        cycle=running.cycle,
        time_ns=running.time_ns,
    )
