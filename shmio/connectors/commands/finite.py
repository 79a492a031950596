"""Keeps NaN and infinities from reaching a device, whose arithmetic does not expect them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from shmio.layout.model import Layout, Register
from shmio.layout.values.write import Write, cover, path_at

_EXPONENTS: Final = {"REAL": b"\x7f\x80\0\0", "LREAL": b"\x7f\xf0\0\0\0\0\0\0"}
"""The exponent bits, most significant byte first. A number with all of them set is not finite."""


class FiniteCheck:
    """Refuses non-finite values for REAL and LREAL registers without an exemption."""

    def __init__(self, layout: Layout, allowed: Iterable[str]) -> None:
        """Create the check; ``allowed`` are patterns of registers that may take any value."""
        self._layout = layout
        allowed_bits = np.frombuffer(cover(layout, allowed), np.uint8)
        self._exponents = np.zeros(layout.size, np.uint8)
        self._starts = np.zeros(layout.size, np.int32)  # for each exponent byte, the offset of its number
        for register in layout.registers:
            if register.type in _EXPONENTS:
                self._guard(register, allowed_bits)
        self._guarded = (self._exponents != 0).tobytes()

    def _guard(self, register: Register, allowed: np.ndarray[tuple[int], np.dtype[np.uint8]]) -> None:
        exponent = _EXPONENTS[register.type]
        if self._layout.byte_order == "little":
            exponent = exponent[::-1]
        starts = register.offset + np.arange(register.count, dtype=np.int32) * register.element.stride
        starts = starts[allowed[starts] != 0xFF]
        for at, bits in enumerate(exponent):
            if bits:
                self._exponents[starts + at] = bits
                self._starts[starts + at] = starts

    def refusal(self, writes: Iterable[Write]) -> str:
        """Return why these writes are refused, naming one register; empty if they are fine.

        A write of a part of a number must not set all exponent bits in that part either. So no
        sequence of writes can set them all.
        """
        for offset, mask, data in writes:
            stop = offset + len(data)
            if self._guarded.find(1, offset, stop) < 0:
                continue
            wanted = self._exponents[offset:stop] & (mask or 0xFF)
            zeros = np.flatnonzero(wanted & ~np.frombuffer(data, np.uint8))
            starts = self._starts[offset:stop]
            wrong = np.setdiff1d(starts[np.flatnonzero(wanted)], starts[zeros])
            if len(wrong):
                path = path_at(self._layout, int(wrong[0]))
                return (
                    f"{path}: NaN and infinities are written only if the source's `allow_nonfinite` names the register"
                )
        return ""
