"""Inject: a stream that lays an injection, is shown what it stands over, and gives other values instead."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Mapping, Sequence
from typing import Final

import numpy as np

from shmio.endpoints.grpc.bells import Bells
from shmio.endpoints.grpc.encoding import field
from shmio.endpoints.grpc.native.columns import pack, pack_slots
from shmio.endpoints.grpc.native.desk import Desk, End
from shmio.endpoints.grpc.native.selection import MAX_PATTERNS, Selections
from shmio.endpoints.grpc.native.values import assigned, outcome, packed
from shmio.endpoints.grpc.native.views import VALUES, head
from shmio.endpoints.grpc.topics import Topics
from shmio.errors import PathError, ShmioError, ValueRangeError
from shmio.layout.topic import Topic, shorten
from shmio.segment import DONE, Direction, EventKind, Frame
from shmio.segment.commands import MAX_NAME_BYTES
from shmio.segment.diverted import Diverted, apply
from shmio.wire import shmio_v1_pb2 as wire

MAX_OPEN: Final = 32
"""Values of one stream that are under way; what comes beyond waits."""
MAX_WAITING: Final = 4096
"""What was written over ``/in`` and waits to be read."""
MAX_LIFETIME_MS: Final = 86_400_000
RETRY_S: Final = 0.25
"""How soon a source that has not lifted an injection is told again."""

_ORIGINALS, _ANSWERS = (wire.InjectResponse.DESCRIPTOR.fields_by_name[name].number for name in ("originals", "answers"))


class Injection:
    """One call of Inject. It is a follower of its block's events."""

    def __init__(self, topics: Topics, selections: Selections, bells: Bells, lay: wire.Lay) -> None:
        """PathError, ValueRangeError: as of the request."""
        self._topics = topics
        self._selections = selections
        self._bells = bells
        self._lay = lay
        self.over = ""
        """Why it stands no more, if it was somebody else who lifted it, or nobody reads what it stands over."""
        self._ended = False
        self._wanted, self._direction = _target(topics, lay)
        self._news = asyncio.Event()
        self._waiting: deque[bytes] = deque()  # serialised fields of an InjectResponse
        self.failure: ShmioError | None = None
        """What is wrong with what the client sends."""
        self._giving: set[asyncio.Task[None]] = set()
        self._room = asyncio.Semaphore(MAX_OPEN)
        self._shown: Frame | None = None
        self._shown_image = b""
        self._inner: tuple[bytes, bytes] | None = None  # over /out: bits that injections further in give, and values
        self._diverted = bytearray()
        self._timer: asyncio.TimerHandle | None = None
        self.number = 0

    @property
    def source(self) -> str:
        """Whose registers it stands over."""
        return next(iter(self._wanted))

    async def open(self, desk: Desk) -> bytes:
        """Lay it; the first message. PathError, ValueRangeError, CommandError, EndpointError."""
        view = await self._selections.registers(self._wanted)
        self._view, self._desk = view, desk
        self._diverted = bytearray(view.block.layout.size)
        lay = self._lay
        self.number = await desk.lay(
            view.registers, self, direction=self._direction, priority=lay.priority, keep=lay.keep, name=lay.name
        )
        self.restack()
        if lay.lifetime_ms:
            self._timer = asyncio.get_running_loop().call_later(lay.lifetime_ms / 1000, self._end)
        if self._direction is Direction.OUT and not lay.quiet:
            self._bells.join(view.block, self._news.set)
        laid = wire.Laid(number=self.number).SerializeToString() + field(2, view.table)
        return field(1, laid)

    async def close(self) -> None:
        """Lift it, unless it is to be kept. It goes on until the source has: nobody else would."""
        for task in self._giving:
            task.cancel()
        if self._timer is not None:
            self._timer.cancel()
        if self._direction is Direction.OUT and not self._lay.quiet:
            self._bells.leave(self._view.block, self._news.set)
        self._desk.forget(self.number)
        if self._lay.keep or self.over:
            return
        while await self._desk.lift(self.number):  # noqa: ASYNC110  the source has to be told again
            await asyncio.sleep(RETRY_S)

    def _end(self) -> None:
        self._ended = True
        self._news.set()

    async def messages(self) -> AsyncIterator[bytes]:
        """Serialised InjectResponses, until it is over or its time is."""
        while True:
            self._news.clear()  # before looking
            if self._waiting:
                batch, self._waiting = b"".join(self._waiting), deque()
                yield batch
            elif original := self._original():
                yield field(_ORIGINALS, original)
            elif self._ended or self.over:
                return
            else:
                await self._news.wait()

    # ---- up: what the client gives -----------------------------------------------------------------------------

    async def take(self, requests: AsyncIterator[wire.InjectRequest]) -> None:
        """Take the client's values in order. ValueRangeError, PathError: a message that cannot be answered is wrong."""
        async for request in requests:
            if request.WhichOneof("what") != "shadow":
                raise ValueRangeError("an injection is laid by the first message, all others give values")
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
        """A task that takes values has ended: with an error, so has the stream."""
        if not task.cancelled() and isinstance(error := task.exception(), ShmioError):
            self.failure = error
            self._end()

    async def _give(self, shadow: wire.Shadow) -> None:
        try:
            ends: Sequence[End] = await self._desk.give(self.number, self._values(shadow))
        except ShmioError as error:
            if not shadow.sequence:
                raise
            self._answer(shadow, (EventKind.REJECTED, str(error)))
            return
        if shadow.sequence:
            self._answer(shadow, _worst(ends))

    def _answer(self, shadow: wire.Shadow, end: End) -> None:
        answer = wire.Answer(sequence=shadow.sequence, outcome=outcome(*end))
        self._waiting.append(field(_ANSWERS, answer.SerializeToString()))
        self._news.set()

    def _values(self, shadow: wire.Shadow) -> Mapping[str, object]:
        values = packed(shadow.values, self._view) if shadow.HasField("values") else {}
        if shadow.assignments:
            source, named = assigned(shadow.assignments, self._topics)
            if source != self.source:
                raise PathError(f"the injection is over {self.source}, the values are for {source}")
            values |= named
        if not values:
            raise ValueRangeError("no value is given")
        return values

    # ---- down: what it stands over -----------------------------------------------------------------------------

    def _original(self) -> bytes | None:
        """Over ``/out``: what differs in the newest image beneath it from the one shown before."""
        if self._direction is Direction.IN or self._lay.quiet:
            return None
        block, shown = self._view.block, self._shown
        frame = block.latest() if shown is None or block.ring.head() != shown.number else shown
        if frame is None:
            return None
        image = self._beneath(frame)
        if shown is not None and image == self._shown_image and frame.quality == shown.quality:
            self._shown = frame
            return None
        columns = self._view.columns
        old = columns.decode(self._shown_image) if shown is not None and shown.source_ns else None
        values = pack(columns.decode(image), old) if frame.source_ns else b""
        quality = shown is None or frame.quality != shown.quality
        self._shown, self._shown_image = frame, image
        if not values and not quality:
            return None
        return head(self._view.number, frame, whole=old is None) + (field(VALUES, values) if values else b"")

    def _beneath(self, frame: Frame) -> bytes:
        """An image as this injection finds it: what the source delivers, or injections further in give."""
        if self._inner is None:
            return frame.raw
        raw, bits, values = (np.frombuffer(part, np.uint8) for part in (frame.raw, *self._inner))
        return (raw ^ (raw ^ values) & bits).tobytes()

    def divert(self, diverted: Diverted) -> None:
        """A command's values went to it: over ``/in`` what was written, over ``/out`` what others further in give."""
        apply(self._diverted, diverted.writes)
        if self._direction is Direction.OUT:
            self.restack()
            return
        if self._lay.quiet:
            return
        if len(self._waiting) >= MAX_WAITING:
            self.over = f"{MAX_WAITING} messages wait to be read: the client is too slow for what is written"
            self._news.set()
            return
        mask = bytearray(len(self._diverted))
        apply(mask, (write._replace(data=b"\xff" * len(write.data)) for write in diverted.writes))
        columns = self._view.columns
        values = pack_slots(columns.decode(bytes(self._diverted)), columns.touched(bytes(mask)))
        event = diverted.event
        update = wire.Update(
            table=self._view.number,
            frame=event.frame,
            cycle=event.cycle,
            incarnation=event.incarnation,
            clock_ns=event.clock_ns,
            source_ns=event.utc_ns,
            quality=wire.QUALITY_GOOD,
        ).SerializeToString()
        self._waiting.append(field(_ORIGINALS, update + field(VALUES, values)))
        self._news.set()

    def restack(self) -> None:
        """An injection was laid or lifted, on the same source."""
        if not self.number:  # it is not known yet which is this one
            return
        bits = np.zeros(len(self._diverted), np.uint8)
        for one in self._view.block.standing.read():
            if one.id == self.number:
                break
            if one.direction == "out":
                for offset, size, mask in one.ranges:
                    bits[offset : offset + size] |= mask
        self._inner = (bits.tobytes(), bytes(self._diverted)) if bits.any() else None
        self._news.set()

    def lifted(self, reason: str) -> None:
        """It was lifted, and not by this stream."""
        self.over = f"it was lifted: {reason}" if reason != "lifted" else "somebody has lifted it"
        self._news.set()


def _target(topics: Topics, lay: wire.Lay) -> tuple[Mapping[str, Sequence[Topic]], Direction]:
    """What it is to stand over. PathError, ValueRangeError."""
    if not lay.patterns:
        raise ValueRangeError("no pattern is given: an injection stands over something")
    if len(lay.patterns) > MAX_PATTERNS:
        raise ValueRangeError(f"{len(lay.patterns)} patterns, {MAX_PATTERNS} are the most: use stars, or structures")
    if len(lay.name.encode()) > MAX_NAME_BYTES:
        raise ValueRangeError(f"name: at most {MAX_NAME_BYTES} bytes")
    if lay.lifetime_ms > MAX_LIFETIME_MS:
        raise ValueRangeError(f"lifetime_ms: at most {MAX_LIFETIME_MS}, a day")
    if lay.keep and lay.lifetime_ms:
        raise ValueRangeError("keep and lifetime_ms: what is kept stays until somebody lifts it")
    found = [topics.topic(pattern) for pattern in lay.patterns]
    if len({topic.source for topic in found}) > 1:
        raise PathError("one injection is over one source: lay one for each, with a stream each")
    directions = {topic.direction or "out" for topic in found}
    if len(directions) > 1:
        raise PathError(f"{shorten(lay.patterns[0])}, …: an injection is over /out or over /in, not over both")
    direction = Direction.IN if directions == {"in"} else Direction.OUT
    return {found[0].source: tuple(dict.fromkeys(found))}, direction


def _worst(ends: Sequence[End]) -> End:
    """One end for all, for neighbours went as one: the first that is not what was wanted."""
    return next((end for end in ends if end[0] not in DONE), ends[0])
