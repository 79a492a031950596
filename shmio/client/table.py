"""Tables of registers with their latest values as numpy arrays, and the messages that fill them.

On the wire, a packed field of elements with a fixed size looks the same as a ``bytes`` field
(protobuf.dev, "Encoding"). Therefore, this module derives message types in which such a field has
the type ``bytes``: numpy reads them as a little-endian array without a copy.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from google.protobuf import message_factory
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool

from shmio.errors import PathError, RemoteError
from shmio.layout import model
from shmio.layout.model import ElementType, element_type
from shmio.model.statuses import RegisterStatus
from shmio.model.values import Column
from shmio.wire import shmio_v1_pb2 as wire
from shmio.wording import did_you_mean

Array = np.ndarray[Any, np.dtype[Any]]

DTYPES: Final[Mapping[Column, np.dtype[Any]]] = {
    Column.BOOL: np.dtype("?"),
    Column.INT32: np.dtype("<i4"),
    Column.INT64: np.dtype("<i8"),
    Column.UINT64: np.dtype("<u8"),
    Column.FLOAT: np.dtype("<f4"),
    Column.DOUBLE: np.dtype("<f8"),
    Column.TEXT: np.dtype(object),
}
FIELDS: Final = {
    Column.BOOL: "bools",
    Column.INT32: "int32s",
    Column.INT64: "int64s",
    Column.UINT64: "uint64s",
    Column.FLOAT: "floats",
    Column.DOUBLE: "doubles",
    Column.TEXT: "texts",
}
_NEAR_CANDIDATES: Final = 500
_SHOWN: Final = 200
MAX_SLOTS: Final = 1 << 22
"""Largest number of elements in a table; no endpoint sends a larger table."""


# -- messages with packed arrays as bytes --------------------------------------------------------------------

_FIXED: Final = frozenset(
    {
        FieldDescriptorProto.TYPE_BOOL,
        FieldDescriptorProto.TYPE_FIXED32,
        FieldDescriptorProto.TYPE_SFIXED32,
        FieldDescriptorProto.TYPE_SFIXED64,
        FieldDescriptorProto.TYPE_FIXED64,
        FieldDescriptorProto.TYPE_FLOAT,
        FieldDescriptorProto.TYPE_DOUBLE,
    }
)


def _declared_anew() -> DescriptorPool:
    file = FileDescriptorProto()
    wire.DESCRIPTOR.CopyToProto(file)
    for message in file.message_type:
        for part in message.field:
            if part.label == FieldDescriptorProto.LABEL_REPEATED and part.type in _FIXED:
                part.label, part.type = FieldDescriptorProto.LABEL_OPTIONAL, FieldDescriptorProto.TYPE_BYTES
    pool = DescriptorPool()
    pool.Add(file)
    return pool


_POOL = _declared_anew()


def _message(name: str) -> Any:
    return message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"{wire.DESCRIPTOR.package}.{name}"))


Values = _message("Values")
ReadResponse = _message("ReadResponse")
SubscribeResponse = _message("SubscribeResponse")
InjectRequest = _message("InjectRequest")
InjectResponse = _message("InjectResponse")
SimulateResponse = _message("SimulateResponse")


# -- tables --------------------------------------------------------------------------------------------------


class Register(model.Register, frozen=True, gc=False, kw_only=True):
    """A register, or an element of an array, as the endpoint describes it.

    Attributes:
        column: Column with the register's values.
        slot: The register's first slot in the column.
        comment: Comment from the layout's source text; only in layouts.
        initial: Initial value, as written in the layout's source text; only in layouts.
    """

    column: Column
    slot: int

    @property
    def element(self) -> ElementType:
        """The elementary type. Raise RemoteError if this version does not know the type."""
        found = element_type(self.type)
        if found is None:
            raise RemoteError(
                f"{self.path}: this register has the type {self.type!r}, which this version does not know"
            )
        return found

    @classmethod
    def of(cls, found: Any) -> Register:
        """Convert a message to a register. Raise RemoteError if it is invalid."""
        try:
            return cls(
                found.path,
                found.type,
                tuple((bounds.low, bounds.high) for bounds in found.dims),
                found.offset,
                found.bit if found.HasField("bit") else None,
                found.size,
                found.count,
                found.comment,
                found.initial if found.HasField("initial") else None,
                partial=bool(found.over) and found.HasField("bit") and len(found.dims) == 1,
                unit=found.unit,
                over=found.over,
                encoding=found.encoding,
                column=Column(found.column),
                slot=found.slot,
            )
        except ValueError:
            raise RemoteError(
                f"{found.path}: the endpoint sends this register's values in a form that this version of shmio does "
                f"not know (column {found.column}); update the client"
            ) from None


def unknown(path: str, paths: Sequence[str], what: str) -> PathError:
    """Return the error for a path that is not among ``paths``, the paths of ``what``."""
    near = difflib.get_close_matches(path, paths[:_NEAR_CANDIDATES], n=3)
    like = f"; {did_you_mean(near)}" if near else ""
    return PathError(f"{path[:_SHOWN]}: this path is not among {what}{like}")


class Change(NamedTuple):
    """Received elements of a column, as read-only arrays: slot ``slots[i]`` has ``values[i]``."""

    column: Column
    slots: Array
    values: Array


class Table:
    """Registers of one source with their latest values: one array for each type.

    Each register takes one or more elements of the array of its type.
    """

    def __init__(self, found: Any) -> None:
        """Create the table that a message describes. Raise RemoteError if it is invalid."""
        self.number: int = found.number
        self.source: str = found.source
        self.section: int = found.section
        """Number of the source's block. It changes if a reload replaces the block."""
        self.size: int = found.size
        """Size of a frame in bytes."""
        self.hash: bytes = found.hash
        self.direction = "in" if found.direction == wire.DIRECTION_IN else "out"
        """``in`` if updates have the values that commands write, ``out`` if those that consumers see."""
        self.ranges = tuple((one.offset, one.size, one.mask) for one in found.ranges)
        """Bytes that an injection covers besides the registers: (offset, size, mask of bits)."""
        self.registers = tuple(map(Register.of, found.registers))
        sizes = dict(zip(Column, found.slots[1:], strict=False))
        if sum(sizes.values()) > MAX_SLOTS:
            raise RemoteError(
                f"source {self.source}: the endpoint sent a table of {sum(sizes.values())} elements, which is too large"
            )
        for register in self.registers:
            count = int(np.prod(register.shape, dtype=object)) if register.dims else 1
            if count != register.count or register.slot + count > sizes.get(register.column, 0):
                raise RemoteError(
                    f"{self.source}/{register.path}: the register's elements are outside the endpoint's table"
                )
        self.arrays: dict[Column, Array] = {
            column: np.zeros(size, DTYPES[column]) for column, size in sizes.items() if size
        }
        """The latest values, by column; the next update changes them in place."""
        if Column.TEXT in self.arrays:
            self.arrays[Column.TEXT][:] = ""
        self.invalid = np.zeros(len(self.registers), bool)
        """True for each register whose bytes are not a valid value of its type."""
        self.injected = np.zeros(len(self.registers), bool)
        """True for each register that an injection covers."""
        self.codes: Array | None = None
        """The status code of each register; None if the source gives registers no status."""
        self.times_ns: Array | None = None
        """The source time of each register, UTC in ns; 0 if the time of the update applies."""
        self.state: object = None
        """Quality, reason, provenance and incarnation of the latest frame."""
        self._everything = {column: np.arange(len(array), dtype=np.uint32) for column, array in self.arrays.items()}

    @cached_property
    def places(self) -> Mapping[str, int]:
        """Index of each register, by its path without the source."""
        return {register.path: place for place, register in enumerate(self.registers)}

    @property
    def paths(self) -> list[str]:
        """Paths of the registers, with the source."""
        return [f"{self.source}/{register.path}" for register in self.registers]

    def place(self, path: str) -> int:
        """Return the index of a register by its path, with or without the source.

        Raises:
            PathError: There is no such register.
        """
        found = self.places.get(path)
        if found is None:
            found = self.places.get(path.removeprefix(f"{self.source}/"))
        if found is None:
            raise unknown(path, self.paths, f"the registers of {self.source} that were requested")
        return found

    def value(self, place: int, arrays: Mapping[Column, Array] | None = None) -> Any:
        """Return the value of the register at index ``place``: a numpy scalar, an array, or text.

        None stands for bytes that are not a valid value. ``arrays`` has the arrays from which to
        take the value; None: those of the table, which have the latest values.
        """
        register = self.registers[place]
        array = (self.arrays if arrays is None else arrays)[register.column]
        if register.dims:
            return array[register.slot : register.slot + register.count].reshape(register.shape).copy()
        return None if self.invalid[place] else array[register.slot]

    def changed(self, changes: tuple[Change, ...]) -> list[int]:
        """Return the indices of the registers that have elements in ``changes``, in ascending order."""
        found: set[int] = set()
        for change in changes:
            slots, places = self._starts[change.column]
            found.update(places[np.unique(np.searchsorted(slots, change.slots, "right") - 1)].tolist())
        return sorted(found)

    @cached_property
    def _starts(self) -> Mapping[Column, tuple[Array, Array]]:
        """For each column: the first slots of its registers, ascending, and the registers' indices."""
        found: dict[Column, list[tuple[int, int]]] = {}
        for place, register in enumerate(self.registers):
            found.setdefault(register.column, []).append((register.slot, place))
        return {
            column: (np.array([slot for slot, _ in sorted(pairs)]), np.array([place for _, place in sorted(pairs)]))
            for column, pairs in found.items()
        }

    def apply(self, values: Any) -> tuple[Change, ...]:
        """Copy the values of a message into the arrays, and return these values.

        Raises:
            RemoteError: The values are invalid.
        """
        try:
            changes = self.read(values)
            for column, slots, new in changes:
                if len(slots) == len(self.arrays[column]):
                    self.arrays[column][:] = new
                else:
                    self.arrays[column][slots] = new
        except (IndexError, ValueError, KeyError) as error:
            raise RemoteError(f"source {self.source}: the endpoint sent an invalid update: {error}") from None
        return changes

    def read(self, values: Any) -> tuple[Change, ...]:
        """Return a message's values, without changing the arrays. Raise RemoteError if they are invalid."""
        try:
            return tuple(self._read(values))
        except (ValueError, KeyError) as error:
            raise RemoteError(f"source {self.source}: the endpoint sent an invalid update: {error}") from None

    def _read(self, values: Any) -> Iterator[Change]:
        for column, name in FIELDS.items():
            if values.HasField(name):
                part = getattr(values, name)
                if column is Column.TEXT:
                    new = np.array(list(part.values), dtype=object)
                else:
                    new = np.frombuffer(part.values, DTYPES[column])
                slots = np.frombuffer(part.slots, np.uint32) if part.slots else self._everything[column]
                if len(slots) != len(new):
                    raise ValueError(f"{len(new)} values for {len(slots)} elements")
                yield Change(column, slots, new)

    def take_statuses(self, found: Any) -> list[int]:
        """Store the registers' statuses from a message, and return the indices of these registers.

        Raises:
            RemoteError: The statuses are invalid.
        """
        places = np.frombuffer(found.registers, np.uint32)
        if self.codes is None or self.times_ns is None:
            self.codes = np.zeros(len(self.registers), np.uint32)
            self.times_ns = np.zeros(len(self.registers), np.int64)
        try:
            self.codes[places] = np.frombuffer(found.codes, "<u4")
            self.times_ns[places] = np.frombuffer(found.source_ns, "<i8")
        except (IndexError, ValueError) as error:
            raise RemoteError(f"source {self.source}: the endpoint sent an invalid update: {error}") from None
        return list(map(int, places))

    def status(self, place: int) -> RegisterStatus | None:
        """Return the status of the register at index ``place``; None if the source gives no statuses."""
        if self.codes is None or self.times_ns is None:
            return None
        return RegisterStatus(int(self.codes[place]), int(self.times_ns[place]))

    def mark(self, marks: Any, into: Array) -> None:
        """Set ``into`` to True for the registers that a message marks, else to False.

        Raises:
            RemoteError: The message marks a register that is not in the table.
        """
        places = np.frombuffer(marks.registers, np.uint32)
        into[:] = False
        try:
            into[places] = True
        except IndexError as error:
            raise RemoteError(f"source {self.source}: the endpoint sent an invalid update: {error}") from None
