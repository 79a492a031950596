"""The commanded and the shown image of a model's block, and access to the values in them."""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from shmio.errors import LayoutError, ValueRangeError
from shmio.layout.image import initial_frame
from shmio.layout.model import NUMBERS, ByteOrder, Layout, Register
from shmio.layout.values.codec import codec, scalar_codec
from shmio.layout.values.write import Write, apply, covering
from shmio.wording import brief

_NUMBERS: Final = frozenset({int, float, np.float64})
_PYTHON: Final = frozenset({bool, int, float, str, list, tuple})
_NUMPY: Final = (np.ndarray, np.generic)
_BYTES: Final = (bytes, bytearray)
_ALL: Final = 0xFF
_MANY_PIECES: Final = 24
_MAX_SHOWN: Final = 20


class Images:
    """The two images of a block. At first, both have the initial values of the layout.

    ``commanded`` has the values that clients and connections have written: to inputs, to the
    ``/in`` of in-outs, and to registers that the model does not declare. ``shown`` has the values
    that readers see; into it, the model writes the outputs and the ``/out`` of in-outs.
    """

    def __init__(self, layout: Layout, outputs: Sequence[Register], inouts: Sequence[Register] = ()) -> None:
        """Create the images.

        Args:
            layout: The layout of the block.
            outputs: Registers that only the model writes.
            inouts: Registers that clients write and the model computes.

        """
        initial, _ = initial_frame(layout)
        self.commanded, self.shown = bytearray(initial), initial
        self._outputs = tuple(outputs)
        self._computed = covering(outputs, layout.size)
        self.limited: Sequence[RegisterPort] = ()
        """The ports of commanded registers with limits. A write outside the limits is refused."""
        given = ~_array(covering((*outputs, *inouts), layout.size))
        self._given = _Bits(given.tobytes())

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Write bytes and bits into the commanded image.

        Returns:
            For each write, "" or why it is refused. A write is refused if it would change an
            output, lies outside the block, or has a value outside the register's limits.

        """
        return [self._write(write) for write in writes]

    def resume(self, image: bytes) -> None:
        """Set both images to ``image``.

        Raises:
            LayoutError: The image has the wrong size.

        """
        if len(image) != len(self.shown):
            raise LayoutError(f"the image has {len(image)} bytes, but the block has {len(self.shown)}")
        self.shown[:] = self.commanded[:] = image

    def restore(self, commanded: bytes, shown: bytes) -> None:
        """Set the commanded and the shown image.

        Raises:
            LayoutError: An image has the wrong size.

        """
        if {len(commanded), len(shown)} != {len(self.shown)}:
            raise LayoutError(f"an image has {len(shown)} bytes, but the block has {len(self.shown)}")
        self.commanded[:], self.shown[:] = commanded, shown

    def with_given(self, image: bytes | bytearray) -> bytes:
        """Return a copy of ``image`` with the commanded values of all registers that the model does not compute."""
        shown = bytearray(image)
        self._given.copy(self.commanded, shown)
        return bytes(shown)

    def show_given(self) -> None:
        """Show the commanded values of all registers that the model does not compute."""
        self._given.copy(self.commanded, self.shown)

    def _write(self, write: Write) -> str:
        offset, mask, data = write
        stop = offset + len(data)
        if stop > len(self.commanded):
            return f"the write is outside the block of {len(self.commanded)} bytes"
        if self._computed[offset] & mask if mask else any(self._computed[offset:stop]):
            hit = [r.path for r in self._outputs if r.offset < stop and offset < r.offset + r.size]
            return f"the model computes {hit[0]}: outputs cannot be written; shmio inject can show another value"
        before = bytes(self.commanded[offset:stop])
        apply(write, self.commanded)
        for port in self.limited:
            if port.overlaps(offset, stop) and (fault := port.fault(port.read())):
                self.commanded[offset:stop] = before
                return fault
        return ""


class _Bits:
    """Some bits of an image, which can be copied to another image."""

    def __init__(self, mask: bytes) -> None:
        """Create the object for the bits that are set in ``mask``, an image of the same size."""
        ranges: list[tuple[int, int]] = []  # whole bytes
        parts: list[tuple[int, int]] = []  # offset and mask of bytes of which only some bits are copied
        for at, bits in enumerate(mask):
            if bits == _ALL and ranges and ranges[-1][1] == at:
                ranges[-1] = ranges[-1][0], at + 1
            elif bits == _ALL:
                ranges.append((at, at + 1))
            elif bits:
                parts.append((at, bits))
        self._ranges, self._parts = ranges, parts
        # numpy takes the same time for any number of pieces, which is longer than for a few
        self._mask = _array(mask) if len(ranges) + len(parts) > _MANY_PIECES else None

    def copy(self, source: bytearray, target: bytearray) -> None:
        """Copy the bits from ``source`` to ``target``."""
        if self._mask is not None:
            array = _array(target)
            array[:] = _array(source) & self._mask | array & ~self._mask
            return
        for begin, end in self._ranges:
            target[begin:end] = source[begin:end]
        for at, bits in self._parts:
            target[at] = target[at] & ~bits | source[at] & bits


def _array(data: bytes | bytearray) -> npt.NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


class Ends:
    """The commanded and the shown value of an in-out register, for the model."""

    __slots__ = ("_commanded", "_shown")

    def __init__(self, commanded: Port, shown: Port) -> None:
        self._commanded = commanded
        self._shown = shown

    @property
    def commanded(self) -> Any:
        """The value last written to ``/in``, or the initial value."""
        return self._commanded.read()

    @property
    def shown(self) -> Any:
        """The value of ``/out``, which the model sets and readers see."""
        return self._shown.read()

    @shown.setter
    def shown(self, value: object) -> None:
        self._shown.write(value)


class Port(Protocol):
    """Reads and writes the value of one declaration in one image."""

    def read(self) -> Any:
        """Return the value from the image."""

    def write(self, value: object) -> None:
        """Write a value into the image.

        Raises:
            ValueRangeError: The value does not fit into the register.

        """


Limits = tuple[float, float] | Mapping[int, str]
"""The lowest and the highest value that may be given to a model, or all allowed values with their names."""


def port_of(
    path: str,
    registers: Mapping[str, Register],
    byte_order: ByteOrder,
    image: bytearray,
    limits: Limits | None = None,
) -> Port:
    """Return the port of a declaration.

    Args:
        path: The path of a structure, for messages.
        registers: The members of a structure by path, or a single register under ``""``.
        byte_order: The byte order of the values.
        image: The image in which the port reads and writes.
        limits: The values that may be written; None: all.

    """
    ports = {member: RegisterPort(register, byte_order, image, limits) for member, register in registers.items()}
    return ports.get("") or _StructurePort(path, ports, _StructureCodec.of(registers, byte_order), image)


class RegisterPort:
    """Reads and writes the value of a register or an array."""

    def __init__(
        self, register: Register, byte_order: ByteOrder, image: bytearray, limits: Limits | None = None
    ) -> None:
        self._path = register.path
        self._limits = limits
        self._codec = codec(register, byte_order)
        self._image = image
        self._start, self._stop = register.offset, register.offset + register.size
        self._is_row = register.type == "BYTE" and len(register.dims) == 1
        self.is_native = register.element.base in NUMBERS and byte_order == sys.byteorder
        """True if C on this machine can read the register's bytes as numbers."""

    def read(self) -> Any:
        """Return the value.

        An array is returned as tuples, not as lists, because changes of a list would not reach the image.
        """
        if self._is_row:
            return bytes(self._image[self._start : self._stop])
        value = self._codec.decode(self._image)
        return _frozen(value) if isinstance(value, list) else value

    def write(self, value: object) -> None:
        """Write a Python or numpy value into the image.

        Raises:
            ValueRangeError: The value does not fit, or is outside the limits. The image is
                unchanged.

        """
        limits = self._limits
        within = limits is None or (
            type(value) is float and isinstance(limits, tuple) and limits[0] <= value <= limits[1]
        )
        if not within and (fault := self.fault(value)):
            raise ValueRangeError(f"{self._path}: {fault}")
        if self._is_row and isinstance(value, _BYTES) and len(value) == self._stop - self._start:
            self._image[self._start : self._stop] = value
            return
        try:
            self._codec.encode_into(value if type(value) in _PYTHON else _plain(value), self._image)
        except ValueRangeError as error:
            text = str(error)
            raise ValueRangeError(text if text.startswith(f"{self._path}:") else f"{self._path}: {text}") from None

    def overlaps(self, start: int, stop: int) -> bool:
        """Return whether the register has bytes in the range of the image from ``start`` to ``stop``, exclusive."""
        return self._start < stop and start < self._stop

    def fault(self, value: object) -> str:
        """Return a message if a number in ``value`` is outside the limits; else ""."""
        if self._limits is None:
            return ""
        if isinstance(self._limits, Mapping):
            for one in _flat(value):
                if one not in self._limits:
                    items = ", ".join(f"{number} ({name})" for number, name in [*self._limits.items()][:_MAX_SHOWN])
                    return f"{one} is not an item of the enumeration; expected one of {items}"
            return ""
        low, high = self._limits
        for one in _flat(value):
            if isinstance(one, int | float | np.number) and not low <= one <= high:  # NaN too
                return f"{one:g} is outside the limits of {low:g} to {high:g}"
        return ""


def joined_bytes(ports: Iterable[RegisterPort]) -> list[memoryview]:
    """Return the bytes of registers in their image, in this order, those of adjacent registers together."""
    joined: list[tuple[bytearray, int, int]] = []
    for port in ports:
        if joined and joined[-1][0] is port._image and joined[-1][2] == port._start:
            joined[-1] = port._image, joined[-1][1], port._stop
        else:
            joined.append((port._image, port._start, port._stop))
    return [memoryview(image)[start:stop] for image, start, stop in joined]


class _StructurePort:
    """Reads and writes the values of a structure's registers."""

    def __init__(
        self, path: str, ports: Mapping[str, RegisterPort], bulk: _StructureCodec | None, image: bytearray
    ) -> None:
        """Create the port.

        ``bulk`` is a faster codec for all members together; None if there is none.
        """
        self._path = path
        self._ports = ports
        self._bulk = bulk
        self._image = image

    def read(self) -> dict[str, Any]:
        """Return the values of all members by path."""
        if self._bulk is not None:
            return self._bulk.read(self._image)
        return {path: port.read() for path, port in self._ports.items()}

    def write(self, value: object) -> None:
        """Write the members that the dict ``value`` names. The others stay unchanged."""
        if isinstance(value, Mapping) and self._bulk is not None and self._bulk.write(value, self._image):
            return
        if not isinstance(value, Mapping) or value.keys() - self._ports.keys():
            some = ", ".join(self._ports)
            raise ValueRangeError(f"{self._path}: expected a dict with some of {some}, found {brief(value)}")
        for path, member in value.items():
            self._ports[path].write(member)


class _Run(NamedTuple):
    """Adjacent numbers in a block.

    ``values`` are their indices among all numbers of the structure.
    """

    where: slice
    packing: struct.Struct
    values: slice


class _StructureCodec:
    """Reads and writes all registers of a structure at once. Each must be a single number."""

    def __init__(self, names: Sequence[str], runs: Sequence[_Run]) -> None:
        """Create the codec for two or more registers with these names."""
        self._names = tuple(names)
        self._runs = tuple(runs)
        self._values = itemgetter(*names)

    @classmethod
    def of(cls, registers: Mapping[str, Register], byte_order: ByteOrder) -> _StructureCodec | None:
        """Return a codec if there are two or more registers and all are numbers, else None."""
        codes = [_code(register, byte_order) for register in registers.values()]
        if len(codes) < 2 or not all(codes):
            return None
        order = ">" if byte_order == "big" else "<"
        return cls(tuple(registers), list(_runs(list(registers.values()), codes, order)))

    def read(self, image: bytearray) -> dict[str, Any]:
        """Return all values by name."""
        found: list[float] = []
        for run in self._runs:
            found += run.packing.unpack_from(image, run.where.start)
        return dict(zip(self._names, found, strict=True))

    def write(self, values: Mapping[str, object], image: bytearray) -> bool:
        """Write all values, and return True. If a value is missing or does not fit, write none."""
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
    """Return the register's format character for ``struct``; empty if it is not a single number."""
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


def _flat(value: object) -> Iterator[object]:
    """Yield the elements of an array of any dimensions, or the single value."""
    if isinstance(value, list | tuple):
        for one in value:
            yield from _flat(one)
    elif isinstance(value, np.ndarray):
        yield from value.flat
    else:
        yield value


def _frozen(value: object) -> object:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _plain(value: object) -> object:
    if isinstance(value, _NUMPY):
        return value.tolist()
    return list(value) if isinstance(value, _BYTES) else value
