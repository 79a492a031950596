"""Parts of registers as registers: slices of arrays, and bits, bytes and words of integers.

- ``Inputs/2..5``: a range in place of an array's last index; the slice has one dimension.
- ``Outputs/13.%X0``: a bit of an integer, as in STEP 7's slice access; bit 0 is the lowest.
  ``.%B1`` is a byte, ``.%W0`` a word, ``.%D0`` a double word; number 0 is the least significant.

A member's name never ends in such a part: its ``%`` would be encoded.
"""

from __future__ import annotations

import re
from typing import Final

from shmio.errors import PathError
from shmio.layout.model import Layout, Register, array_size
from shmio.layout.types import INTEGERS

PART: Final = re.compile(r"(?P<head>.+)\.%(?P<kind>[XBWD])(?P<number>[0-9]{1,3})")
"""Matches a last segment that names a part of an integer."""
RANGE: Final = re.compile(r"(?P<low>0|-?[1-9][0-9]{0,9})\.\.(?P<high>0|-?[1-9][0-9]{0,9})")
"""Matches a last segment that names a slice."""
_WIDTHS: Final = {"B": ("BYTE", 1), "W": ("WORD", 2), "D": ("DWORD", 4)}


def part_of(layout: Layout, register: Register, kind: str, number: int) -> Register:
    """Return a bit (kind ``X``), byte (``B``), word (``W``) or double word (``D``) of an integer.

    Raises:
        PathError: The register is not an integer, or has no such part.

    """
    path = f"{register.path}.%{kind}{number}"
    if register.dims or register.type not in INTEGERS:
        what = "an array" if register.dims else register.type
        raise PathError(f"{path}: {what} has no such part: bits, bytes and words are of one integer")
    size = register.size
    if kind == "X":
        byte, bit = divmod(number, 8)
        if byte >= size:
            raise PathError(f"{path}: {register.type} has bits 0 to {8 * size - 1}")
        at = size - 1 - byte if layout.byte_order == "big" else byte
        return Register(path, "BOOL", (), register.offset + at, bit, 1, 1, register.comment)
    name, width = _WIDTHS[kind]
    if width >= size or number >= size // width:
        widths = [(other, step) for other, (_, step) in _WIDTHS.items() if step < size]
        there = [f"%X0 to %X{8 * size - 1}", *(f"%{other}0 to %{other}{size // step - 1}" for other, step in widths)]
        raise PathError(f"{path}: {register.type} has no such part; it has {', '.join(there)}")
    at = size - width * (number + 1) if layout.byte_order == "big" else width * number
    return Register(path, name, (), register.offset + at, None, width, 1, register.comment)


def slice_of(layout: Layout, array: Register, leading: tuple[int, ...], low: int, high: int) -> Register:
    """Return the elements ``low`` to ``high`` of an array's last dimension as one register.

    ``leading`` holds the indices of the other dimensions.

    Raises:
        PathError: The array has no such row, or lacks some of these elements.

    """
    path = "/".join((array.path, *map(str, leading), f"{low}..{high}"))
    if len(array.dims) != len(leading) + 1:
        raise PathError(f"{path}: a range must take the place of an array's last index")
    if high < low:
        raise PathError(f"{path}: write the lower index first")
    first = layout.element(array, (*leading, low))
    layout.element(array, (*leading, high))
    count = high - low + 1
    if first.bit is None:
        size = array_size(array.element, (count,))
        return Register(path, array.type, ((low, high),), first.offset, None, size, count, array.comment)
    size = -(-(first.bit + count) // 8)
    return Register(
        path, "BOOL", ((low, high),), first.offset, first.bit, size, count, array.comment, partial=True
    )  # fmt: skip
