"""Carries out the commands about injections, in the thread that judges commands; lifts those whose client is gone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Final

import numpy as np

from shmio.connectors.injections import Injection, Injections, Owner, covering, shadow
from shmio.connectors.output import Output
from shmio.layout.write import Write
from shmio.segment import Command, CommandKind, Direction, EventKind, Record
from shmio.segment.events import EVENT_DATA_SIZE
from shmio.segment.standing import Standing, encode, ranges_of

LOOK_NS: Final = 400_000_000
"""How often it is looked whether the clients are still there: a shadow is to go within a second."""

OwnerOf = Callable[[int], Owner | None]
"""The process that has a command queue at present; None: nobody."""


class Injector:
    """Lays, feeds and lifts the injections of one source."""

    def __init__(self, output: Output, writable: bytes, refuse_in: str, owner_of: OwnerOf) -> None:
        """``writable``: the bits that commands may write; ``refuse_in``: why nothing may be laid over ``/in``."""
        self._output = output
        self._writer = output.writer
        self._writable = np.frombuffer(writable, np.uint8)
        self._refuse_in = refuse_in
        self._owner_of = owner_of
        self._look_ns = 0  # of CLOCK_MONOTONIC, whatever clock the source has: clients live by that
        self._resume()

    @property
    def injections(self) -> Injections:
        """All there are."""
        return self._output.injections

    @property
    def patience_ns(self) -> int:
        """How long until :meth:`look` has something to do; negative: there is nothing to look after."""
        if all(layer.keep for layer in self.injections.layers):
            return -1
        return max(0, self._look_ns - time.monotonic_ns())

    def toward_device(self, command: Command) -> Injection | None:
        """The injection over ``/in`` whose values a command carries; None: it carries no such values."""
        layer = self.injections.find(command.injection) if command.kind is CommandKind.SHADOW else None
        return layer if layer is not None and layer.direction is Direction.IN else None

    def take(self, command: Command) -> str:
        """Carry out INJECT, LIFT, or SHADOW for what lies over ``/out``; why not, or empty."""
        if command.kind is CommandKind.INJECT:
            return self._lay(command)
        layer = self.injections.find(command.injection)
        if layer is None:
            return f"there is no injection {command.injection}; it may have been lifted"
        if command.kind is CommandKind.LIFT:
            self._lift(lambda other: other is layer, "lifted", command)
            return ""
        return self._shadow(layer, command)

    def look(self) -> None:
        """Lift what nobody keeps and whose client is gone; however often it is called, at most every ``LOOK_NS``."""
        if self.patience_ns != 0:
            return
        self._look_ns = time.monotonic_ns() + LOOK_NS
        gone = {
            layer.id
            for layer in self.injections.layers
            if not layer.keep and self._owner_of(layer.owner.writer) != layer.owner
        }
        if gone:
            self._lift(lambda layer: layer.id in gone, "its client is gone", None)

    def _lay(self, command: Command) -> str:
        owner = self._owner_of(command.writer)
        if owner is None:
            return "nobody has the command queue that it came by"
        try:
            cover = covering(self._writer.block.layout.size, command.writes)
        except ValueError as error:
            return str(error)
        if command.direction is Direction.IN:
            if self._refuse_in:
                return self._refuse_in
            if (cover & ~self._writable).any():
                return "it covers what is not writable; name that in the source's `writable`"
        with self._output.turn:
            layer = Injection(
                command.id, command.direction, command.priority, command.keep, command.name, owner, cover, cover
            )
            if reason := self.injections.lay(layer):
                return reason
            layer.values = self.injections.seen(self._output.raw, self.injections.inner(layer))
            try:
                self._show()
            except ValueError as error:
                self.injections.lift(lambda other: other is layer)
                return str(error)
            above = [layer, *self.injections.outer(layer)] if layer.direction is Direction.OUT else []
            end = _about(EventKind.INJECTED, layer, command.name)
            self._output.show([*self._beneath(above, end), end])
        return ""

    def _lift(self, which: Callable[[Injection], bool], reason: str, command: Command | None) -> None:
        with self._output.turn:
            gone = [layer for layer in self.injections.layers if which(layer)]
            above = {other.id for layer in gone for other in self.injections.outer(layer)}
            self.injections.lift(which)
            self._show()
            ends = [_about(EventKind.LIFTED, layer, reason, command) for layer in gone]
            left = [layer for layer in self.injections.layers if layer.id in above]
            self._output.show([*self._beneath(left, ends[0]), *ends] if ends else [])

    def _shadow(self, layer: Injection, command: Command) -> str:
        with self._output.turn:
            if reason := shadow(layer, command.writes):
                return reason
            diverted = [
                record
                for place, write in enumerate(command.writes)
                for other, parts in self.injections.onward(layer, write)
                for record in pieces(EventKind.DIVERTED, command, place, parts, other)
            ]
            shadowed = [
                record
                for place, write in enumerate(command.writes)
                for record in pieces(EventKind.SHADOWED, command, place, [write], layer)
            ]
            self._output.show(diverted + shadowed)
        return ""

    def _beneath(self, layers: Iterable[Injection], end: Record) -> Iterator[Record]:
        """What layers over ``/out`` get by now from those further in; told before ``end``, which is why it changed."""
        for layer in layers:
            about = Record(EventKind.DIVERTED, layer.name, end.writer, end.command, injection=layer.id)
            yield from _parts(about, self.injections.beneath(self._output.raw, layer))

    def _show(self) -> None:
        """Tell everybody what stands; ValueError: it is too much."""
        self._writer.block.standing.write(
            encode(
                Standing(
                    layer.id, layer.direction.name.lower(), layer.priority, layer.keep, layer.name,
                    layer.owner.writer, layer.owner.pid, ranges_of(layer.cover.tobytes()),
                )
                for layer in self.injections.layers
            )
        )  # fmt: skip

    def _resume(self) -> None:
        """Go on with what stood when the source's process before this one ended: consumers see the same values on."""
        block = self._writer.block
        last = block.latest()
        seen = np.frombuffer(last.image if last else bytes(block.layout.size), np.uint8)
        for standing in block.standing.read():
            cover = np.zeros(block.layout.size, np.uint8)
            for offset, size, mask in standing.ranges:
                cover[offset : offset + size] = mask
            direction = Direction.IN if standing.direction == "in" else Direction.OUT
            self.injections.lay(
                Injection(
                    standing.id, direction, standing.priority, standing.keep, standing.name,
                    Owner(standing.writer, standing.pid), cover, seen.copy(),
                )
            )  # fmt: skip


def pieces(
    kind: EventKind, command: Command, place: int, writes: Iterable[Write], layer: Injection | None
) -> Iterator[Record]:
    """Events that tell of parts of an item with their data; several if these are long."""
    name, number = (layer.name, layer.id) if layer else ("", 0)
    return _parts(Record(kind, name, command.writer, command.id, place, 1, injection=number), writes)


def _parts(about: Record, writes: Iterable[Write]) -> Iterator[Record]:
    for offset, mask, data in writes:
        for start in range(0, len(data), EVENT_DATA_SIZE):
            part = data[start : start + EVENT_DATA_SIZE]
            yield about._replace(offset=offset + start, mask=mask, size=len(part), data=part)


def _about(kind: EventKind, layer: Injection, text: str, command: Command | None = None) -> Record:
    """An event about an injection; with the command that asked for it, if it was not the injection's own."""
    writer, number = (layer.owner.writer, layer.id) if command is None else (command.writer, command.id)
    return Record(kind, text, writer, number, 0, 1, injection=layer.id)
