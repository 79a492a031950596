"""The image beneath an injection: what the source delivers, with inner injections applied."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from shmio.layout.values.write import Write
from shmio.segment import Block
from shmio.segment.commands import apply


class InjectionBase:
    """The image beneath one injection: the source's bytes with inner injections applied."""

    def __init__(self, block: Block, image: bytes = b"") -> None:
        """``image``: the initial values of inner injections; default: zeros."""
        self.number = 0
        """The injection's number, once it is known; 0 before."""
        self.given = bytearray(image or bytes(block.layout.size))
        """The values that were diverted to the injection so far, as an image."""
        self._block = block
        self._inner: tuple[bytes, bytes] | None = None  # bits that inner injections set, and their values

    def divert(self, writes: Iterable[Write]) -> None:
        """Apply values that were diverted to the injection."""
        apply(self.given, writes)

    def restack(self) -> bool:
        """Read which inner injections stand; return whether the image beneath has changed."""
        before = self._inner
        bits = np.zeros(len(self.given), np.uint8)
        for one in self._block.standing.read() if self.number else ():
            if one.number == self.number:
                break
            if one.direction == "out" and one.active:
                for offset, size, mask in one.ranges:
                    bits[offset : offset + size] |= mask
        self._inner = (bits.tobytes(), bytes(self.given)) if bits.any() else None
        return self._inner != before

    def image(self, raw: bytes) -> bytes:
        """Return the image beneath the injection, given what the source delivered."""
        inner = self._inner
        if inner is None:
            return raw
        delivered, bits, values = (np.frombuffer(part, np.uint8) for part in (raw, *inner))
        return (delivered ^ (delivered ^ values) & bits).tobytes()
