"""Which registers differ between two frames.

Bytes are compared, never values: a NaN that stays the same has not changed, and 0.0 that became -0.0 has.
A BOOL is its bit alone; padding belongs to nobody.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from shmio.layout.model import Layout, Register, element_position

Frame = bytes | bytearray | memoryview | npt.NDArray[np.uint8]
_Bytes = npt.NDArray[np.uint8]


class ChangeScan:
    """Compares frames of one layout, for all of its registers or those given by index.

    It works in a buffer of its own: one object for each thread.
    """

    def __init__(self, layout: Layout, indices: Sequence[int] | None = None) -> None:
        chosen = range(len(layout.registers)) if indices is None else sorted(set(indices))
        registers = [layout.registers[index] for index in chosen]
        self._indices = np.array(chosen, dtype=np.intp)
        # Pairs (first, after last) for reduceat, which needs a byte behind the last register.
        spans = [(register.offset, register.offset + register.size) for register in registers]
        self._spans = np.array(spans, dtype=np.intp).reshape(-1)
        self._difference = np.zeros(layout.size + 1, dtype=np.uint8)
        # What belongs to a chosen register at all, and what of a byte belongs to one BOOL.
        self._owned = np.zeros(layout.size, dtype=np.uint8)
        self._masks = np.full(len(registers), 0xFF, dtype=np.uint8)
        for position, register in enumerate(registers):
            mark(self._owned, register)
            if register.bit is not None and not register.dims:
                self._masks[position] = 1 << register.bit

    def changed(self, old: Frame, new: Frame) -> npt.NDArray[np.intp]:
        """Return the indices of the registers whose bytes differ, ascending.

        The frames have the layout's size; ValueError otherwise.
        """
        if isinstance(old, bytes) and isinstance(new, bytes) and old == new:
            return self._indices[:0]
        difference = self._difference[:-1]
        np.bitwise_xor(np.frombuffer(old, np.uint8), np.frombuffer(new, np.uint8), out=difference)
        difference &= self._owned
        if not difference.any():
            return self._indices[:0]
        differs = np.bitwise_or.reduceat(self._difference, self._spans)[::2] & self._masks
        changed: npt.NDArray[np.intp] = self._indices[differs != 0]
        return changed


def mark(mask: _Bytes, register: Register) -> None:
    """Set in a mask of a whole frame the bits that hold the register's data."""
    start, stop = register.offset, register.offset + register.size
    if register.bit is None:
        element = register.element
        if element.stride == element.size:
            mask[start:stop] = 0xFF
        else:  # strings of odd length have a byte of padding between them
            for first in range(start, stop, element.stride):
                mask[first : first + element.size] = 0xFF
    elif not register.dims:
        mask[start] |= 1 << register.bit
    else:
        for flat in range(register.count):
            byte, bit = element_position(register.element, register.shape, flat)
            mask[start + byte] |= 1 << (bit or 0)
