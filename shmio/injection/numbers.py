"""Reads and writes the values of some registers in an image, all of one type at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from shmio.layout.model import ByteOrder, ElementType, Register, bit_positions
from shmio.layout.values.codec import REAL_MAX, scalar_codec

Bytes = npt.NDArray[np.uint8]
Values = npt.NDArray[Any]

MAX_ELEMENTS: Final = 4096
"""Most single values of one injection; more would slow the poll loop."""

_REAL_LIMIT: Final = float(np.float32(REAL_MAX))


@dataclass(frozen=True)
class ValueGroup:
    """All single values of one type.

    ``first`` is the number of the first among those of the injection.
    """

    element: ElementType
    first: int
    index: npt.NDArray[np.intp]
    """Offsets of the values' bytes in the block, (n, size); for bits (n,)."""
    shifts: Bytes
    """For bits, the bit number within the byte, (n,)."""
    dtype: np.dtype[Any]
    """The type as in the controller; of kind V if it is not a number."""

    def __len__(self) -> int:
        return len(self.index)

    @cached_property
    def limits(self) -> tuple[Any, Any]:
        """The least and the greatest number, in the type used for calculations."""
        if self.dtype.kind == "f":
            most = _REAL_LIMIT if self.dtype.itemsize == 4 else float(np.finfo(np.float64).max)
            return -most, most
        bounds, exact = np.iinfo(self.dtype), np.longdouble if self.dtype.itemsize == 8 else np.float64
        return exact(bounds.min), exact(bounds.max)

    def numbers(self, image: Bytes) -> Values:
        """Return the values, 64-bit ones as long doubles because a double would lose digits."""
        exact = np.longdouble if self.dtype.kind in "iu" and self.dtype.itemsize == 8 else np.float64
        return np.ascontiguousarray(image[self.index]).view(self.dtype)[:, 0].astype(exact)

    def put_numbers(self, image: Bytes, values: Values) -> None:
        """Put numbers into an image, rounded for integers and clamped to the range of the type."""
        least, most = self.limits
        if self.dtype.kind != "f":
            values = np.rint(values)
            if self.dtype.itemsize == 8:  # its limits are not exact as doubles
                values = values.astype(np.longdouble)
        fitting = np.minimum(np.maximum(values, least), most).astype(self.dtype)
        image[self.index] = fitting.view(np.uint8).reshape(self.index.shape)

    def put(self, image: Bytes, table: Bytes, choice: npt.NDArray[np.intp]) -> None:
        """Put values of a table (k, size) into an image; ``choice`` (n,) selects a row for each element.

        Bits are 0 or 1.
        """
        if self.element.base != "BOOL":
            image[self.index] = table[choice]
            return
        on, off = self._masks(table[choice, 0] != 0)
        np.bitwise_or.at(image, self.index, on)
        np.bitwise_and.at(image, self.index, ~off)

    def _masks(self, set_bits: npt.NDArray[np.bool_]) -> tuple[Bytes, Bytes]:
        bits = (np.uint8(1) << self.shifts).astype(np.uint8)
        return np.where(set_bits, bits, np.uint8(0)), np.where(set_bits, np.uint8(0), bits)


def places(registers: Iterable[Register], byte_order: ByteOrder) -> list[ValueGroup]:
    """Return the single values of registers and arrays, grouped by type.

    Raises:
        ValueError: There are more than MAX_ELEMENTS.

    """
    found: dict[ElementType, list[tuple[int, int]]] = {}
    count = 0
    for register in registers:
        count += register.count
        if count > MAX_ELEMENTS:
            raise ValueError(f"more than {MAX_ELEMENTS} single values: name fewer")
        element, into = register.element, found.setdefault(register.element, [])
        if element.base == "BOOL":
            into += [(register.offset + byte, bit) for byte, bit in bit_positions(register)]
        else:
            into += [(register.offset + flat * element.stride, 0) for flat in range(register.count)]
    groups = []
    first = 0
    for element, at in found.items():
        starts = np.array([byte for byte, _ in at], dtype=np.intp)
        shifts = np.array([bit for _, bit in at], dtype=np.uint8)
        index = starts if element.base == "BOOL" else starts[:, None] + np.arange(element.size)
        groups.append(ValueGroup(element, first, index, shifts, number_type(element, byte_order)))
        first += len(at)
    return groups


def number_type(element: ElementType, byte_order: ByteOrder) -> np.dtype[Any]:
    """Return the numpy type of a number as in the controller; of kind V if it is not a number."""
    plain = "" if element.base == "BOOL" else scalar_codec(element, byte_order).plain
    kind = _NUMPY.get(plain, f"V{element.size}")
    return np.dtype(("<" if byte_order == "little" else ">") + kind)


_NUMPY: Final = {
    "b": "i1", "B": "u1", "h": "i2", "H": "u2", "i": "i4", "I": "u4", "q": "i8", "Q": "u8", "f": "f4", "d": "f8",
}  # fmt: skip

Change = Callable[[ValueGroup, Values], Values]
"""Computes new values from the old ones."""
