"""The injections that stand between a source's device and everybody else: what each covers, what goes where. No I/O.

The chain runs from the device outward on ``/out``, toward it on ``/in``: the highest priority is outermost, of equal
ones the newest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from shmio.layout.write import Write, apply, merge
from shmio.segment import Direction

MAX_INJECTIONS: Final = 64
"""At once, on one source."""

Bits = np.ndarray[Any, np.dtype[np.uint8]]


@dataclass(frozen=True)
class Owner:
    """Who laid an injection: a command queue, and the process that had it then."""

    writer: int
    pid: int


@dataclass
class Injection:
    """One layer. ``cover``: an image of the block in which the bits that it stands over are set."""

    id: int
    direction: Direction
    priority: int
    keep: bool
    name: str
    owner: Owner
    cover: Bits
    values: Bits
    """What consumers get for the covered bits of ``/out``."""


@dataclass
class Injections:
    """All injections of one block of ``size`` bytes; the innermost first."""

    size: int
    layers: list[Injection] = field(default_factory=list)

    def lay(self, injection: Injection) -> str:
        """Add a layer; why not, or empty."""
        if any(layer.id == injection.id for layer in self.layers):
            return f"there is an injection {injection.id} already"
        if len(self.layers) >= MAX_INJECTIONS:
            return f"{MAX_INJECTIONS} injections stand on this source already: lift one"
        place = sum(layer.priority <= injection.priority for layer in self.layers)
        self.layers.insert(place, injection)
        return ""

    def find(self, number: int) -> Injection | None:
        """The layer of this number."""
        return next((layer for layer in self.layers if layer.id == number), None)

    def lift(self, which: Callable[[Injection], bool]) -> list[Injection]:
        """Remove layers; those that there were."""
        lifted = [layer for layer in self.layers if which(layer)]
        self.layers = [layer for layer in self.layers if not which(layer)]
        return lifted

    def effective(self, raw: bytes) -> bytes | None:
        """What consumers see of an image; None: the image itself."""
        layers = [layer for layer in self.layers if layer.direction is Direction.OUT]
        return self.seen(raw, layers).tobytes() if layers else None

    def seen(self, raw: bytes, inner: Iterable[Injection]) -> Bits:
        """What these layers over ``/out`` make of an image."""
        image = np.frombuffer(raw, np.uint8).copy()
        for layer in inner:
            image ^= (image ^ layer.values) & layer.cover
        return image

    def inner(self, layer: Injection) -> list[Injection]:
        """The layers over ``/out`` that are further in than one of them."""
        return [other for other in self.layers[: self.layers.index(layer)] if other.direction is Direction.OUT]

    def outer(self, layer: Injection) -> list[Injection]:
        """Those that are further out; of one over ``/in`` none."""
        if layer.direction is Direction.IN:
            return []
        return [other for other in self.layers[self.layers.index(layer) + 1 :] if other.direction is Direction.OUT]

    def beneath(self, raw: bytes, layer: Injection) -> list[Write]:
        """What a layer over ``/out`` gets from those further in; the rest of its bits come from the device."""
        inner = self.inner(layer)
        bits = np.zeros(self.size, np.uint8)
        for other in inner:
            bits |= other.cover & layer.cover
        return merge(self.seen(raw, inner).tobytes(), bits.tobytes(), [(0, self.size)] if inner else [])

    def onward(self, layer: Injection, write: Write) -> list[tuple[Injection, list[Write]]]:
        """What of the values that a layer over ``/out`` gives goes to those further out, instead of to consumers."""
        taken: list[tuple[Injection, list[Write]]] = []
        bits = np.full(len(write.data), write.mask or 0xFF, np.uint8)
        for other in self.outer(layer):
            hit = bits & other.cover[write.offset : write.offset + len(write.data)]
            if hit.any():
                taken.append((other, _writes(write, hit)))
                bits &= ~hit
        return taken

    def divert(self, write: Write, above: Injection | None) -> tuple[list[tuple[Injection, list[Write]]], bytes]:
        """What of a write goes to injections on its way to the device, and which of its bits are left for that.

        ``above``: the injection whose values these are; only what stands below it is on their way.
        """
        taken: list[tuple[Injection, list[Write]]] = []
        span = slice(write.offset, write.offset + len(write.data))
        bits = np.full(len(write.data), write.mask or 0xFF, np.uint8)
        below = self.layers if above is None else self.layers[: self.layers.index(above)]
        for layer in reversed(below):
            if layer.direction is Direction.IN and (hit := bits & layer.cover[span]).any():
                taken.append((layer, _writes(write, hit)))
                bits &= ~hit
        return taken, bits.tobytes()


def shadow(injection: Injection, writes: Sequence[Write]) -> str:
    """Give consumers other values for bits that an injection covers; why not, or empty."""
    if reason := uncovered(injection, writes):
        return reason
    for write in writes:
        apply(write, injection.values.data)
    return ""


def uncovered(injection: Injection, writes: Iterable[Write]) -> str:
    """Why values are not an injection's to give; empty if they are."""
    for write in writes:
        cover = injection.cover[write.offset : write.offset + len(write.data)]
        if len(cover) < len(write.data) or (~cover & (write.mask or 0xFF)).any():
            last = write.offset + len(write.data) - 1
            return f"bytes {write.offset} to {last} are not covered by the injection {injection.name or injection.id}"
    return ""


def covering(size: int, writes: Sequence[Write]) -> Bits:
    """The bits that the items of an INJECT command set; ValueError: beyond the block."""
    cover = np.zeros(size, np.uint8)
    for offset, mask, data in writes:
        if offset + len(data) > size:
            raise ValueError(f"byte {offset + len(data) - 1} lies outside the block")
        cover[offset : offset + len(data)] |= np.frombuffer(data, np.uint8) & (mask or 0xFF)
    return cover


def _writes(write: Write, bits: Bits) -> list[Write]:
    """The part of a write that these of its bits are."""
    return [
        Write(write.offset + part.offset, part.mask, part.data)
        for part in merge(write.data, bits.tobytes(), [(0, len(write.data))])
    ]
