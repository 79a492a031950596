"""Views of a block: a table of registers, or raw frames, with the updates made of frames and writes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from shmio.endpoints.grpc.commands.write_subscriptions import PendingImage, ones
from shmio.endpoints.grpc.encoding import field, number
from shmio.endpoints.grpc.shmio_v1.columns import Columns, DecodedImage, column_of, merge, pack, pack_slots
from shmio.layout.model import Register
from shmio.layout.values.write import covering
from shmio.model.values import Column
from shmio.segment import Block, Event, Frame
from shmio.segment.commands import NO_COMMAND, apply
from shmio.segment.events import EVENT_DATA_SIZE
from shmio.wire import shmio_v1_pb2 as wire

VALUES, ORIGINALS, INVALID, INJECTED, IMAGE, ORIGINAL, QUALITY, REASON, MISSED, AGE_NS = (
    wire.Update.DESCRIPTOR.fields_by_name[name].number
    for name in (
        "values", "originals", "invalid", "injected", "image", "original", "quality", "reason", "missed", "age_ns",
    )
)  # fmt: skip

_QUALITY_BAD: Final = number(QUALITY, 0)  # as the last field it wins over the frame's own quality
_CACHED: Final = 8
_NO_PLACES: Final = np.zeros(0, "<u4")

Places = np.ndarray[Any, np.dtype[Any]]


class UpdateMessage(NamedTuple):
    """A serialised ``Update`` in two parts. ``body``: the changes; empty if there are none."""

    head: bytes
    body: bytes


class WriteUpdates:
    """Encodes writes to a table's registers, once for all subscribers. For the loop's thread."""

    def __init__(self, number: int, block: Block, registers: Sequence[Register], columns: Columns) -> None:
        """``number`` is that of the table."""
        self._number = number
        self._block = block
        self._columns = columns
        self._cover = np.frombuffer(covering(registers, block.layout.size), np.uint8)
        self._pending_image = PendingImage(block)
        self._command = NO_COMMAND
        self._event = 0
        self._update = b""

    def of(self, event: Event) -> bytes:
        """Return the serialised ``Update`` of an accepted write; empty: it is not in the table.

        If an element is written in part, the rest is taken from the frame before the command. An
        element that the command's next event completes is left to that event.
        """
        if event.number != self._event:
            self._event, self._update = event.number, self._make(event)
        return self._update

    def _make(self, event: Event) -> bytes:
        if event.command_key != self._command:
            self._command = event.command_key
            self._pending_image.begin(event.frame)
        self._pending_image.put(event)
        image, mask = self._pending_image.image, self._pending_image.mask
        part = bytearray(len(mask))
        apply(part, (ones(event),))
        if not (np.frombuffer(part, np.uint8) & self._cover).any():
            return b""
        slots = self._columns.touched(bytes(part))
        if len(event.data) == EVENT_DATA_SIZE:
            left = self._columns.touched(bytes(bits ^ 0xFF for bits in mask))
            whole = {column: np.setdiff1d(found, left[column]) for column, found in slots.items() if column in left}
            slots = {column: found for column, found in (slots | whole).items() if len(found)}
        if not slots:
            return b""
        return head_of(self._number, event) + field(VALUES, pack_slots(self._columns.decode(bytes(image)), slots))


class Selection:
    """A table of registers of one block; it makes updates of frames, once for all subscribers.

    After creation it is for the event loop's thread.
    """

    def __init__(self, number: int, block: Block, registers: Sequence[Register], *, inward: bool = False) -> None:
        """``inward``: the table is for writes to the registers."""
        self.number = number
        self.inward = inward
        self.block = block
        self.registers = tuple(registers)
        self.elements = sum(register.count for register in registers)
        self.columns = Columns(registers, block.layout.byte_order)
        self._decoded: OrderedDict[int, DecodedImage] = OrderedDict()
        self._updates: OrderedDict[tuple[int, int], UpdateMessage] = OrderedDict()
        self._injected_places: OrderedDict[int, Places] = OrderedDict()

    @cached_property
    def writes(self) -> WriteUpdates:
        """Makes the updates about writes to the registers."""
        return WriteUpdates(self.number, self.block, self.registers, self.columns)

    @cached_property
    def table(self) -> bytes:
        """The serialised ``Table``."""
        table = wire.Table(
            number=self.number,
            source=self.block.source,
            section=self.block.section,
            hash=self.block.layout.hash,
            size=self.block.layout.size,
            slots=[0, *self.columns.sizes.values()],
            direction=wire.DIRECTION_IN if self.inward else wire.DIRECTION_OUT,
        )
        for register, (column, slot) in zip(self.registers, self.columns.places, strict=True):
            describe(register, table.registers.add(), column, slot)
        return table.SerializeToString()

    def decode(self, frame: Frame) -> DecodedImage:
        """Decode a frame as consumers see it, with injections; cached."""
        found = self._decoded.get(frame.number)
        if found is None:
            found = self._decoded[frame.number] = self.columns.decode(frame.image)
            _trim(self._decoded)
        return found

    def update(self, frame: Frame, before: Frame | None = None) -> UpdateMessage:
        """Return an ``Update`` with the changes since ``before``, or with everything; cached.

        Its quality is the one that the frame was published with.
        """
        if before is not None and not before.source_ns:
            before = None
        key = frame.number, before.number if before else 0
        found = self._updates.get(key)
        if found is None:
            old = self.decode(before) if before else None
            found = self._updates[key] = self._update(frame, before, self.decode(frame), old)
            _trim(self._updates)
        return found

    def update_beyond(
        self, frame: Frame, before: Frame, sent: DecodedImage, deadband: float
    ) -> tuple[UpdateMessage, DecodedImage]:
        """Return an ``Update`` with a dead-band, and what the receiver has after it.

        ``sent``: what the receiver has now.
        """
        new = self.decode(frame)
        return self._update(frame, before, new, sent, deadband), merge(new, sent, deadband)

    def _update(
        self, frame: Frame, before: Frame | None, new: DecodedImage, old: DecodedImage | None, deadband: float = 0.0
    ) -> UpdateMessage:
        parts = []
        if frame.source_ns:
            if values := pack(new, old, deadband):
                parts.append(field(VALUES, values))
            if old is None or new.invalid != old.invalid:
                parts.append(field(INVALID, field(1, np.array(new.invalid, "<u4").tobytes())))
        now = self.injected(frame)
        if before is None or (now is not (was := self.injected(before)) and not np.array_equal(now, was)):
            parts.append(field(INJECTED, field(1, now.tobytes())))
        return UpdateMessage(head(self.number, frame, whole=before is None), b"".join(parts))

    def originals(self, frame: Frame) -> bytes:
        """Return the serialised ``Values`` as the source delivered them."""
        return pack(self.columns.decode(frame.raw))

    def injected(self, frame: Frame) -> Places:
        """Return the indices of registers under an injection over ``/out``; cached by event."""
        if frame.effective is None:
            return _NO_PLACES
        found = self._injected_places.get(frame.event)  # injections change only with an event
        if found is None:
            found = self._injected_places[frame.event] = self._under_injections()
            _trim(self._injected_places)
        return found

    def _under_injections(self) -> Places:
        cover = np.zeros(self.block.layout.size, np.uint8)
        for standing in self.block.standing.read():
            if standing.direction == "out" and standing.active:
                for offset, size, mask in standing.ranges:
                    cover[offset : offset + size] |= mask
        starts, stops, masks = self._extents
        covered = np.concatenate(([0], np.cumsum(cover != 0)))
        hit = np.where(masks, cover[starts] & masks, covered[stops] - covered[starts])
        return np.flatnonzero(hit).astype("<u4")

    @cached_property
    def _extents(self) -> tuple[Places, ...]:
        """For each register, its first byte, the byte after its last, and a single bit's mask."""
        starts = [register.offset for register in self.registers]
        stops = [register.offset + register.size for register in self.registers]
        masks = [0 if register.bit is None or register.dims else 1 << register.bit for register in self.registers]
        return tuple(np.array(numbers, np.intp) for numbers in (starts, stops, masks))


class RawFrames:
    """A view of a block's raw frames, with the methods of a :class:`Selection`."""

    def __init__(self, number: int, block: Block) -> None:
        self.number = number
        self.block = block
        self.elements = 0
        self._updates: OrderedDict[int, UpdateMessage] = OrderedDict()

    @cached_property
    def table(self) -> bytes:
        """The serialised ``Table``."""
        layout = self.block.layout
        return wire.Table(
            number=self.number,
            source=self.block.source,
            section=self.block.section,
            hash=layout.hash,
            size=layout.size,
        ).SerializeToString()

    def update(self, frame: Frame, before: Frame | None = None) -> UpdateMessage:  # noqa: ARG002  a frame is always whole
        """Return an ``Update`` with the image, and with the original one under an injection."""
        found = self._updates.get(frame.number)
        if found is None:
            body = field(IMAGE, frame.image) if frame.source_ns else b""
            if frame.source_ns and frame.effective is not None:
                body += field(ORIGINAL, frame.raw)
            found = self._updates[frame.number] = UpdateMessage(head(self.number, frame, whole=True), body)
            _trim(self._updates)
        return found


View = Selection | RawFrames


def head(table: int, frame: Frame, *, whole: bool = False) -> bytes:
    """Return a frame's serialised ``Update`` without values."""
    return wire.Update(
        table=table,
        frame=frame.number,
        cycle=frame.cycle,
        incarnation=frame.incarnation,
        clock_ns=frame.clock_ns,
        source_ns=frame.source_ns,
        quality=int(frame.quality),  # type: ignore[arg-type]  # enums of the wire are its own to mypy
        reason=frame.reason,
        provenance=int(frame.provenance),  # type: ignore[arg-type]
        whole=whole,
    ).SerializeToString()


def head_of(table: int, event: Event) -> bytes:
    """Return a serialised ``Update`` for an event, without values."""
    return wire.Update(
        table=table,
        frame=event.frame,
        cycle=event.cycle,
        incarnation=event.incarnation,
        clock_ns=event.clock_ns,
        source_ns=event.utc_ns,
        quality=wire.QUALITY_GOOD,
    ).SerializeToString()


def stale_fields(reason: str) -> bytes:
    """Return the addition to a frame's update that reports the frame as stale."""
    return _QUALITY_BAD + field(REASON, reason.encode())


def describe(register: Register, found: wire.Register, column: Column | None = None, slot: int = 0) -> None:
    """Fill in a message with a register's description."""
    found.path, found.type = register.path, register.type
    found.offset, found.size, found.count = register.offset, register.size, register.count
    found.column = int(column or column_of(register.element))  # type: ignore[assignment]
    found.slot = slot
    if register.bit is not None:
        found.bit = register.bit
    for low, high in register.dims:
        found.dims.add(low=low, high=high)


def _trim(cache: OrderedDict[Any, Any]) -> None:
    while len(cache) > _CACHED:
        cache.popitem(last=False)
