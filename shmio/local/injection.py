"""An injection as the program that laid it holds it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from shmio.errors import CommandError, PathError
from shmio.layout.topic import parse_topic
from shmio.layout.values.codec import Value
from shmio.layout.values.write import cover, merge
from shmio.local.writer import Outcome, PendingCommand, SourceWriter
from shmio.segment.block import Block
from shmio.segment.commands import Direction
from shmio.segment.cursor import Cursor
from shmio.segment.events import Event, EventKind
from shmio.segment.pending_commands import CommandAssembler, CommandWrites, apply, values

Next = Callable[[Cursor[Event], float | None], Event | None]
"""The next event of a cursor, waited for so many s; None: there is none, or will be none. NotRunningError."""


@dataclass(frozen=True, slots=True)
class Diversion:
    """What one command wrote toward a source, or of it what went to an injection.

    ``values``: by path in the block; of what was written in part, its elements or bits. ``writer``, ``command``: whose
    it was, as in events. ``clock_ns``: when, on the instance's clock; ``utc_ns``: in UTC. ``missed``: events lost
    between the one before and this one, which may have been about more of the same.
    """

    values: Mapping[str, Value]
    writer: int
    command: int
    clock_ns: int
    utc_ns: int
    missed: int


class Shadow:
    """A shadow over registers of one source. Leaving its ``with`` block lifts it, unless it is to be kept.

    Until it is given values, consumers go on seeing what they saw; over ``/in``, nothing reaches the device.
    """

    def __init__(
        self,
        source_writer: SourceWriter,
        number: int,
        direction: Direction,
        events: Cursor[Event],
        next_event: Next,
        *,
        keep: bool,
    ) -> None:
        """``events``: from before it was laid."""
        self.source = source_writer.block.source
        self.number = number
        """By which anybody may lift it, or give values to it."""
        self.direction = direction
        self._source_writer = source_writer
        self._events = events
        self._gathered = CommandAssembler()
        self._missed = 0
        self._image = bytearray(source_writer.block.layout.size)  # what was diverted so far
        self._next_event = next_event
        self._keep = keep

    def set(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Give values by path, with or without the source: to consumers, or over ``/in`` toward the device.

        What became of each: SHADOWED, consumers see it; over ``/in`` as with a write. REJECTED: not covered, or the
        shadow was lifted. PathError, ValueRangeError, CommandError: nothing has been sent.
        """
        paths = {parse_topic(path, (self.source,), self.source).path: value for path, value in values.items()}
        return self._source_writer.shadow(self.number, paths, timeout_s)

    def diverted(self, timeout_s: float | None = None) -> Iterator[Diversion]:
        """What went to this shadow since it was laid: over ``/in`` what others wrote, command by command, in order.

        Over ``/out``: what shadows further from consumers gave; what the source delivers is in the frames. Each is told
        once, also to a second iterator. It ends when the shadow is lifted, and after ``timeout_s`` without any; None
        waits for ever. NotRunningError when the instance has stopped.
        """
        until_s = _deadline(timeout_s)
        while (event := self._next_event(self._events, _rest(until_s))) is not None:
            for diverted in self._gathered.follow(event):
                if diverted.injection == self.number:
                    yield self._diversion(diverted)
                    until_s = _deadline(timeout_s)
            if event.kind == EventKind.LIFTED and event.injection == self.number:
                return

    def _diversion(self, diverted: CommandWrites) -> Diversion:
        apply(self._image, diverted.writes)
        missed, self._missed = self._events.missed - self._missed, self._events.missed
        event = diverted.event
        written = values(self._source_writer.block.layout, bytes(self._image), diverted.writes)
        return Diversion(written, event.writer, event.command, event.clock_ns, event.utc_ns, missed)

    def lift(self) -> None:
        """Lift it; consumers see what the source delivers. CommandError: it was lifted already, or no answer came."""
        self._source_writer.lift(self.number)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._keep:
            self.lift()


def written(
    block: Block, patterns: Iterable[str], events: Cursor[Event], next_event: Next, timeout_s: float | None
) -> Iterator[Diversion]:
    """What a source accepts for what the patterns name, command by command, in order; each when it has its end.

    It ends after ``timeout_s`` without any. PathError: they name nothing; NotRunningError.
    """
    chosen = list(patterns)
    bits = cover(block.layout, chosen)
    if not any(bits):
        raise PathError(f"{block.source}: {', '.join(chosen)} names no register")
    return _written(block, bits, events, next_event, timeout_s)


def _written(
    block: Block, bits: bytes, events: Cursor[Event], next_event: Next, timeout_s: float | None
) -> Iterator[Diversion]:
    layout, gatherer = block.layout, CommandAssembler(EventKind.ACCEPTED)
    last, missed = block.latest(), 0
    image = bytearray(layout.size if last is None else last.image)
    until_s = _deadline(timeout_s)
    while (event := next_event(events, _rest(until_s))) is not None:
        for accepted in gatherer.follow(event):
            mask = bytearray(layout.size)
            apply(mask, (write._replace(data=b"\xff" * len(write.data)) for write in accepted.writes))
            apply(image, accepted.writes)
            mask = bytearray(a & b for a, b in zip(mask, bits, strict=True))
            if any(mask):
                found = values(layout, bytes(image), merge(image, mask, [(0, layout.size)]))
                told = accepted.event
                yield Diversion(found, told.writer, told.command, told.clock_ns, told.utc_ns, events.missed - missed)
                missed = events.missed
                until_s = _deadline(timeout_s)


def lift_all(injections: Iterable[tuple[SourceWriter, int]]) -> None:
    """Lift all of these; those that are gone by then count as lifted. CommandError: some still stand, and why."""
    asked: list[tuple[SourceWriter, PendingCommand]] = []
    chosen, reasons = list(injections), dict[str, None]()
    for source_writer, number in chosen:
        try:
            asked.append((source_writer, source_writer.ask_to_lift(number)))
        except CommandError as error:
            reasons[str(error)] = None
    for source_writer, ticket in asked:
        try:
            source_writer.expect_lifted(ticket)
        except CommandError as error:
            reasons[str(error)] = None
    left = [
        number
        for source_writer, number in chosen
        if any(one.id == number and not one.lifted for one in source_writer.block.standing.read())
    ]
    if left:
        raise CommandError(f"{len(left)} of {len(chosen)} injections still stand: {'; '.join(reasons)}")


def _deadline(timeout_s: float | None) -> float | None:
    return None if timeout_s is None else time.monotonic() + timeout_s


def _rest(until_s: float | None) -> float | None:
    return None if until_s is None else until_s - time.monotonic()
