"""Carries out commands about injections, and lifts injections whose client is gone."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import numpy as np

from shmio.connectors.injection.declared_injections import Blocks, DeclaredInjections
from shmio.connectors.injection.declared_layer import DeclaredLayer
from shmio.connectors.injection.layers import Bits, Layer, LayerStack, Owner, covering, shadow
from shmio.connectors.injection.output import Output
from shmio.connectors.injection.published import LayerPublisher, layer_event, pieces
from shmio.layout.values.write import Write, apply
from shmio.segment import Command, CommandKind, Direction, EventKind
from shmio.segment.events import EVENT_SLOTS
from shmio.segment.standing_injections import StandingInjection

LOOK_NS: Final = 400_000_000
"""How often the owners are checked; an injection ends within a second of its client."""

OwnerOf = Callable[[int], Owner | None]
"""Returns the process that has a command queue at present, or None."""


class InjectionProcessor:
    """Adds, feeds and lifts the injections of one source."""

    def __init__(self, output: Output, writable: bytes, refuse_in: str, owner_of: OwnerOf, blocks: Blocks) -> None:
        """Create the processor, and resume the injections of the previous process.

        Args:
            output: Publishes the source's images and events.
            writable: The bits that commands may write, as an image of the block.
            refuse_in: Why no injection may cover ``/in``; empty if it may.
            owner_of: Finds the process that has a command queue.
            blocks: Returns the blocks of all sources.

        """
        self._output = output
        self._writer = output.writer
        self._owner_of = owner_of
        self._look_ns = 0  # of CLOCK_MONOTONIC, independent of the source's clock
        self._publisher = LayerPublisher(output, writable, refuse_in)
        self.declared = DeclaredInjections(self._publisher, blocks)
        self._resume()
        self.declared.follow()

    @property
    def injections(self) -> LayerStack:
        """All layers of the source."""
        return self._output.injections

    @property
    def patience_ns(self) -> int:
        """Time until :meth:`look` has work, in ns; negative if it has none."""
        if all(layer.keep for layer in self.injections.layers) and not self.declared.reads_other_sources:
            return -1
        return max(0, self._look_ns - time.monotonic_ns())

    def toward_device(self, command: Command) -> Layer | None:
        """Return the injection over ``/in`` whose values the command carries, if it does."""
        layer = self.injections.find(command.injection) if command.kind is CommandKind.SHADOW else None
        if layer is None or layer.direction is not Direction.IN or isinstance(layer, DeclaredLayer):
            return None
        return layer

    def take(self, command: Command) -> str:
        """Carry out INJECT, DECLARE, LIFT, or SHADOW over ``/out``; return why not, or ""."""
        if command.kind in (CommandKind.INJECT, CommandKind.DECLARE):
            owner = self._owner_of(command.writer)
            if owner is None:
                return "the command queue that it came by has no owner"
            if command.kind is CommandKind.DECLARE:
                return self.declared.declare(command, owner)
            return self._lay(command, owner)
        layer = self.injections.find(command.injection)
        if layer is None:
            return f"there is no injection {command.injection}; it may have been lifted"
        if command.kind is not CommandKind.LIFT:
            return self._shadow(layer, command)
        if isinstance(layer, DeclaredLayer) and layer.configured:
            return self.declared.lift(layer, command)
        self._publisher.lift(lambda other: other is layer, "lifted", command)
        self.declared.settle()
        return ""

    def look(self) -> None:
        """Follow the configuration, and at most every ``LOOK_NS`` check owners and conditions.

        Injections without ``keep`` are lifted once their client is gone. Conditions on changed
        sources are compiled again.
        """
        self.declared.follow()
        if self.patience_ns != 0:
            return
        self._look_ns = time.monotonic_ns() + LOOK_NS
        self.declared.rebind()
        gone = {
            layer.id
            for layer in self.injections.layers
            if not layer.keep and self._owner_of(layer.owner.writer) != layer.owner
        }
        if gone:
            self._publisher.lift(lambda layer: layer.id in gone, "its client is gone")
            self.declared.settle()

    def _lay(self, command: Command, owner: Owner) -> str:
        try:
            cover = covering(self._writer.block.layout.size, command.writes)
        except ValueError as error:
            return str(error)
        with self._output.turn:
            layer = Layer(
                command.id, command.direction, command.priority, command.keep, command.name, owner, cover, cover
            )
            if reason := self._publisher.lay(layer):
                return reason
            layer.values = self.injections.before(self._output.base, layer)
            above = [layer, *self.injections.outer(layer)] if layer.direction is Direction.OUT else []
            end = layer_event(EventKind.INJECTED, layer, command.name)
            self._output.show([*self._publisher.inner_values(above, end), *self._publisher.laid(layer, end)])
        return ""

    def _shadow(self, layer: Layer, command: Command) -> str:
        if isinstance(layer, DeclaredLayer):
            return f"the injection {layer.name} is declared: clients cannot give it values"
        with self._output.turn:
            if reason := shadow(layer, command.writes):
                return reason
            diverted = [
                record
                for place, write in enumerate(command.writes)
                for other, parts in self.injections.onward(self._output.base, layer, write)
                for record in pieces(EventKind.DIVERTED, command, place, parts, other)
            ]
            shadowed = [
                record
                for place, write in enumerate(command.writes)
                for record in pieces(EventKind.SHADOWED, command, place, [write], layer)
            ]
            self._output.show(diverted + shadowed)
        return ""

    def _resume(self) -> None:
        """Resume the injections of the previous process.

        Consumers continue to see the same values.
        """
        block = self._writer.block
        last = block.latest()
        raw, image = (last.raw, last.image) if last else (bytes(block.layout.size),) * 2
        seen = np.frombuffer(image, np.uint8)
        if last is not None:
            self.declared.seen(last)
        standing = block.standing.read()
        covers = [_cover(one, block.layout.size) for one in standing]
        for place, one in enumerate(standing):
            if one.running is not None:
                self.declared.resume(one, one.running, seen)
                continue
            direction = Direction.IN if one.direction == "in" else Direction.OUT
            owner = Owner(one.writer, one.pid)
            layer = Layer(one.number, direction, one.priority, one.keep, one.name, owner, covers[place], seen.copy())
            self._publisher.restore(layer)
            hidden = np.zeros(block.layout.size, np.uint8)
            for outer, cover in zip(standing[place + 1 :], covers[place + 1 :], strict=True):
                if outer.direction == "out" and outer.active:
                    hidden |= cover & layer.cover
            if direction is Direction.OUT and hidden.any():
                layer.values ^= (layer.values ^ self._given(layer, raw)) & hidden

    def _given(self, layer: Layer, raw: bytes) -> Bits:
        """Return the values that a client gave, where layers further out hide them from consumers.

        They are taken from the events, as far as these go back.
        """
        values = self.injections.before(raw, layer)
        events = self._writer.block.events
        for number in range(max(1, events.head() - EVENT_SLOTS + 1), events.head() + 1):
            event = events.read(number)
            if event is not None and event.kind == EventKind.SHADOWED and event.injection == layer.id:
                apply(Write(event.offset, event.mask, event.data), values.data)
        return values


def _cover(standing: StandingInjection, size: int) -> Bits:
    cover = np.zeros(size, np.uint8)
    for offset, count, mask in standing.ranges:
        cover[offset : offset + count] = mask
    return cover
