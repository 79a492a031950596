"""Find changes of registers in many frames at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from shmio.layout.model import Register
from shmio.recording.reading.batch import Batch
from shmio.recording.reading.blocks import DumpBlock
from shmio.segment.changed_registers import runs

_Bytes = npt.NDArray[np.uint8]


def register_bytes(registers: Sequence[Register]) -> tuple[npt.NDArray[np.intp], _Bytes]:
    """Return offset and mask of each byte of an image that holds data of the registers, without padding."""
    places: list[int] = []
    masks: list[int] = []
    for register in registers:
        for offset, size, mask in runs(register):
            places += range(offset, offset + size)
            masks += [mask or 0xFF] * size
    return np.array(places, np.intp), np.array(masks, np.uint8)


class Changes:
    """Compares the bytes of each frame with those of the previous frame."""

    def __init__(self, chosen: Mapping[DumpBlock, Sequence[Register]]) -> None:
        self._bytes = {block: register_bytes(registers) for block, registers in chosen.items()}
        self._before: dict[DumpBlock, npt.NDArray[Any]] = {}

    def begin(self, block: DumpBlock, image: bytes) -> None:
        """Set the image before the first frame."""
        if block in self._bytes:
            self._before[block] = self._of(block, np.frombuffer(image, np.uint8)[None, :])[0]

    def _of(self, block: DumpBlock, images: _Bytes) -> _Bytes:
        places, masks = self._bytes[block]
        found: _Bytes = images[:, places] & masks
        return found

    def first(self, block: DumpBlock, batch: Batch) -> int | None:
        """Return the index of the first frame that differs; the first frame of a block counts as unchanged."""
        if block not in self._bytes:
            return None
        now = self._of(block, batch.images)
        before = np.concatenate((self._before.get(block, now[0])[None, :], now[:-1]))
        self._before[block] = now[-1]
        changed = (now != before).any(axis=1)
        return int(changed.argmax()) if changed.any() else None
