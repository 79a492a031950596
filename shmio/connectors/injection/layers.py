"""The injections that stand between a source's device and everybody else: what each covers, what goes where. No I/O.

The chain runs from the device outward on ``/out``, toward it on ``/in``: the highest priority is outermost, of equal
ones the newest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from shmio.layout.values.write import Write, apply, merge
from shmio.segment import Direction

MAX_INJECTIONS: Final = 64
"""At once, on one source."""

Bits = np.ndarray[Any, np.dtype[np.uint8]]


@dataclass(frozen=True)
class Owner:
    """Who laid an injection: a command queue, and the process that had it then."""

    writer: int
    pid: int


class CycleImage(NamedTuple):
    """The image published last: its cycle, the instance's clock of that, and what the device delivered."""

    cycle: int
    time_ns: int
    raw: bytes


@dataclass
class Layer:
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

    @property
    def given(self) -> bool:
        """Whether it lies over ``/out`` and a client gives it values, who is told those that come from further in."""
        return self.direction is Direction.OUT

    @property
    def active(self) -> bool:
        """Whether it changes what it covers at present."""
        return True

    def show(self, image: Bits, now: CycleImage) -> None:  # noqa: ARG002  what its client gave last holds at any time
        """Put into an image what consumers get for the covered bits of ``/out``."""
        image ^= (image ^ self.values) & self.cover

    def transform_write(self, write: Write, bits: Bits, now: CycleImage) -> bytes | None:  # noqa: ARG002
        """What becomes of these bits of a write toward the device: its data, the same object if unchanged.

        None: they go no further.
        """
        return None


class DivertedWrite(NamedTuple):
    """What became of a write on its way to the device."""

    met: list[tuple[Layer, list[Write]]]
    """What came to injections that took it, or made something else of it."""
    left: bytes
    """Which of its bits go to the device,"""
    data: bytes
    """with which values,"""
    by: Layer | None
    """and the last injection that has changed some of these."""


@dataclass
class LayerStack:
    """All injections of one block of ``size`` bytes; the innermost first."""

    size: int
    layers: list[Layer] = field(default_factory=list)
    now: CycleImage = field(default_factory=lambda: CycleImage(-1, 0, b""))

    def lay(self, injection: Layer) -> str:
        """Add a layer; why not, or empty."""
        if any(layer.id == injection.id for layer in self.layers):
            return f"there is an injection {injection.id} already"
        if len(self.layers) >= MAX_INJECTIONS:
            return f"{MAX_INJECTIONS} injections stand on this source already: lift one"
        place = sum(layer.priority <= injection.priority for layer in self.layers)
        self.layers.insert(place, injection)
        return ""

    def find(self, number: int) -> Layer | None:
        """The layer of this number."""
        return next((layer for layer in self.layers if layer.id == number), None)

    def lift(self, which: Callable[[Layer], bool]) -> list[Layer]:
        """Remove layers; those that there were."""
        lifted = [layer for layer in self.layers if which(layer)]
        self.layers = [layer for layer in self.layers if not which(layer)]
        return lifted

    def effective(self, raw: bytes) -> bytes | None:
        """What consumers see of an image, that of ``now``; None: the image itself."""
        layers = [layer for layer in self.layers if layer.direction is Direction.OUT and layer.active]
        return self.seen(raw, layers).tobytes() if layers else None

    def seen(self, raw: bytes, inner: Iterable[Layer]) -> Bits:
        """What these layers over ``/out`` make of an image."""
        image = np.frombuffer(raw, np.uint8).copy()
        for layer in inner:
            layer.show(image, self.now)
        return image

    def before(self, raw: bytes, layer: Layer) -> Bits:
        """What consumers would see of an image without a layer and those further out."""
        return self.seen(raw, self.inner(layer))

    def inner(self, layer: Layer) -> list[Layer]:
        """The layers over ``/out`` that are further in than one of them, and change what they cover."""
        inner = self.layers[: self.layers.index(layer)]
        return [other for other in inner if other.direction is Direction.OUT and other.active]

    def outer(self, layer: Layer) -> list[Layer]:
        """Those that are further out and that clients give values to; of one over ``/in`` none."""
        if layer.direction is Direction.IN:
            return []
        return [other for other in self.layers[self.layers.index(layer) + 1 :] if other.given]

    def inner_values(self, raw: bytes, layer: Layer) -> list[Write]:
        """What a layer over ``/out`` gets from those further in; the rest of its bits come from the device."""
        inner = self.inner(layer)
        bits = np.zeros(self.size, np.uint8)
        for other in inner:
            bits |= other.cover & layer.cover
        return merge(self.seen(raw, inner).tobytes(), bits.tobytes(), [(0, self.size)] if inner else [])

    def onward(self, raw: bytes, layer: Layer, write: Write) -> list[tuple[Layer, list[Write]]]:
        """What of the values that a layer over ``/out`` gives goes to clients' further out, instead of to consumers.

        It is what those in between make of it.
        """
        taken: list[tuple[Layer, list[Write]]] = []
        bits = np.full(len(write.data), write.mask or 0xFF, np.uint8)
        for other in self.outer(layer):
            span = slice(write.offset, write.offset + len(write.data))
            hit = bits & other.cover[span]
            if hit.any():
                data = self.before(raw, other)[span].tobytes()
                taken.append((other, parts_of(write._replace(data=data), hit)))
                bits &= ~hit
        return taken

    def divert(self, write: Write, above: Layer | None) -> DivertedWrite:
        """Let a write meet the injections on its way to the device.

        ``above``: the injection whose values these are; only what stands below it, if it still does, is on their way.
        """
        met: list[tuple[Layer, list[Write]]] = []
        by = None
        span = slice(write.offset, write.offset + len(write.data))
        bits = np.full(len(write.data), write.mask or 0xFF, np.uint8)
        place = next((place for place, layer in enumerate(self.layers) if layer is above), None)
        for layer in reversed(self.layers[:place]):
            if layer.direction is not Direction.IN or not layer.active:
                continue
            hit = bits & layer.cover[span]
            if not hit.any():
                continue
            data = layer.transform_write(write, hit, self.now)
            if data is write.data:
                continue
            met.append((layer, parts_of(write, hit)))
            if data is None:
                bits &= ~hit
            else:
                write, by = write._replace(data=data), layer
        return DivertedWrite(met, bits.tobytes(), write.data, by)


def shadow(injection: Layer, writes: Sequence[Write]) -> str:
    """Give consumers other values for bits that an injection covers; why not, or empty."""
    if reason := uncovered(injection, writes):
        return reason
    for write in writes:
        apply(write, injection.values.data)
    return ""


def uncovered(injection: Layer, writes: Iterable[Write]) -> str:
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


def parts_of(write: Write, bits: Bits) -> list[Write]:
    """The part of a write that these of its bits are."""
    return [
        Write(write.offset + part.offset, part.mask, part.data)
        for part in merge(write.data, bits.tobytes(), [(0, len(write.data))])
    ]
