"""A writer's side as programs use it: values by path out, what became of them back."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import TYPE_CHECKING, Final, Unpack

import msgspec

from shmio.config import Declaration
from shmio.errors import CommandError, PathError, ValueRangeError
from shmio.layout.model import Register
from shmio.layout.topic import find
from shmio.layout.values.write import Write, apply, bits_of, cover, encode, merge
from shmio.segment.commands import MAX_NAME_BYTES, CommandKind, CommandSender, InjectionOptions
from shmio.segment.events import DONE, ENDS, Event, EventKind

if TYPE_CHECKING:
    from shmio.segment.block import Block
    from shmio.segment.cursor import Cursor

TIMEOUT_S: Final = 2.0
MIN_PERIODS: Final = 3
"""A command may wait for its source so long, or so many cycles if that is longer, unless told otherwise."""
_MODELS: Final = frozenset({"simulation", "remote"})  # connectors whose sources have registers that nobody writes
PATIENCE_S: Final = 1.0
"""What is added for the device's answer to arrive."""
RETIRED: Final = "the source was changed or removed by a reload"
_UNKNOWN: Final = "; it is not known whether the value was written"
RESTARTED: Final = f"the source was restarted meanwhile{_UNKNOWN}"
REPLACED: Final = f"{RETIRED}{_UNKNOWN}"
SILENT: Final = f"the source gave no answer in time{_UNKNOWN}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one value. ``text``: the reason, if there is one to give."""

    path: str
    kind: EventKind
    text: str = ""

    @property
    def done(self) -> bool:
        """Whether the device confirmed it or an injection took it in the device's place; of a shadow's, it is seen."""
        return self.kind in DONE


@dataclass(slots=True)
class PendingCommand:
    """A command under way: its number, and where in the events its outcome will be looked for."""

    number: int
    paths: tuple[str, ...]
    """What each item of the command writes; neighbours with one path are one value's."""
    incarnation: int
    until_ns: int
    events: Cursor[Event]

    @property
    def values(self) -> list[tuple[str, range]]:
        """Of each value its path, and its items."""
        values, first = [], 0
        for path, group in groupby(self.paths):
            stop = first + len(list(group))
            values.append((path, range(first, stop)))
            first = stop
        return values


class SourceWriter:
    """Writes registers of one block in the name of one writer. Several threads may use it."""

    def __init__(self, block: Block, writer: int) -> None:
        self.block = block
        self._sender = CommandSender(block, writer)

    def prepare(self) -> None:
        """Find out what is writable, which takes seconds for a big layout; else the first :meth:`submit` does it."""
        _ = self._writable

    def is_writable(self, register: Register) -> bool:
        """Whether the configuration lets a register, or an array's element, be written as a whole."""
        own = bits_of(register)
        allowed = self._writable[register.offset : register.offset + register.size]
        return not any(bits & ~covered for bits, covered in zip(own, allowed, strict=True))

    @property
    def timeout_s(self) -> float:
        """How long a command may wait, unless told otherwise."""
        return max(TIMEOUT_S, MIN_PERIODS * self.block.period_ns / 1e9)

    @cached_property
    def _writable(self) -> bytes:
        return cover(self.block.layout, self.block.attributes.writable)

    def submit(self, values: Mapping[str, object], timeout_s: float | None = None) -> PendingCommand:
        """Send values of registers, whole arrays or elements by their paths in the block, as one command.

        All or none is accepted by the source. PathError: no such register; CommandError: not writable, or the source
        takes nothing; ValueRangeError: a value does not fit. Nothing has been sent then. Never waits.
        """
        return self._send_values({path: (self._register(path), value) for path, value in values.items()}, timeout_s)

    def shadow(self, injection: int, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Give values as an injection's: to consumers if it lies over ``/out``, toward the device if over ``/in``.

        PathError, ValueRangeError, CommandError: nothing has been sent.
        """
        found = {path: (find(self.block.layout, path), value) for path, value in values.items()}
        return self.outcomes(self._send_values(found, timeout_s, CommandKind.SHADOW, injection))

    def joined(self, values: Mapping[str, object], raw: Iterable[Write] = ()) -> list[Write]:
        """The writes of values and of ``raw`` bytes, neighbours as one. PathError, ValueRangeError."""
        image, bits = bytearray(self.block.layout.size), bytearray(self.block.layout.size)
        ranges = []
        writes = list(raw)
        for path, value in values.items():
            writes += self._encode(find(self.block.layout, path), path, value)
        for write in writes:
            apply(write, image)
            apply(write._replace(data=b"\xff" * len(write.data)), bits)
            ranges.append((write.offset, write.offset + len(write.data)))
        return merge(image, bits, ranges)

    def give(self, injection: int, writes: Sequence[Write], timeout_s: float | None = None) -> PendingCommand:
        """Send what :meth:`joined` gives as an injection's: items are not values. CommandError: not sent."""
        return self._send(("",) * len(writes), writes, timeout_s, CommandKind.SHADOW, injection)

    def inject(self, patterns: Iterable[str], timeout_s: float | None = None, **laid: Unpack[InjectionOptions]) -> int:
        """Lay an injection over all that the patterns name (see :func:`shmio.layout.values.write.cover`); its number.

        Consumers see what they saw, until it gives values. PathError: there is no such register; CommandError: the
        source refuses, or does not answer.
        """
        bits = cover(self.block.layout, patterns)
        if not any(bits):
            raise PathError(f"{self.block.source}: {', '.join(patterns)} names no register")
        ticket = self.lay(merge(bits, bits, [(0, len(bits))]), timeout_s, **laid)
        self._expect(ticket, EventKind.INJECTED)
        return ticket.number

    def lay(
        self, bits: Sequence[Write], timeout_s: float | None = None, **laid: Unpack[InjectionOptions]
    ) -> PendingCommand:
        """Ask for an injection over what these writes would set, whose number is the ticket's. Never waits.

        CommandError: not sent.
        """
        return self._send(("",), bits, timeout_s, CommandKind.INJECT, **laid)

    def declare(self, declaration: Declaration, timeout_s: float | None = None, *, keep: bool = False) -> int:
        """Lay an injection that the source runs by itself; its number. It goes with this process, unless ``keep``.

        The declaration is checked by the source. CommandError: it refuses, and says why, or does not answer.
        """
        ticket = self.ask_to_declare(declaration, timeout_s, keep=keep)
        self._expect(ticket, EventKind.INJECTED)
        return ticket.number

    def ask_to_declare(
        self, declaration: Declaration, timeout_s: float | None = None, *, keep: bool = False
    ) -> PendingCommand:
        """The first half of :meth:`declare`; the number will be the ticket's. CommandError: not sent. Never waits."""
        writes = [Write(0, 0, msgspec.json.encode(declaration))]
        return self._send(("",), writes, timeout_s, CommandKind.DECLARE, keep=keep, name=declaration.name)

    def note(self, text: str, timeout_s: float | None = None) -> None:
        """Put a note into the source's events. ValueRangeError: empty, too long, no text; CommandError: no answer."""
        try:
            size = len(text.encode())
        except UnicodeEncodeError as error:  # a terminal that is not UTF-8
            raise ValueRangeError(f"a note is text in UTF-8, and character {error.start + 1} of this is none") from None
        if not 0 < size <= MAX_NAME_BYTES:
            raise ValueRangeError(f"a note has 1 to {MAX_NAME_BYTES} bytes in UTF-8, this has {size}")
        self._expect(self._send(("",), [], timeout_s, CommandKind.NOTE, name=text), EventKind.NOTED)

    def lift(self, injection: int, timeout_s: float | None = None) -> None:
        """Lift an injection, whoever laid it. CommandError: there is none, or the source does not answer."""
        self.expect_lifted(self.ask_to_lift(injection, timeout_s))

    def ask_to_lift(self, injection: int, timeout_s: float | None = None) -> PendingCommand:
        """The first half of :meth:`lift`. CommandError: not sent. Never waits."""
        return self._send(("",), [], timeout_s, CommandKind.LIFT, injection)

    def expect_lifted(self, ticket: PendingCommand) -> None:
        """The second half of :meth:`lift`."""
        self._expect(ticket, EventKind.LIFTED)

    def _expect(self, ticket: PendingCommand, kind: EventKind) -> None:
        (outcome,) = self.outcomes(ticket)
        if outcome.kind is not kind:
            raise CommandError(f"{self.block.source}: {outcome.text}")

    def _encode(self, register: Register, path: str, value: object) -> list[Write]:
        try:
            return encode(register, value, self.block.layout.byte_order)
        except ValueRangeError as error:
            raise ValueRangeError(f"{self.block.source}/{path}: {error}") from None

    def _send_values(
        self,
        values: Mapping[str, tuple[Register, object]],
        timeout_s: float | None,
        kind: CommandKind = CommandKind.WRITE,
        injection: int = 0,
    ) -> PendingCommand:
        paths, writes = list[str](), list[Write]()
        for path, (register, value) in values.items():
            items = self._encode(register, path, value)
            writes += items
            paths += [path] * len(items)
        return self._send(tuple(paths), writes, timeout_s, kind, injection)

    def _send(
        self,
        paths: tuple[str, ...],
        writes: Sequence[Write],
        timeout_s: float | None,
        kind: CommandKind = CommandKind.WRITE,
        injection: int = 0,
        **laid: Unpack[InjectionOptions],
    ) -> PendingCommand:
        wait_s = self.timeout_s if timeout_s is None else timeout_s
        deadline_ns = time.monotonic_ns() + round(wait_s * 1e9)
        events, incarnation = self.block.events.cursor(), self.block.incarnation
        number = self._sender.submit(writes, deadline_ns, kind, injection, **laid)
        return PendingCommand(number, paths, incarnation, deadline_ns + round(PATIENCE_S * 1e9), events)

    def outcomes(self, ticket: PendingCommand) -> list[Outcome]:
        """Wait until all is over and say what became of each value, in the order they were given."""
        open_items = set(range(len(ticket.paths)))
        ends: dict[int, Event] = {}
        while open_items and (event := self._next(ticket)) is not None:
            if event.kind == EventKind.REJECTED:
                return [Outcome(path, EventKind.REJECTED, event.text) for path in dict.fromkeys(ticket.paths)]
            if event.kind in ENDS:
                ended = open_items.intersection(range(event.item, event.item + event.items))
                open_items -= ended
                ends |= dict.fromkeys(ended, event)
        outcomes = []
        for path, items in ticket.values:
            told = [self._outcome(ticket, place, path, ends) for place in items]
            outcomes.append(next((outcome for outcome in told if not outcome.done), told[0]))
        return outcomes

    def write(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """:meth:`submit` and wait for the :meth:`outcomes`."""
        return self.outcomes(self.submit(values, timeout_s))

    def _register(self, path: str) -> Register:
        register = find(self.block.layout, path)
        self.check(register)
        return register

    def check(self, register: Register) -> None:
        """CommandError: it is not writable."""
        if not self.is_writable(register):
            remedy = "the configuration has to name it in the source's `writable`"
            if self.block.attributes.connector in _MODELS:
                remedy += ", unless its model computes it: nobody writes that, and shmio inject shows another value"
            raise CommandError(f"{self.block.source}/{register.path} is not writable; {remedy}")

    def _next(self, ticket: PendingCommand) -> Event | None:
        """The next event about the command; None when none will come, or not in time."""
        while (rest_ns := ticket.until_ns - time.monotonic_ns()) > 0:
            event = ticket.events.next(rest_ns / 1e9)
            if event is None:
                return None
            if event.command == ticket.number and event.writer == self._sender.writer:
                return event
            if event.kind == EventKind.STARTED and event.incarnation != ticket.incarnation:
                # A successor reports what its predecessor had not taken; of what it had taken nobody knows.
                ticket.until_ns = min(ticket.until_ns, time.monotonic_ns() + round(PATIENCE_S * 1e9))
        return None

    def _outcome(self, ticket: PendingCommand, place: int, path: str, ends: Mapping[int, Event]) -> Outcome:
        end = ends.get(place)
        if end is None:
            return Outcome(path, EventKind.UNKNOWN, self._silence(ticket))
        return Outcome(path, EventKind(end.kind), end.text)

    def _silence(self, ticket: PendingCommand) -> str:
        if self.block.retired:
            return REPLACED
        if self.block.incarnation != ticket.incarnation:
            return RESTARTED
        if ticket.events.missed:
            return f"{ticket.events.missed} events were missed, the answer may be among them"
        return SILENT
