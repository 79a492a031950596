"""Gives a model access to its declared values in the images of its block."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from shmio.errors import ValueRangeError
from shmio.layout.model import ByteOrder, Register
from shmio.layout.values.codec import brief, codec, scalar_codec

_NUMBERS: Final = frozenset({int, float, np.float64})


class _Run(NamedTuple):
    """Adjacent numbers. ``values`` says which of all the numbers they are."""

    where: slice
    packing: struct.Struct
    values: slice


class StructureCodec:
    """Reads and writes all registers of a structure at once, if each is a single number."""

    def __init__(self, names: Sequence[str], runs: Sequence[_Run]) -> None:
        """Create the codec for two or more names."""
        self._names = tuple(names)
        self._runs = tuple(runs)
        self._values = itemgetter(*names)

    @classmethod
    def of(cls, registers: Mapping[str, Register], byte_order: ByteOrder) -> StructureCodec | None:
        """Return a codec for two or more registers that are all numbers, else None."""
        codes = [_code(register, byte_order) for register in registers.values()]
        if len(codes) < 2 or not all(codes):
            return None
        order = ">" if byte_order == "big" else "<"
        return cls(tuple(registers), list(_runs(list(registers.values()), codes, order)))

    def read(self, image: bytearray) -> dict[str, Any]:
        """Return all values, by name."""
        found: list[float] = []
        for run in self._runs:
            found += run.packing.unpack_from(image, run.where.start)
        return dict(zip(self._names, found, strict=True))

    def write(self, values: Mapping[str, object], image: bytearray) -> bool:
        """Write all values; return False and write nothing unless all are numbers that fit."""
        try:
            found: Sequence[object] = self._values(values)
            if len(values) != len(self._names) or not _NUMBERS.issuperset(map(type, found)):
                return False
            packed = [run.packing.pack(*found[run.values]) for run in self._runs]
        except (KeyError, struct.error, OverflowError):
            return False
        for run, data in zip(self._runs, packed, strict=True):
            image[run.where] = data
        return True


def _code(register: Register, byte_order: ByteOrder) -> str:
    """Return the code for ``struct``; empty if the register is not a single number."""
    if register.dims or register.type == "BOOL":
        return ""
    return scalar_codec(register.element, byte_order).plain


def _runs(registers: Sequence[Register], codes: Sequence[str], order: str) -> Iterator[_Run]:
    begun = 0
    for place, register in enumerate(registers, 1):
        end = register.offset + register.size
        if place == len(registers) or registers[place].offset != end:
            packing = struct.Struct(order + "".join(codes[begun:place]))
            yield _Run(slice(registers[begun].offset, end), packing, slice(begun, place))
            begun = place


_PYTHON: Final = frozenset({bool, int, float, str, list, tuple})
_NUMPY: Final = (np.ndarray, np.generic)
_BYTES: Final = (bytes, bytearray)


class Port(Protocol):
    """Access to one declaration in one image."""

    def read(self) -> Any:
        """Return the value in the image."""

    def write(self, value: object) -> None:
        """Put a value into the image; ValueRangeError if it does not fit."""


def port_of(path: str, registers: Mapping[str, Register], byte_order: ByteOrder, image: bytearray) -> Port:
    """Return the port of a declaration: of a structure, or of the one register under ``""``."""
    ports = {member: RegisterPort(register, byte_order, image) for member, register in registers.items()}
    return ports.get("") or StructurePort(path, ports, StructureCodec.of(registers, byte_order), image)


class RegisterPort:
    """Access to a register or an array."""

    def __init__(self, register: Register, byte_order: ByteOrder, image: bytearray) -> None:
        self._path = register.path
        self._codec = codec(register, byte_order)
        self._image = image
        self._start, self._stop = register.offset, register.offset + register.size
        self._is_row = register.type == "BYTE" and len(register.dims) == 1

    def read(self) -> Any:
        """Return the value; an array as tuples, because changing a list would have no effect."""
        if self._is_row:
            return bytes(self._image[self._start : self._stop])
        value = self._codec.decode(self._image)
        return _frozen(value) if isinstance(value, list) else value

    def write(self, value: object) -> None:
        """Put a Python or numpy value into the image, or change nothing if it does not fit."""
        if self._is_row and isinstance(value, _BYTES) and len(value) == self._stop - self._start:
            self._image[self._start : self._stop] = value
            return
        try:
            self._codec.encode_into(value if type(value) in _PYTHON else _plain(value), self._image)
        except ValueRangeError as error:
            text = str(error)
            raise ValueRangeError(text if text.startswith(f"{self._path}:") else f"{self._path}: {text}") from None


class StructurePort:
    """Access to the registers of a structure."""

    def __init__(
        self, path: str, ports: Mapping[str, RegisterPort], bulk: StructureCodec | None, image: bytearray
    ) -> None:
        """Create the port; ``bulk`` reads and writes all members at once, if that is possible."""
        self._path = path
        self._ports = ports
        self._bulk = bulk
        self._image = image

    def read(self) -> dict[str, Any]:
        """Return all members, by path."""
        if self._bulk is not None:
            return self._bulk.read(self._image)
        return {path: port.read() for path, port in self._ports.items()}

    def write(self, value: object) -> None:
        """Change the members that are named."""
        if isinstance(value, Mapping) and self._bulk is not None and self._bulk.write(value, self._image):
            return
        if not isinstance(value, Mapping) or value.keys() - self._ports.keys():
            some = ", ".join(self._ports)
            raise ValueRangeError(f"{self._path}: expected a dict with some of {some}, found {brief(value)}")
        for path, member in value.items():
            self._ports[path].write(member)


class Ends:
    """The commanded and the shown value of an in-out register."""

    __slots__ = ("_commanded", "_shown")

    def __init__(self, commanded: Port, shown: Port) -> None:
        self._commanded = commanded
        self._shown = shown

    @property
    def commanded(self) -> Any:
        """The value written to ``/in`` last; at first the initial value."""
        return self._commanded.read()

    @property
    def shown(self) -> Any:
        """The value of ``/out`` that consumers see, as the model has set it last."""
        return self._shown.read()

    @shown.setter
    def shown(self, value: object) -> None:
        self._shown.write(value)


def _frozen(value: object) -> object:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _plain(value: object) -> object:
    if isinstance(value, _NUMPY):
        return value.tolist()
    return list(value) if isinstance(value, _BYTES) else value
