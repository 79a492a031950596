"""The layer of a declared injection: its values come from an operation instead of a client."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from shmio.config import Declaration
from shmio.connectors.injection.layers import Bits, CycleImage, Layer, Owner, parts_of
from shmio.injection import Program
from shmio.injection.activation import Activation, State
from shmio.injection.draw import SeededRandom
from shmio.injection.expression import Memory, Number
from shmio.injection.operations import Delay, Drop, Operation, OperationContext
from shmio.layout.values.write import Write
from shmio.model.injection import Running
from shmio.segment import NO_WRITER, Direction

MAX_HELD: Final = 256
"""Writes that one delay over ``/in`` holds before further writes are rejected."""


class DelayedWrite(NamedTuple):
    """A write that a delay holds, with the cycle and the instance time at which it came."""

    write: Write
    cycle: int
    time_ns: int


@dataclass(kw_only=True)
class DeclaredLayer(Layer):
    """The layer of one declared injection.

    ``writes`` counts writes over ``/in`` in this activation.
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
        """False: no client gives it values."""
        return False

    @property
    def active(self) -> bool:
        """Whether it changes the covered bits at present."""
        return self.activation.state is State.ACTIVE

    @property
    def configured(self) -> bool:
        """Whether the configuration declares it."""
        return self.owner.writer == NO_WRITER

    @property
    def full(self) -> bool:
        """Whether its delay holds as many writes as it may."""
        return len(self.held) >= MAX_HELD

    @property
    def running(self) -> Running[Declaration]:
        """Its present state, as published in the segment."""
        now = self.activation
        declaration = self.program.declaration
        return Running(declaration, now.state.value, self.seed, now.runs, now.cycle, now.time_ns)

    def advance(self, now: CycleImage, values: Sequence[Number | None]) -> bool:
        """Advance to the next image, given the values of its condition.

        Return whether its state changed.
        """
        condition = self.program.condition
        holds = condition is None or condition.expression.holds(values, self.memory)
        runs = self.activation.runs
        changed = self.activation.advance(now.time_ns, now.cycle, holds=holds)
        if self.activation.runs != runs:
            self.operation.begin()
            self.writes = 0
        return changed

    def show(self, image: Bits, now: CycleImage) -> None:
        """Apply the operation to the covered bits of an image, in place."""
        at = self._moment(now.cycle - self.activation.cycle, now)
        if not self._happens(at):
            self.operation.passed(image, at)
            return
        changed = image.copy()
        self.operation.apply(changed, at)
        image ^= (image ^ changed) & self.cover

    def transform_write(self, write: Write, bits: Bits, now: CycleImage) -> bytes | None:
        """Apply the operation to bits of a write toward the device.

        Returns:
            The new data; None if the write is dropped, or delayed and sent later.

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
        """Remove and return the writes whose delay is over.

        ``now`` is the cycle that is about to write.
        """
        due: list[Write] = []
        if not isinstance(self.operation, Delay):
            return due
        at = self._moment(0, now)
        while self.held:
            write, cycle, time_ns = self.held[0]
            # Without the delay, the cycle after the one that it came in would have written it.
            if at.cycle <= cycle or not self.operation.due(cycle + 1, time_ns, at):
                break
            due.append(write)
            self.held.popleft()
        return due

    def _moment(self, place: int, now: CycleImage) -> OperationContext:
        return OperationContext(self.activation.runs, place, now.cycle, now.time_ns)

    def _happens(self, at: OperationContext) -> bool:
        probability = self.program.declaration.probability
        return probability is None or self.draw.happens(probability, at.run, at.place)


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


def resumed(layer: DeclaredLayer, running: Running[Declaration], seen: Bits) -> DeclaredLayer:
    """Restore a layer to the state of the previous process.

    ``seen`` is the image that consumers saw last.
    """
    state = State(running.state)
    layer.activation = Activation(layer.program.window, state, running.runs, running.cycle, running.time_ns)
    if layer.active and layer.direction is Direction.OUT:
        layer.operation.resume(seen)
    return layer
