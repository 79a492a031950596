"""What an injection over ``/out`` stands over: what the source delivers, or clients' injections further in give."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from shmio.layout.values.write import Write
from shmio.segment import Block
from shmio.segment.pending_commands import apply


class InjectionBase:
    """The image beneath one injection of a block."""

    def __init__(self, block: Block, image: bytes = b"") -> None:
        """``image``: as it is at first, as far as others further in give it; default: zeros."""
        self.number = 0
        """The injection's, once that is known."""
        self.given = bytearray(image or bytes(block.layout.size))
        """What was diverted to it so far."""
        self._block = block
        self._inner: tuple[bytes, bytes] | None = None  # bits that injections further in give, and values

    def divert(self, writes: Iterable[Write]) -> None:
        """An injection further in gave these values."""
        apply(self.given, writes)

    def restack(self) -> bool:
        """Look what lies beneath it by now; whether that is something else."""
        before = self._inner
        bits = np.zeros(len(self.given), np.uint8)
        for one in self._block.standing.read() if self.number else ():
            if one.id == self.number:
                break
            if one.direction == "out" and one.active:
                for offset, size, mask in one.ranges:
                    bits[offset : offset + size] |= mask
        self._inner = (bits.tobytes(), bytes(self.given)) if bits.any() else None
        return self._inner != before

    def image(self, raw: bytes) -> bytes:
        """An image that the source delivered, as the injection finds it."""
        inner = self._inner
        if inner is None:
            return raw
        delivered, bits, values = (np.frombuffer(part, np.uint8) for part in (raw, *inner))
        return (delivered ^ (delivered ^ values) & bits).tobytes()
