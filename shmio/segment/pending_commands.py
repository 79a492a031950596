"""What goes to injections, or is accepted: its events put together again, command by command."""

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
    """What one command wrote that went to one injection, or on to the device: in its parts, in the events' order."""

    injection: int
    event: Event
    """The last of its events: its time, whose command it was."""
    writes: tuple[Write, ...]


_Key = tuple[int, int, int]
_NOBODY: Final = (0, 0, 0)


class CommandAssembler:
    """Gathers the events about what was diverted, or of another kind with data; give it all of a block's, in order.

    A command is whole when it says something else, or when another one is diverted. What is diverted says so at once.
    What no command has brought (its number is 0) is whole with its last part.
    """

    def __init__(self, kind: EventKind = EventKind.DIVERTED) -> None:
        self._kind = kind
        self._command: _Key = _NOBODY
        self._parts: dict[int, list[Event]] = {}

    def follow(self, event: Event) -> list[CommandWrites]:
        """What is whole by this event."""
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
    """Bring writes to an image. What lies outside it, as only another process's mistake can, is passed over."""
    for write in writes:
        if write.data and write.offset + len(write.data) <= len(image):
            write_to(write, image)


def values(layout: Layout, image: bytes, writes: Iterable[Write]) -> dict[str, Value]:
    """The values in an image of what was written, by path: registers, or of those written in part elements and bits."""
    named = (part for path in paths_of(layout, writes) for part in find_each(layout, path))
    return {part.path: codec(part, layout.byte_order).decode(image) for part in named}
