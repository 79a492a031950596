"""Reassemble commands from their events: what a command wrote, what went to an injection, and how it ended."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from shmio.layout.model import Layout
from shmio.layout.topic import find_each
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import Write, paths_of
from shmio.layout.values.write import apply as write_to
from shmio.segment.events import DONE, ENDS, Event, EventKind


class CommandWrites(NamedTuple):
    """The writes of one command that went to one injection, or to the device, in the events' order."""

    injection: int
    event: Event
    """The last of the events, which has the time and the writer."""
    writes: tuple[Write, ...]


NO_COMMAND: Final = (0, 0, 0)
"""The key of no command; see ``Event.command_key``."""


class CommandAssembler:
    """Assembles commands from DIVERTED events, or from events of another kind with data.

    Pass it all events of a block, in order. A command is complete when an event of another kind about it
    follows, or when events of another command begin. Writes without a command (number 0) are complete
    with their last part.
    """

    def __init__(self, kind: EventKind = EventKind.DIVERTED) -> None:
        self._kind = kind
        self._command = NO_COMMAND
        self._parts: dict[int, list[Event]] = {}

    def follow(self, event: Event) -> list[CommandWrites]:
        """Process the next event; returns the commands that it completes."""
        command = event.command_key
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
        self._command, self._parts = NO_COMMAND, {}
        return whole


End = tuple[EventKind, str]
"""An item's outcome and its reason: one of ``ENDS``, or ACCEPTED if the command ends with that."""


def worst(ends: Sequence[End]) -> End:
    """Return the first outcome that is not a success, or the first of all if there is none."""
    return next((end for end in ends if end[0] not in DONE), ends[0])


class CommandOutcomes:
    """Collects the outcomes of one command's items."""

    def __init__(self, items: int, *, until_accepted: bool = False) -> None:
        """``until_accepted``: whether acceptance already ends an item."""
        self._items = items
        self._until_accepted = until_accepted
        self._ends: dict[int, End] = {}

    def follow(self, event: Event) -> bool:
        """Process the command's next event; return whether all outcomes are known."""
        if event.kind == EventKind.REJECTED:
            self._ends = dict.fromkeys(range(self._items), (EventKind.REJECTED, event.text))
        elif event.kind in ENDS or (self._until_accepted and event.kind == EventKind.ACCEPTED):
            kind = EventKind(event.kind)
            end = kind, event.text if kind is not EventKind.ACCEPTED else ""
            for item in range(event.item, min(event.item + max(1, event.items), self._items)):
                self._ends[item] = end
        return len(self._ends) == self._items

    def of(self, items: Iterable[int], missing: str) -> End:
        """Return the outcome of a value, which has these items. ``missing``: why one may be unknown."""
        return worst([self._ends.get(item, (EventKind.UNKNOWN, missing)) for item in items])


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
