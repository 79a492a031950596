"""Injections that this program has laid, and the writes that they divert."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from shmio.errors import CommandError, PathError, ValueRangeError
from shmio.layout.topic import Topic, parse_topic
from shmio.layout.values.codec import Value
from shmio.layout.values.write import cover, merge
from shmio.local.writer import PendingCommand, SourceWriter
from shmio.model.values import Outcome
from shmio.segment.block import Block, Cursor
from shmio.segment.commands import CommandAssembler, CommandWrites, Direction, apply, decode_writes
from shmio.segment.events import Event, EventKind

Next = Callable[[Cursor[Event], float | None], Event | None]
"""Waits at most so many seconds for a cursor's next event. None: no event came, or none will come.

Raises NotRunningError when the instance has stopped."""


@dataclass(frozen=True, slots=True)
class Diversion:
    """The values that one command wrote to a source, or the part of them that an injection took.

    Attributes:
        values: Values by path within the block. For an array or integer that was written in part,
            its elements or bits.
        writer: Number of the command queue, as in events.
        command: The writer's number of the command, as in events.
        clock_ns: Time of the instance's clock.
        utc_ns: UTC time.
        missed: Events lost since the previous diversion, which may have been about further writes.
    """

    values: Mapping[str, Value]
    writer: int
    command: int
    clock_ns: int
    utc_ns: int
    missed: int


class Shadow:
    """An injection over registers of one source, whose values this program gives.

    Until values are given, consumers of ``/out`` see what they saw before; over ``/in``, nothing
    reaches the device. Leaving the ``with`` block lifts the shadow, unless it was laid with ``keep``.
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
        """``events``: a cursor from before the shadow was laid."""
        self.source = source_writer.block.source
        self.number = number
        """Number of the injection; by it anybody may lift the shadow or give values to it."""
        self.direction = direction
        self._source_writer = source_writer
        self._events = events
        self._gathered = CommandAssembler()
        self._image = bytearray(source_writer.block.layout.size)  # all writes diverted so far
        self._next_event = next_event
        self._keep = keep

    def set(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Give values: to consumers, or, for a shadow over ``/in``, to the device.

        Args:
            values: Values by path, with or without the source.
            timeout_s: How long the values may wait for a cycle of the source.

        Returns:
            The outcome of each value, with its path as it was given: SHADOWED when consumers see it, or
            an outcome as of a write for ``/in``; REJECTED when the shadow does not cover it or was lifted.

        Raises:
            PathError: A path names nothing.
            ValueRangeError: A value does not fit its register, or a register is given twice.
            CommandError: The source's queue has no room.
                After any of these errors nothing has been sent.
        """
        paths = by_path([parse_topic(path, (self.source,), self.source) for path in values], values)
        return as_given(values, self._source_writer.shadow(self.number, paths, timeout_s))

    def diverted(self, timeout_s: float | None = None) -> Iterator[Diversion]:
        """Iterate over what this shadow has taken since it was laid, command by command, in order.

        Over ``/in`` these are the writes of others; over ``/out`` the values of shadows further in.
        What the source itself delivers is in the frames. Each diversion is yielded once, even if
        there are two iterators. The iterator ends when the shadow is lifted.

        Args:
            timeout_s: The iterator also ends after this time without a diversion; None waits forever.

        Raises:
            NotRunningError: The instance has stopped.
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
        event = diverted.event
        written = decode_writes(self._source_writer.block.layout, bytes(self._image), diverted.writes)
        return Diversion(written, event.writer, event.command, event.clock_ns, event.utc_ns, self._events.take_missed())

    def lift(self) -> None:
        """Lift the shadow: consumers see what the source delivers.

        Raises:
            CommandError: It was lifted already, or the source does not answer.
        """
        self._source_writer.lift(self.number)

    def close(self) -> None:
        """Lift the shadow, unless it was laid with ``keep`` or somebody has lifted it.

        Raises:
            CommandError: The source does not answer.
        """
        if not self._keep:
            lift_all([(self._source_writer, self.number)])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def written(
    block: Block, patterns: Iterable[str], events: Cursor[Event], next_event: Next, timeout_s: float | None
) -> Iterator[Diversion]:
    """Iterate over the commands that a source accepts for registers, each once its outcome is known.

    Args:
        block: The source's block.
        patterns: Patterns of registers.
        events: A cursor of the block's events.
        next_event: Waits for the cursor's next event.
        timeout_s: The iterator ends after this time without a command; None waits forever.

    Raises:
        PathError: The patterns name no register.
        NotRunningError: The instance has stopped.
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
    last = block.latest()
    image = bytearray(layout.size if last is None else last.image)
    until_s = _deadline(timeout_s)
    while (event := next_event(events, _rest(until_s))) is not None:
        for accepted in gatherer.follow(event):
            mask = bytearray(layout.size)
            apply(mask, (write._replace(data=b"\xff" * len(write.data)) for write in accepted.writes))
            apply(image, accepted.writes)
            mask = bytearray(a & b for a, b in zip(mask, bits, strict=True))
            if any(mask):
                found = decode_writes(layout, bytes(image), merge(image, mask, [(0, layout.size)]))
                told = accepted.event
                yield Diversion(found, told.writer, told.command, told.clock_ns, told.utc_ns, events.take_missed())
                until_s = _deadline(timeout_s)


def lift_all(injections: Iterable[tuple[SourceWriter, int]]) -> None:
    """Lift injections, given by writer and number. One that is already gone counts as lifted.

    Raises:
        CommandError: Some could not be lifted; the message gives the reasons.
    """
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
        if any(one.number == number and not one.lifted for one in source_writer.block.standing.read())
    ]
    if left:
        raise CommandError(f"{len(left)} of {len(chosen)} injections were not lifted: {'; '.join(reasons)}")


def by_path(topics: Iterable[Topic], values: Mapping[str, object]) -> dict[str, object]:
    """Return values by the paths of their topics. ValueRangeError: two topics have the same path."""
    found: dict[str, object] = {}
    for topic, (path, value) in zip(topics, values.items(), strict=True):
        if topic.path in found:
            raise ValueRangeError(f"{path}: given twice")
        found[topic.path] = value
    return found


def as_given(paths: Iterable[str], outcomes: Iterable[Outcome]) -> list[Outcome]:
    """Return outcomes with the paths as their caller gave them."""
    return [dataclasses.replace(outcome, path=path) for path, outcome in zip(paths, outcomes, strict=True)]


def _deadline(timeout_s: float | None) -> float | None:
    return None if timeout_s is None else time.monotonic() + timeout_s


def _rest(until_s: float | None) -> float | None:
    return None if until_s is None else until_s - time.monotonic()
