"""Reassemble commands from their events: what a command wrote, or what went to an injection."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple

from shmio.layout.model import Layout
from shmio.layout.naming import paths_of
from shmio.layout.topic import find_each
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import Write
from shmio.layout.values.write import apply as write_to
from shmio.segment.events import Event, EventKind


class CommandWrites(NamedTuple):
    """The writes of one command that went to one injection, or to the device, in the events' order."""

    injection: int
    event: Event
    """The last of the events, which has the time and the writer."""
    writes: tuple[Write, ...]


_Key = tuple[int, int, int]
_NOBODY: Final = (0, 0, 0)


class CommandAssembler:
    """Assembles commands from DIVERTED events, or from events of another kind with data.

    Pass it all events of a block, in order. A command is complete when an event of another kind about it
    follows, or when events of another command begin. Writes without a command (number 0) are complete
    with their last part.
    """

    def __init__(self, kind: EventKind = EventKind.DIVERTED) -> None:
        self._kind = kind
        self._command: _Key = _NOBODY
        self._parts: dict[int, list[Event]] = {}

    def follow(self, event: Event) -> list[CommandWrites]:
        """Process the next event; returns the commands that it completes."""
        command = event.incarnation, event.writer, event.command
        if event.kind != self._kind:
            return self._whole() if command == self._command or event.kind == EventKind.STARTED else []
        whole = [] if command == self._command else self._whole()
        self._command = command
        self._parts.setdefault(event.injection, []).append(event)
        if not event.command and event.item + 1 >= event.items:
            whole += self._whole()
        return whole

    def _whole(self) -> list[CommandWrites]:
        whole = [
            CommandWrites(injection, parts[-1], tuple(Write(part.offset, part.mask, part.data) for part in parts))
            for injection, parts in self._parts.items()
        ]
        self._command, self._parts = _NOBODY, {}
        return whole


def apply(image: bytearray, writes: Iterable[Write]) -> None:
    """Apply writes to an image. A write outside it is ignored; only a faulty process makes one."""
    for write in writes:
        if write.data and write.offset + len(write.data) <= len(image):
            write_to(write, image)


def values(layout: Layout, image: bytes, writes: Iterable[Write]) -> dict[str, Value]:
    """Decode the written values from an image, by path.

    Registers that were written in part yield elements or bits.
    """
    named = (part for path in paths_of(layout, writes) for part in find_each(layout, path))
    return {part.path: codec(part, layout.byte_order).decode(image) for part in named}
