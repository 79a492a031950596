"""Numbers of a structure put into an image, or read from it, all at once."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any, Final, NamedTuple

import numpy as np

from shmio.layout.model import ByteOrder, Register
from shmio.layout.scalar import scalar_codec

_NUMBERS: Final = frozenset({int, float, np.float64})


class _Run(NamedTuple):
    """Numbers without a gap between them. ``values``: which of all they are."""

    where: slice
    packing: struct.Struct
    values: slice


class Bulk:
    """Registers that are single numbers: where each goes is worked out once."""

    def __init__(self, names: Sequence[str], runs: Sequence[_Run]) -> None:
        """``names``: two or more."""
        self._names = tuple(names)
        self._runs = tuple(runs)
        self._values = itemgetter(*names)

    @classmethod
    def of(cls, registers: Mapping[str, Register], byte_order: ByteOrder) -> Bulk | None:
        """That of these, by their names; None: there are not two, or one is no number."""
        codes = [_code(register, byte_order) for register in registers.values()]
        if len(codes) < 2 or not all(codes):
            return None
        order = ">" if byte_order == "big" else "<"
        return cls(tuple(registers), list(_runs(list(registers.values()), codes, order)))

    def read(self, image: bytearray) -> dict[str, Any]:
        """All values, by name."""
        found: list[float] = []
        for run in self._runs:
            found += run.packing.unpack_from(image, run.where.start)
        return dict(zip(self._names, found, strict=True))

    def write(self, values: Mapping[str, object], image: bytearray) -> bool:
        """Put them in; False, and nothing is, unless they are all there and each is a number that fits."""
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
    """That of ``struct``; empty: it is no single number."""
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
