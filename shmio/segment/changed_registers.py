"""Find the registers that differ between two images of a block.

A scan compares bytes, not values: a NaN whose bytes stay the same has not changed, but a change from
0.0 to -0.0 counts. For a BOOL, only its bit is compared. Padding is ignored. If the layout has a
status area, a change of a register's status code counts, but not a change of its source time alone.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence

from shmio.layout.model import Register
from shmio.layout.values.write import bits_of
from shmio.model.statuses import StatusArea
from shmio.segment import _atomics

_ENTRY = struct.Struct("=IIII")  # offset, size, mask, index: scan_entry in _atomics.c


class ChangeScan:
    """Compares the given registers in two images, in C code. An object never changes."""

    def __init__(self, registers: Sequence[Register], statuses: StatusArea | None = None) -> None:
        """Prepare the comparison of these registers.

        ``statuses`` is the layout's status area; None: compare no status codes.
        """
        if statuses is not None:
            parts = [entries([register], index, statuses) for index, register in enumerate(registers)]
        else:  # the same, faster
            parts = [_ENTRY.pack(*run, index) for index, register in enumerate(registers) for run in runs(register)]
        self._table = b"".join(parts)

    @classmethod
    def joined(cls, parts: Iterable[bytes]) -> ChangeScan:
        """Create a scan of all registers in ``parts``, which :func:`entries` has encoded."""
        scan = cls(())
        scan._table = b"".join(parts)
        return scan

    def changed(self, old: bytes, new: bytes) -> list[int]:
        """Return the ascending indices of the registers whose bytes differ in the images ``old`` and ``new``.

        Raises:
            ValueError: The images differ in size, or are too short for the registers.
        """
        return _atomics.changed(old, new, self._table)


def entries(registers: Sequence[Register], index: int, statuses: StatusArea | None = None) -> bytes:
    """Encode a part of a scan: the scan reports ``index`` if any of these registers has changed.

    ``statuses`` is the status area of the layout; None: the scan ignores statuses.
    """
    found = [_ENTRY.pack(*run, index) for register in registers for run in runs(register)]
    if statuses is not None:
        indices = dict.fromkeys(statuses.indices(registers))
        found += [_ENTRY.pack(*statuses.code_range(register), 0, index) for register in indices]
    return b"".join(found)


def runs(register: Register) -> Iterator[tuple[int, int, int]]:
    """Yield (offset, size, mask) for each run of bytes that hold a register's data.

    In ``mask``, the bits that belong to the register are set; 0: all bits belong to it.
    """
    offset, element = register.offset, register.element
    if register.partial:
        masks = bits_of(register)
        yield offset, 1, masks[0]
        if len(masks) > 2:
            yield offset + 1, len(masks) - 2, 0
        if len(masks) > 1:
            yield offset + len(masks) - 1, 1, masks[-1]
    elif register.bit is not None:
        # A row of bits starts at a byte boundary; its last byte may be padded.
        bits = register.shape[-1] if register.dims else 1
        first = 0 if register.dims else register.bit
        for row in range(register.count // bits):
            start = offset + row * -(-bits // 8)
            whole, rest = divmod(bits, 8) if register.dims else (0, 1)
            if whole:
                yield start, whole, 0
            if rest:
                yield start + whole, 1, ((1 << rest) - 1) << first
    elif element.stride == element.size:
        yield offset, register.size, 0
    else:  # strings of odd length have a byte of padding between them
        for start in range(offset, offset + register.size, element.stride):
            yield start, element.size, 0
