"""Applies the injections of a source to its images and writes. No I/O.

Each injection is a layer over the source's block. Images on ``/out`` pass the layers from the
innermost to the outermost; writes on ``/in`` pass them from the outermost to the innermost. The
layer with the highest priority is outermost. Of layers with the same priority, the newest is
outermost. The values of a layer come from a client, or from the operation of a declared injection.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from msgspec import Struct

from shmio.config import Declaration
from shmio.injection import Program
from shmio.injection._numbers import change_all
from shmio.injection.activation import Activation, State
from shmio.injection.condition import Memory
from shmio.injection.draw import SeededRandom
from shmio.injection.operations import Delay, Drop, Operation, OperationContext
from shmio.layout.values.write import Write, apply, merge
from shmio.model.injection import Running
from shmio.model.values import NO_WRITER
from shmio.segment import Direction

if TYPE_CHECKING:
    from shmio.injection._numbers import Change

MAX_INJECTIONS: Final = 64
"""The largest number of injections on one source at a time."""
MAX_HELD: Final = 256
"""The largest number of writes that one injection may delay at once; further writes are rejected."""

Bits = np.ndarray[Any, np.dtype[np.uint8]]

_ACTIVE: Final = State.ACTIVE


@dataclass(frozen=True)
class Owner:
    """The owner of an injection: the command queue used to create it, and the process that used this queue."""

    writer: int
    pid: int


class CycleImage(Struct, frozen=True, gc=False):  # each cycle makes one: faster than a tuple
    """The image that the device delivered in a cycle, and the instance time of the cycle in ns."""

    cycle: int
    time_ns: int
    raw: bytes


@dataclass
class Layer:
    """One injection, as the process of its source applies it to images and writes.

    ``cover`` is an array of the block's size, in which the bits that the layer covers are set.
    """

    id: int
    direction: Direction
    priority: int
    keep: bool
    name: str
    owner: Owner
    cover: Bits
    values: Bits
    """The values that readers of ``/out`` see in the covered bits."""

    @property
    def given(self) -> bool:
        """True if the layer covers ``/out`` and a client supplies its values.

        The client receives the values that the layer hides: those of the device or of inner layers.
        """
        return self.direction is Direction.OUT

    @property
    def active(self) -> bool:
        """True if the layer changes the covered bits at present."""
        return True

    @property
    def change(self) -> Change | None:
        """A change that does the same as :meth:`show` while the layer's activation lasts; None: there is none."""
        return None

    def show(self, image: Bits, now: CycleImage) -> None:  # noqa: ARG002  the values do not depend on time
        """Replace the covered bits of an image of ``/out`` by the layer's values, in place."""
        image ^= (image ^ self.values) & self.cover

    def transform_write(self, write: Write, bits: Bits, now: CycleImage) -> bytes | None:  # noqa: ARG002
        """Apply the layer to those bits of a write to the device that ``bits`` selects.

        Returns:
            The new data, or the same object if nothing changes. None if the bits must not reach the
            device.

        """
        return None


class DivertedWrite(NamedTuple):
    """A write to the device, after all layers were applied to it."""

    met: list[tuple[Layer, list[Write]]]
    """The layers that changed the write or took bits from it, each with the parts of the write that it received."""
    left: bytes
    """Mask of the bits that still go to the device."""
    data: bytes
    """The values of the write, after the layers have changed them."""
    by: Layer | None
    """The layer that changed the values last; None if no layer did."""


@dataclass
class LayerStack:
    """All layers over one block of ``size`` bytes, from the innermost to the outermost."""

    size: int
    layers: list[Layer] = field(default_factory=list)
    now: CycleImage = field(default_factory=lambda: CycleImage(-1, 0, b""))

    def __post_init__(self) -> None:
        self._effective = bytearray(self.size)
        self._image = np.frombuffer(self._effective, np.uint8)
        self._shown: tuple[list[Layer], tuple[Change, ...] | None] | None = None
        """The result of :meth:`_find_shown`; None after a change, which makes the last result invalid."""

    def add(self, injection: Layer) -> str:
        """Add a layer; return the reason why it cannot be added, or "" if it was added."""
        if any(layer.id == injection.id for layer in self.layers):
            return f"injection {injection.id} exists already"
        if len(self.layers) >= MAX_INJECTIONS:
            return f"{MAX_INJECTIONS} injections cover this source already, which is the maximum; lift one first"
        place = sum(layer.priority <= injection.priority for layer in self.layers)
        self.layers.insert(place, injection)
        self.settle()
        return ""

    def find(self, number: int) -> Layer | None:
        """Return the layer with an injection number; None if there is none."""
        return next((layer for layer in self.layers if layer.id == number), None)

    def lift(self, which: Callable[[Layer], bool]) -> list[Layer]:
        """Remove and return the layers that ``which`` selects."""
        lifted = [layer for layer in self.layers if which(layer)]
        self.layers = [layer for layer in self.layers if not which(layer)]
        self.settle()
        return lifted

    def effective(self, raw: bytes) -> bytes | bytearray | None:
        """Return the image that readers see instead of ``raw``; None if no active layer covers ``/out``.

        The next call overwrites the image.
        """
        shown = self._shown
        if shown is None:
            shown = self._shown = self._find_shown()
        layers, changes = shown
        if not layers:
            return None
        self._effective[:] = raw
        if changes is not None:
            change_all(self._effective, changes, self.now.cycle)
        else:
            for layer in layers:
                layer.show(self._image, self.now)
        return self._effective

    def settle(self) -> None:
        """Take a change into account: of the layers, or of what the activations of declared ones have become."""
        self._shown = None

    def _find_shown(self) -> tuple[list[Layer], tuple[Change, ...] | None]:
        """Return the active layers over ``/out``, and the changes that do the same; None: not all are changes."""
        layers = [layer for layer in self.layers if layer.direction is Direction.OUT and layer.active]
        changes = [layer.change for layer in layers]
        known = tuple(change for change in changes if change is not None)
        return layers, known if len(known) == len(layers) else None

    def seen(self, raw: bytes, inner: Iterable[Layer]) -> Bits:
        """Return a copy of the image ``raw`` after applying the layers ``inner``, which cover ``/out``."""
        image = np.frombuffer(raw, np.uint8).copy()
        for layer in inner:
            layer.show(image, self.now)
        return image

    def before(self, raw: bytes, layer: Layer) -> Bits:
        """Return a copy of ``raw`` as ``layer`` receives it: with all active inner layers applied."""
        return self.seen(raw, self.inner(layer))

    def inner(self, layer: Layer) -> list[Layer]:
        """Return the active layers over ``/out`` that are inside ``layer``."""
        inner = self.layers[: self.layers.index(layer)]
        return [other for other in inner if other.direction is Direction.OUT and other.active]

    def outer(self, layer: Layer) -> list[Layer]:
        """Return the layers over ``/out`` that are outside ``layer`` and whose values come from clients.

        The list is empty if ``layer`` covers ``/in``.
        """
        if layer.direction is Direction.IN:
            return []
        return [other for other in self.layers[self.layers.index(layer) + 1 :] if other.given]

    def inner_values(self, raw: bytes, layer: Layer) -> list[Write]:
        """Return the values that inner layers over ``/out`` give to bits that ``layer`` covers.

        Bits whose values come from the device are left out.
        """
        inner = self.inner(layer)
        bits = np.zeros(self.size, np.uint8)
        for other in inner:
            bits |= other.cover & layer.cover
        return merge(self.seen(raw, inner).tobytes(), bits.tobytes(), [(0, self.size)] if inner else [])

    def onward(self, raw: bytes, layer: Layer, write: Write) -> list[tuple[Layer, list[Write]]]:
        """Return those parts of a write over ``/out`` by a layer's client that outer layers hide from readers.

        Returns:
            Each outer layer whose client receives parts, with these parts. All active layers inside
            that outer layer are already applied to the values.

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
        """Apply the layers over ``/in`` to a write, from the outermost to the innermost.

        Args:
            write: The write.
            above: The layer from which the write comes, as a value from its client or as a write
                that it has delayed. Only layers inside it apply. None: the write comes from no
                layer, and all layers apply.

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
    """Set values of a layer over ``/out``; return "", or a message if the layer does not cover all written bytes."""
    if reason := uncovered(injection, writes):
        return reason
    for write in writes:
        apply(write, injection.values.data)
    return ""


def uncovered(injection: Layer, writes: Iterable[Write]) -> str:
    """Return a message about the first write to bytes that the layer does not cover; "" if there is none."""
    for write in writes:
        cover = injection.cover[write.offset : write.offset + len(write.data)]
        if len(cover) < len(write.data) or (~cover & (write.mask or 0xFF)).any():
            last = write.offset + len(write.data) - 1
            return f"bytes {write.offset} to {last} are not covered by the injection {injection.name or injection.id}"
    return ""


def covering(size: int, writes: Sequence[Write]) -> Bits:
    """Return the bits that an INJECT command covers, as an array of the block's size.

    Raises:
        ValueError: An item lies outside the block.

    """
    cover = np.zeros(size, np.uint8)
    for offset, mask, data in writes:
        if offset + len(data) > size:
            raise ValueError(f"byte {offset + len(data) - 1} lies outside the block")
        cover[offset : offset + len(data)] |= np.frombuffer(data, np.uint8) & (mask or 0xFF)
    return cover


def parts_of(write: Write, bits: Bits) -> list[Write]:
    """Return the parts of a write that set the bits in the mask ``bits``."""
    return [
        Write(write.offset + part.offset, part.mask, part.data)
        for part in merge(write.data, bits.tobytes(), [(0, len(write.data))])
    ]


# -- declared injections -----------------------------------------------------------------------------------------------


class DelayedWrite(NamedTuple):
    """A write that an injection delays, with the cycle and the instance time of its arrival."""

    write: Write
    cycle: int
    time_ns: int


@dataclass(kw_only=True)
class DeclaredLayer(Layer):
    """The layer of one declared injection.

    ``writes`` counts the writes over ``/in`` since the injection became active. ``held`` contains
    the writes that the injection delays at present.
    """

    program: Program
    seed: int
    activation: Activation
    draw: SeededRandom
    operation: Operation
    memory: Memory = field(default_factory=Memory)
    writes: int = 0
    held: deque[DelayedWrite] = field(default_factory=deque)

    @property
    def given(self) -> bool:
        """False: no client supplies the values of a declared injection."""
        return False

    @property
    def active(self) -> bool:
        """True if the injection is active at present."""
        return self.activation.state is _ACTIVE

    @property
    def change(self) -> Change | None:
        """A change that does the same as :meth:`show` while the activation lasts; None: there is none."""
        if self._probability is not None:
            return None
        return self.operation.change(self.activation.runs, self.activation.cycle)

    @property
    def configured(self) -> bool:
        """True if the configuration declares the injection; False if a client does."""
        return self.owner.writer == NO_WRITER

    @property
    def full(self) -> bool:
        """True if the injection delays ``MAX_HELD`` writes, and so cannot delay more."""
        return len(self.held) >= MAX_HELD

    @property
    def running(self) -> Running[Declaration]:
        """The injection's present state, as published in the segment."""
        now = self.activation
        declaration = self.program.declaration
        return Running(declaration, now.state.value, self.seed, now.runs, now.cycle, now.time_ns)

    def resume(self, running: Running[Declaration], seen: Bits) -> None:
        """Restore the state of the previous process. ``seen`` is the image that readers saw last."""
        state = State(running.state)
        self.activation = Activation(self.program.window, state, running.runs, running.cycle, running.time_ns)
        if self.active and self.direction is Direction.OUT:
            self.operation.resume(seen)

    def advance(self, now: CycleImage, *, holds: bool) -> bool:
        """Update the injection's state for the next image, and return whether it has changed.

        ``holds`` is True if the condition is true, or if there is none.
        """
        activation = self.activation
        runs = activation.runs
        changed = activation.advance(now.time_ns, now.cycle, holds=holds)
        if activation.runs != runs:
            self.operation.begin()
            self.writes = 0
        return changed

    def show(self, image: Bits, now: CycleImage) -> None:
        """Apply the operation to the covered bits of an image, in place."""
        activation, operation = self.activation, self.operation
        at = OperationContext(activation.runs, now.cycle - activation.cycle, now.cycle, now.time_ns)
        if self._probability is not None and not self._happens(at):
            operation.passed(image, at)
        elif operation.exact:
            operation.apply(image, at)
        else:
            changed = image.copy()
            operation.apply(changed, at)
            image ^= (image ^ changed) & self.cover

    def transform_write(self, write: Write, bits: Bits, now: CycleImage) -> bytes | None:
        """Apply the operation to those bits of a write to the device that ``bits`` selects.

        Returns:
            The new data; None if the operation drops or delays these bits.

        """
        at = self._moment(self.writes, now)
        self.writes += 1
        if not self._happens(at):
            return write.data
        if isinstance(self.operation, Drop):
            return None
        if isinstance(self.operation, Delay):
            self.held += (DelayedWrite(part, now.cycle, now.time_ns) for part in parts_of(write, bits))
            return None
        span = slice(write.offset, write.offset + len(write.data))
        image = np.frombuffer(now.raw, np.uint8).copy()
        old = np.frombuffer(write.data, np.uint8)
        image[span] ^= (image[span] ^ old) & (write.mask or 0xFF)
        self.operation.apply(image, at)
        return bytes(old ^ (old ^ image[span]) & bits)

    def due(self, now: CycleImage) -> list[Write]:
        """Remove and return the writes whose delay ends with this cycle.

        ``now`` describes the cycle, which will send them to the device.
        """
        due: list[Write] = []
        if not isinstance(self.operation, Delay):
            return due
        at = self._moment(0, now)
        while self.held:
            write, cycle, time_ns = self.held[0]
            # Without a delay, the cycle after the arrival would have written it. The delay starts there.
            if at.cycle <= cycle or not self.operation.due(cycle + 1, time_ns, at):
                break
            due.append(write)
            self.held.popleft()
        return due

    def _moment(self, place: int, now: CycleImage) -> OperationContext:
        return OperationContext(self.activation.runs, place, now.cycle, now.time_ns)

    def _happens(self, at: OperationContext) -> bool:
        return self._probability is None or self.draw.happens(self._probability, at.run, at.place)

    @cached_property
    def _probability(self) -> float | None:
        return self.program.declaration.probability


def declared(number: int, program: Program, owner: Owner, seed: int, *, keep: bool) -> DeclaredLayer:
    """Create the layer of a new declared injection."""
    declaration = program.declaration
    draw = SeededRandom(seed, declaration.name)
    return DeclaredLayer(
        number,
        Direction.IN if program.direction == "in" else Direction.OUT,
        declaration.priority,
        keep,
        declaration.name,
        owner,
        program.cover,
        np.empty(0, np.uint8),
        program=program,
        seed=seed,
        activation=Activation(program.window),
        draw=draw,
        operation=program.operate(draw),
    )
