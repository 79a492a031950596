"""Tables of registers. They make updates, packed by type, from a block's frames and writes.

A table of registers is one kind of view of a block; raw frames are the other kind. Numpy packs an
image into one array for each type, and compares two images. All subscribers to a table share its
updates.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from shmio.endpoints.grpc.commands.write_subscriptions import PendingImage, ones
from shmio.endpoints.grpc.encoding import field, number
from shmio.layout.model import ByteOrder, ElementType, Register, bit_positions
from shmio.layout.values.codec import Buffer, Scalar, scalar_codec
from shmio.layout.values.write import bits_of, covering
from shmio.model.statuses import StatusArea
from shmio.model.values import Column
from shmio.segment import Block, Event, Frame
from shmio.segment.commands import NO_COMMAND, apply
from shmio.segment.events import EVENT_DATA_SIZE
from shmio.wire import shmio_v1_pb2 as wire

VALUES, ORIGINALS, INVALID, INJECTED, IMAGE, ORIGINAL, QUALITY, REASON, MISSED, AGE_NS, STATUSES = (
    wire.Update.DESCRIPTOR.fields_by_name[name].number
    for name in (
        "values", "originals", "invalid", "injected", "image", "original", "quality", "reason", "missed", "age_ns",
        "statuses",
    )
)  # fmt: skip

_QUALITY_BAD: Final = number(QUALITY, 0)  # appended to an update: the last occurrence of a field counts
_CACHED: Final = 8
_NO_PLACES: Final = np.zeros(0, "<u4")

Array = np.ndarray[Any, np.dtype[Any]]


_COLUMNS: Final = {
    **dict.fromkeys("bBhHi", Column.INT32),
    **dict.fromkeys("Iq", Column.INT64),
    "Q": Column.UINT64,
    "f": Column.FLOAT,
    "d": Column.DOUBLE,
}
_BY_BASE: Final = {
    "BOOL": Column.BOOL, "TIME_OF_DAY": Column.INT32, "S5TIME": Column.INT32, "LTOD": Column.INT64,
}  # fmt: skip
KINDS: Final[Mapping[Column, np.dtype[Any]]] = {
    Column.BOOL: np.dtype("u1"),
    Column.INT32: np.dtype("<i4"),
    Column.INT64: np.dtype("<i8"),
    Column.UINT64: np.dtype("<u8"),
    Column.FLOAT: np.dtype("<f4"),
    Column.DOUBLE: np.dtype("<f8"),
}
"""Type of the elements in the packed field of each column."""
_BITS: Final = {column: np.dtype(f"<u{kind.itemsize}") for column, kind in KINDS.items()}


def column_of(element: ElementType) -> Column:
    """Return the column that holds values of a type."""
    return _BY_BASE.get(element.base) or _COLUMNS.get(scalar_codec(element).plain, Column.TEXT)


class DecodedImage(NamedTuple):
    """The values of all elements of an image.

    Attributes:
        arrays: Numbers and bits, by column.
        texts: Texts.
        invalid: Indices of the registers whose bytes are not a valid value.
    """

    arrays: Mapping[Column, Array]
    texts: tuple[str, ...]
    invalid: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _NumberGroup:
    """Numeric elements of one type.

    ``offsets`` has the offset of each byte of each element, the least significant byte first. Its
    shape is (elements, size). ``stored`` is the type of the elements in the image. ``start`` is the
    offset of the first element if all follow one another without gaps, otherwise None.
    """

    slots: slice
    offsets: Array
    kind: np.dtype[Any]
    stored: np.dtype[Any]
    start: int | None

    def decode(self, image: bytes) -> Array:
        """Decode the elements. Without gaps and in little-endian order, the array is a view of the image."""
        if self.start is None:
            return np.frombuffer(image, np.uint8)[self.offsets].view(self.kind)[:, 0]
        found = np.frombuffer(image, self.stored, len(self.offsets), self.start)
        return found if self.stored is self.kind else found.astype(self.kind)


@dataclass(frozen=True, slots=True)
class _SingleElement:
    """An element that is decoded by itself; ``register`` is the index of its register."""

    column: Column
    slot: int
    register: int
    decode: Callable[[Buffer, int], Scalar]
    offset: int
    size: int


class _SingleValues(NamedTuple):
    """Values of the elements that are decoded one by one.

    ``invalid`` has the indices of the elements without a valid value. ``places`` has the indices of
    these elements' registers.
    """

    numbers: Mapping[Column, Mapping[int, Any]]
    texts: tuple[str, ...]
    invalid: frozenset[int]
    places: tuple[int, ...]


class Columns:
    """Assigns registers to columns, and decodes images into columns.

    Use it only in one thread, because it caches decoded values.
    """

    def __init__(self, registers: Sequence[Register], order: ByteOrder) -> None:
        self.places: list[tuple[Column, int]] = [(Column.TEXT, 0)] * len(registers)
        """Column and first slot of each register."""
        self.sizes = dict.fromkeys(Column, 0)
        """Number of slots in each column."""
        self._numbers: list[tuple[Column, _NumberGroup]] = []
        self._others: list[_SingleElement] = []
        groups: dict[tuple[Column, str], list[int]] = {}
        for place, register in enumerate(registers):
            column = column_of(register.element)
            code = "" if column is Column.BOOL else scalar_codec(register.element).plain
            groups.setdefault((column, code), []).append(place)
        for (column, code), members in groups.items():
            first = self.sizes[column]
            for place in members:
                self.places[place] = column, self.sizes[column]
                self.sizes[column] += registers[place].count
            chosen = [registers[place] for place in members]
            if column is Column.BOOL:
                self._bits = _bits(chosen)
            elif code:
                where = slice(first, self.sizes[column])
                self._numbers.append((column, _numbers(chosen, code, order, where)))
            else:
                self._others += self._others_of(members, chosen, order)
        self._kinds = [(column, kind) for column, kind in KINDS.items() if self.sizes[column]]
        self._whole = {
            column: part
            for column, part in self._numbers
            if part.slots == slice(0, self.sizes[column]) and part.kind == KINDS[column]
        }  # the columns whose elements all have the column's own type
        self._parts = [(column, part) for column, part in self._numbers if column not in self._whole]
        sizes = [other.size for other in self._others]
        starts = np.repeat([other.offset for other in self._others], sizes).astype(np.intp)
        before = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes) if sizes else np.zeros(0, np.intp)
        self._watched = starts + np.arange(len(starts)) - before
        self._owners = np.repeat(np.arange(len(sizes)), sizes)  # index of each watched byte's element
        self._seen: tuple[Array, _SingleValues] | None = None

    def _others_of(
        self, members: Sequence[int], registers: Sequence[Register], order: ByteOrder
    ) -> Iterable[_SingleElement]:
        for place, register in zip(members, registers, strict=True):
            column, first = self.places[place]
            decode = scalar_codec(register.element, order).decode
            for flat in range(register.count):
                at = register.offset + flat * register.element.stride
                yield _SingleElement(column, first + flat, place, decode, at, register.element.size)

    def place(self, column: Column, slot: int) -> int | None:
        """Return the index of the register at a slot of a column; None if there is no such slot."""
        if not 0 <= slot < self.sizes[column]:
            return None
        firsts, places = self._starts[column]
        return places[bisect_right(firsts, slot) - 1]

    @cached_property
    def _starts(self) -> Mapping[Column, tuple[list[int], list[int]]]:
        """For each column: the ascending first slots of its registers, and the registers' indices."""
        found: dict[Column, tuple[list[int], list[int]]] = {column: ([], []) for column in Column}
        for place, (column, slot) in sorted(enumerate(self.places), key=lambda pair: pair[1][1]):
            found[column][0].append(slot)
            found[column][1].append(place)
        return found

    def of_bits(self, mask: bytes) -> dict[Column, Array]:
        """Return the slots of the elements of which at least one bit is set in an image-sized mask, by column."""
        arrays = self.decode_numbers(mask)
        found = {column: array.view(_BITS[column]) != 0 for column, array in arrays.items()}
        if self.sizes[Column.TEXT]:
            found[Column.TEXT] = np.zeros(self.sizes[Column.TEXT], bool)
        for other in self._others:
            found[other.column][other.slot] = any(mask[other.offset : other.offset + other.size])
        return {column: np.flatnonzero(hit) for column, hit in found.items() if hit.any()}

    def decode_numbers(self, image: bytes) -> dict[Column, Array]:
        """Decode the columns of numbers and bits. An element that needs its own decoder becomes 0.

        The array of a column without such elements may be read-only.
        """
        arrays: dict[Column, Array] = {}
        for column, kind in self._kinds:
            if column is Column.BOOL:
                where, shifts = self._bits
                arrays[column] = np.frombuffer(image, np.uint8)[where] >> shifts & 1
            elif column in self._whole:
                arrays[column] = self._whole[column].decode(image)
            else:
                arrays[column] = np.zeros(self.sizes[column], kind)
        for column, part in self._parts:
            arrays[column][part.slots] = part.decode(image)
        return arrays

    def encode(self, column: Column, slots: Array, values: Array, image: bytearray) -> Array:
        """Encode values into an image.

        Args:
            column: The column of the values.
            slots: The slot of each value; all must exist.
            values: The values.
            image: The image to change.

        Returns:
            Indices of the values that were not encoded, because they do not fit or need their own
            encoder.

        """
        data, left = np.frombuffer(image, np.uint8), np.full(len(slots), column is not Column.BOOL)
        if column is Column.BOOL:
            slots, last = np.unique(slots[::-1], return_index=True)
            where, shifts = (part[slots] for part in self._bits)
            np.bitwise_and.at(data, where, ~(np.uint8(1) << shifts))
            np.bitwise_or.at(data, where, values[::-1][last].astype(np.uint8) << shifts)
        for part in (part for other, part in self._numbers if other is column):
            mine = (slots >= part.slots.start) & (slots < part.slots.stop)
            if part.kind.kind != "f":
                mine &= (values >= np.iinfo(part.kind).min) & (values <= np.iinfo(part.kind).max)
            numbers = values[mine].astype(part.kind)[:, None]
            data[part.offsets[slots[mine] - part.slots.start]] = numbers.view(np.uint8)
            left &= ~mine
        return np.flatnonzero(left)

    def decode(self, image: bytes) -> DecodedImage:
        """Decode all elements of an image."""
        arrays = self.decode_numbers(image)
        if not self._others:
            return DecodedImage(arrays, (), ())
        rest = self._rest(image, np.frombuffer(image, np.uint8))
        for column, found in rest.numbers.items():
            for slot, value in found.items():
                arrays[column][slot] = value
        return DecodedImage(arrays, rest.texts, rest.places)

    def _rest(self, image: bytes, data: Array) -> _SingleValues:
        """Decode the elements that need their own decoder, if their bytes have changed."""
        watched = data[self._watched]
        if self._seen is None:
            changed, before = (
                range(len(self._others)),
                _SingleValues({}, ("",) * self.sizes[Column.TEXT], frozenset(), ()),
            )
        else:
            seen, before = self._seen
            changed = np.unique(self._owners[watched != seen]).tolist()
            if not changed:
                return before
        numbers = {column: dict(found) for column, found in before.numbers.items()}
        texts, invalid = list(before.texts), set(before.invalid)
        for index in changed:
            other = self._others[index]
            value = other.decode(image, other.offset)
            (invalid.add if value is None else invalid.discard)(index)
            if other.column is Column.TEXT:
                texts[other.slot] = "" if value is None else str(value)
            else:
                numbers.setdefault(other.column, {})[other.slot] = 0 if value is None else value
        places = tuple(sorted({self._others[index].register for index in invalid}))
        self._seen = watched, _SingleValues(numbers, tuple(texts), frozenset(invalid), places)
        return self._seen[1]


def pack(new: DecodedImage, old: DecodedImage | None = None, deadband: float = 0.0) -> bytes:
    """Serialise as ``Values`` the elements whose bits differ from those in ``old``.

    Without ``old``, serialise all elements. Numbers that differ by no more than ``deadband`` are
    left out. The result is empty if nothing differs.
    """
    parts = []
    for column, values in new.arrays.items():
        if old is None:
            parts.append(field(column, field(2, values.tobytes())))
            continue
        slots = _differing(column, old.arrays[column], values, deadband)
        if len(slots) == len(values):
            parts.append(field(column, field(2, values.tobytes())))
        elif len(slots):
            parts.append(field(column, field(1, slots.astype("<u4").tobytes()) + field(2, values[slots].tobytes())))
    if old is None and new.texts:
        parts.append(field(Column.TEXT, _texts(new.texts)))
    elif old is not None and new.texts is not old.texts:
        pairs = enumerate(zip(new.texts, old.texts, strict=True))
        changed = [slot for slot, (now, before) in pairs if now != before]
        if changed:
            where = field(1, np.array(changed, "<u4").tobytes())
            parts.append(field(Column.TEXT, where + _texts(new.texts[slot] for slot in changed)))
    return b"".join(parts)


def pack_slots(values: DecodedImage, chosen: Mapping[Column, Array]) -> bytes:
    """Serialise as ``Values`` the elements at the ``chosen`` slots."""
    parts = []
    for column, slots in chosen.items():
        where = field(1, slots.astype("<u4").tobytes())
        if column is Column.TEXT:
            parts.append(field(column, where + _texts(values.texts[slot] for slot in slots)))
        else:
            parts.append(field(column, where + field(2, values.arrays[column][slots].tobytes())))
    return b"".join(parts)


def merge(new: DecodedImage, old: DecodedImage, deadband: float) -> DecodedImage:
    """Return the values that a receiver of ``old`` has after :func:`pack`.

    Numbers that were left out keep their old value.
    """
    arrays = {}
    for column, values in new.arrays.items():
        slots = _differing(column, old.arrays[column], values, deadband)
        arrays[column] = old.arrays[column].copy()
        arrays[column][slots] = values[slots]
    return DecodedImage(arrays, new.texts, new.invalid)


def _differing(column: Column, old: Array, new: Array, deadband: float) -> Array:
    """Return the slots whose bits differ. By bits, NaN equals NaN, and 0.0 differs from -0.0."""
    differs = old.view(_BITS[column]) != new.view(_BITS[column])
    if deadband and column is not Column.BOOL:
        with np.errstate(invalid="ignore", over="ignore"):
            distance = np.abs(new.astype(np.float64) - old.astype(np.float64))
        differs &= ~(distance <= deadband)  # NaN is never within the dead-band
    found: Array = differs.nonzero()[0]
    return found


def _texts(texts: Iterable[str]) -> bytes:
    return b"".join(field(2, text.encode()) for text in texts)


def _numbers(registers: Sequence[Register], code: str, order: ByteOrder, slots: slice) -> _NumberGroup:
    kind = np.dtype(f"<{code}")
    parts = [register.offset + np.arange(register.count) * register.element.stride for register in registers]
    starts, within = np.concatenate(parts), np.arange(kind.itemsize)
    where = starts[:, None] + (within[::-1] if order == "big" else within)
    stored = kind.newbyteorder(">") if order == "big" and kind.itemsize > 1 else kind
    gapless = bool((np.diff(starts) == kind.itemsize).all())
    return _NumberGroup(slots, where.astype(np.intp), kind, stored, int(starts[0]) if gapless else None)


def _bits(registers: Sequence[Register]) -> tuple[Array, Array]:
    """Return the byte offset and the shift of each bit."""
    places = [(register.offset + byte, bit) for register in registers for byte, bit in bit_positions(register)]
    where, shifts = zip(*places, strict=True)
    return np.array(where, np.intp), np.array(shifts, np.uint8)


class UpdateMessage(NamedTuple):
    """A serialised ``Update``, in two parts: the head, and the changes."""

    head: bytes
    body: bytes
    """The changes; empty if there are none."""
    changed: bool
    """True if the update has changes other than source times.

    A receiver of the newest values gets new source times only together with another change.
    Otherwise it would get an update for each frame.
    """

    @property
    def whole(self) -> bytes:
        """The whole message: both parts."""
        return self.head + self.body


class StatusChanges(NamedTuple):
    """The changed statuses of registers."""

    field: bytes
    """The statuses as a field of an ``Update``; empty if none has changed."""
    codes: bool
    """True if a status code has changed; False if only source times have."""


NO_STATUSES: Final = StatusChanges(b"", codes=False)


class WriteUpdates:
    """Encodes the writes to a table's registers, once for all subscribers.

    Use it only in the event loop's thread.
    """

    def __init__(self, number: int, block: Block, registers: Sequence[Register], columns: Columns) -> None:
        """Start without a command.

        Args:
            number: Number of the table.
            block: The block that is written to.
            registers: The registers of the table.
            columns: The columns of the table.

        """
        self._number = number
        self._block = block
        self._columns = columns
        self._cover = np.frombuffer(covering(registers, block.layout.size), np.uint8)
        self._pending_image = PendingImage(block)
        self._command = NO_COMMAND
        self._event = 0
        self._update = b""

    def of(self, event: Event) -> bytes:
        """Return the serialised ``Update`` of an accepted write; empty if it covers no register of the table.

        If a command writes only a part of an element, the rest of the value comes from the frame
        before the command. If the command's next event completes the element, only the update of
        that event has the element.
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
        slots = self._columns.of_bits(bytes(part))
        if len(event.data) == EVENT_DATA_SIZE:
            left = self._columns.of_bits(bytes(bits ^ 0xFF for bits in mask))
            whole = {column: np.setdiff1d(found, left[column]) for column, found in slots.items() if column in left}
            slots = {column: found for column, found in (slots | whole).items() if len(found)}
        if not slots:
            return b""
        return head_of(self._number, event) + field(VALUES, pack_slots(self._columns.decode(bytes(image)), slots))


class Selection:
    """A table of registers of one block. It makes the updates of frames, once for all subscribers.

    Once it is created, use it only in the event loop's thread.
    """

    def __init__(self, number: int, block: Block, registers: Sequence[Register], *, inward: bool = False) -> None:
        """Create the table.

        Args:
            number: Number of the table.
            block: The block of the registers.
            registers: The registers of the table.
            inward: Whether the table is for writes to the registers.

        """
        self.number = number
        self.inward = inward
        self.block = block
        self.registers = tuple(registers)
        self.elements = sum(register.count for register in registers)
        self.columns = Columns(registers, block.layout.byte_order)
        self._decoded: OrderedDict[int, DecodedImage] = OrderedDict()
        self._updates: OrderedDict[tuple[int, int, int], UpdateMessage] = OrderedDict()
        self._injected_places: OrderedDict[int, Array] = OrderedDict()
        self._status_indices: Array | None = None
        self._status_area = block.statuses

    @cached_property
    def writes(self) -> WriteUpdates:
        """The encoder of the writes to the table's registers."""
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
        """Decode a frame as consumers see it, with injections. The result is cached."""
        found = self._decoded.get(frame.number)
        if found is None:
            found = self._decoded[frame.number] = self.columns.decode(frame.image)
            _trim(self._decoded)
        return found

    def update(self, frame: Frame, before: Frame | None = None, sent: Frame | None = None) -> UpdateMessage:
        """Return an ``Update`` with the changes since ``before``. The update is cached.

        It has the quality with which the frame was published.

        Args:
            frame: The new frame.
            before: The frame to compare with; if None, the update has all values.
            sent: The frame of the last update that was sent, whose source times the receiver has;
                None for ``before``.

        """
        if before is not None and not before.source_ns:
            before = None
        if sent is None or self._status_area is None:
            sent = before
        key = frame.number, before.number if before else 0, sent.number if sent else 0
        found = self._updates.get(key)
        if found is None:
            old = self.decode(before) if before else None
            found = self._updates[key] = self._update(frame, before, self.decode(frame), old, sent)
            _trim(self._updates)
        return found

    def update_beyond(
        self, frame: Frame, before: Frame, sent: Frame, values: DecodedImage, deadband: float
    ) -> tuple[UpdateMessage, DecodedImage]:
        """Return an ``Update`` with the changes that exceed a dead-band.

        Args:
            frame: The new frame.
            before: The last frame that was compared.
            sent: The frame of the last update that was sent.
            values: The values that the receiver has now.
            deadband: The largest difference to leave out.

        Returns:
            The update, and the values that the receiver has after it.

        """
        new = self.decode(frame)
        return self._update(frame, before, new, values, sent, deadband), merge(new, values, deadband)

    def _update(
        self,
        frame: Frame,
        before: Frame | None,
        new: DecodedImage,
        old: DecodedImage | None,
        sent: Frame | None,
        deadband: float = 0.0,
    ) -> UpdateMessage:
        parts, statuses = [], NO_STATUSES
        if frame.source_ns:
            if values := pack(new, old, deadband):
                parts.append(field(VALUES, values))
            if old is None or new.invalid != old.invalid:
                parts.append(field(INVALID, field(1, np.array(new.invalid, "<u4").tobytes())))
            statuses = self.statuses(frame, None if old is None else sent)
        now = self.injected(frame)
        if before is None or (now is not (was := self.injected(before)) and not np.array_equal(now, was)):
            parts.append(field(INJECTED, field(1, now.tobytes())))
        changed = bool(parts) or statuses.codes
        parts.append(statuses.field)
        return UpdateMessage(head(self.number, frame, whole=before is None), b"".join(parts), changed)

    def statuses(self, frame: Frame, sent: Frame | None) -> StatusChanges:
        """Return the statuses of a frame that differ from those of the frame ``sent``; all if ``sent`` is None."""
        area = self._status_area
        if area is None:
            return NO_STATUSES
        codes, times = self._status_columns(area, frame)
        differ = np.ones(len(codes), bool)
        places = np.arange(len(codes))
        if sent is not None and sent.source_ns:
            old_codes, old_times = self._status_columns(area, sent)
            differ = codes != old_codes
            places = np.flatnonzero(differ | (times != old_times))
        if not len(places):
            return NO_STATUSES
        columns = places.astype("<u4"), codes[places].astype("<u4"), times[places].astype("<i8")
        parts = b"".join(field(at, column.tobytes()) for at, column in enumerate(columns, 1))
        return StatusChanges(field(STATUSES, parts), codes=bool(differ.any()))

    def _status_columns(self, area: StatusArea, frame: Frame) -> tuple[Array, Array]:
        """Return the status codes and source times of the table's registers."""
        layout = self.block.layout
        order, count = ">" if layout.byte_order == "big" else "<", len(layout.own)
        if self._status_indices is None:
            self._status_indices = np.array(area.indices(self.registers), np.intp)
        return (
            np.frombuffer(frame.raw, f"{order}u4", count, area.codes_offset)[self._status_indices],
            np.frombuffer(frame.raw, f"{order}i8", count, area.times_offset)[self._status_indices],
        )

    def originals(self, frame: Frame) -> bytes:
        """Return the values of a frame as the source delivered them, as serialised ``Values``."""
        return pack(self.columns.decode(frame.raw))

    def injected(self, frame: Frame) -> Array:
        """Return the indices of the registers that injections over ``/out`` cover.

        The result is cached, because only an event can change it.
        """
        if frame.effective is None:
            return _NO_PLACES
        found = self._injected_places.get(frame.event)  # injections change only with an event
        if found is None:
            found = self._injected_places[frame.event] = self._under_injections()
            _trim(self._injected_places)
        return found

    def _under_injections(self) -> Array:
        cover = np.zeros(self.block.layout.size, np.uint8)
        for entry in self.block.injections.read():
            if entry.direction == "out" and entry.active:
                for offset, size, mask in entry.ranges:
                    cover[offset : offset + size] |= mask
        starts, stops, masks = self._extents
        covered = np.concatenate(([0], np.cumsum(cover != 0)))
        hit = np.where(masks, cover[starts] & masks, covered[stops] - covered[starts])
        for place in self._rows:
            row = self.registers[place]
            own = np.frombuffer(bits_of(row), np.uint8)
            hit[place] = (cover[row.offset : row.offset + row.size] & own).any()
        return np.flatnonzero(hit).astype("<u4")

    @cached_property
    def _rows(self) -> list[int]:
        """The indices of rows of bits that share bytes with other registers."""
        return [place for place, register in enumerate(self.registers) if register.partial]

    @cached_property
    def _extents(self) -> tuple[Array, ...]:
        """For each register: its first byte, the byte after its last, the mask of a single bit."""
        starts = [register.offset for register in self.registers]
        stops = [register.offset + register.size for register in self.registers]
        masks = [0 if register.bit is None or register.dims else 1 << register.bit for register in self.registers]
        return tuple(np.array(numbers, np.intp) for numbers in (starts, stops, masks))


class RawFrames:
    """A view of a block's raw frames. It has the methods of a :class:`Selection`."""

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

    def update(
        self,
        frame: Frame,
        before: Frame | None = None,  # noqa: ARG002  a frame is always whole
        sent: Frame | None = None,  # noqa: ARG002
    ) -> UpdateMessage:
        """Return an ``Update`` with the image, and also with the original image if injections change it."""
        found = self._updates.get(frame.number)
        if found is None:
            body = field(IMAGE, frame.image) if frame.source_ns else b""
            if frame.source_ns and frame.effective is not None:
                body += field(ORIGINAL, frame.raw)
            found = self._updates[frame.number] = UpdateMessage(head(self.number, frame, whole=True), body, bool(body))
            _trim(self._updates)
        return found


View = Selection | RawFrames


def head(table: int, frame: Frame, *, whole: bool = False) -> bytes:
    """Return the serialised ``Update`` of a frame, without its values."""
    return wire.Update(
        table=table,
        frame=frame.number,
        cycle=frame.cycle,
        incarnation=frame.incarnation,
        clock_ns=frame.clock_ns,
        source_ns=frame.source_ns,
        quality=int(frame.quality),  # type: ignore[arg-type]  # to mypy, Protobuf's enums are types of their own
        reason=frame.reason,
        provenance=int(frame.provenance),  # type: ignore[arg-type]
        whole=whole,
    ).SerializeToString()


def head_of(table: int, event: Event) -> bytes:
    """Return the serialised ``Update`` of an event, without its values."""
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
    """Return the fields which, appended to a frame's update, report the frame as stale."""
    return _QUALITY_BAD + field(REASON, reason.encode())


def describe(register: Register, found: wire.Register, column: Column | None = None, slot: int = 0) -> None:
    """Fill in the message that describes a register.

    Args:
        register: The register.
        found: The message.
        column: The column of the register's values; None if they are not in a table.
        slot: The first slot of the register in the column.
    """
    found.path, found.type = register.path, register.type
    found.offset, found.size, found.count = register.offset, register.size, register.count
    found.column = int(column or column_of(register.element))  # type: ignore[assignment]
    found.slot, found.unit, found.encoding = slot, register.unit, register.encoding
    if register.bit is not None:
        found.bit = register.bit
    for low, high in register.dims:
        found.dims.add(low=low, high=high)


def _trim(cache: OrderedDict[Any, Any]) -> None:
    while len(cache) > _CACHED:
        cache.popitem(last=False)
