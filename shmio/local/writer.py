"""Send commands to a source by path, and wait for their outcomes."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import groupby
from typing import TYPE_CHECKING, Final, Unpack

import msgspec

from shmio.audit import trail
from shmio.config import Declaration
from shmio.errors import CommandError, PathError, ValueRangeError
from shmio.layout.model import Register
from shmio.layout.topic import find
from shmio.layout.values.write import Write, apply, bits_of, cover, encode, merge, path_at, paths_outside
from shmio.model.values import ROLES, WRITE_MIN_PERIODS, WRITE_TIMEOUT_S, Outcome, OutcomeKind
from shmio.segment.commands import (
    EMPTY,
    MAX_NAME_BYTES,
    MAX_WRITES,
    Command,
    CommandKind,
    CommandOutcomes,
    End,
    InjectionOptions,
    first_number,
)
from shmio.segment.events import Event, EventKind
from shmio.segment.processes import program_name
from shmio.wording import MAX_PATHS, not_writable

if TYPE_CHECKING:
    from shmio.segment.block import Block, Cursor

_MODELS: Final = frozenset({"simulation", "remote"})  # connectors with registers that only a model writes
PATIENCE_S: Final = 1.0
"""Time in s for which to wait for the device's answer after the deadline of a command."""
RETIRED: Final = "the source was changed or removed by a reload"
_UNKNOWN: Final = "; it is not known whether the value was written"
RESTARTED: Final = f"the source was restarted meanwhile{_UNKNOWN}"
REPLACED: Final = f"{RETIRED}{_UNKNOWN}"
SILENT: Final = f"the source gave no answer in time{_UNKNOWN}"


class CommandSender:
    """Puts commands into the queue of one writer, in one block.

    This process must have locked the process slot to which the queue belongs.
    """

    def __init__(self, block: Block, writer: int) -> None:
        self.block = block
        self.writer = writer
        self._lock = threading.Lock()
        self._pid = os.getpid()  # two processes on one queue would overwrite each other's commands
        self._next = first_number(self._pid)

    def submit(
        self,
        writes: Sequence[Write],
        deadline_ns: int,
        kind: CommandKind = CommandKind.WRITE,
        injection: int = 0,
        number: int = 0,
        **options: Unpack[InjectionOptions],
    ) -> int:
        """Send a command to the source's present process, without waiting.

        Args:
            writes: The items.
            deadline_ns: Time after which the source must not start the command, CLOCK_MONOTONIC.
            kind: Kind of command.
            injection: Number of the injection to lift, or to give values to; 0: none.
            number: Number of the command, if another process has chosen it; 0: the next number.
            options: Options of the injection to create, if the command creates one.

        Returns:
            The command's number.

        Raises:
            CommandError: The queue is full or too small for the command, or the command has too many
                items.
        """
        source = self.block.source
        if (len(writes) > 0) == (kind in EMPTY) or len(writes) > MAX_WRITES:
            raise CommandError(f"{source}: a command must have 1 to {MAX_WRITES} items, but this one has {len(writes)}")
        with self._lock:
            if not number:
                number, self._next = self._next, self._next + 1
            incarnation = self.block.incarnation
            command = Command(
                self.writer, number, incarnation, deadline_ns, tuple(writes), kind, injection, **options, by=self._by()
            )
            record = command.pack()
            queues = self.block.commands
            if len(record) + 8 > queues.capacity:
                most = queues.capacity - 8
                raise CommandError(
                    f"{source}: the command has {len(record)} bytes, but at most {most} are allowed; write fewer values"
                )
            if self._pid != os.getpid():
                raise CommandError("this process was forked after it had attached; attach again in this process")
            if not queues.push(self.writer, record):
                raise CommandError(
                    f"{source}: its command queue is full: the source is not reading commands, or too many are queued"
                )
            return number

    def _by(self) -> str:
        """Return who sends a command: the client of this task or thread, or else this program."""
        acting = trail.present()
        if acting is not None:
            return acting.text
        return "" if self.writer in ROLES else self._program  # readers name the endpoint by its queue

    @cached_property
    def _program(self) -> str:
        actor = trail.uid_actor(os.getuid(), f"pid {self._pid} {program_name()}".rstrip())
        return trail.Acting(actor, "local").text


class PendingCommand(msgspec.Struct):
    """A command whose outcome is not known yet.

    ``events`` is the cursor that will read the outcome.
    """

    number: int
    paths: tuple[str, ...]
    """Path that each item writes. Adjacent items with the same path belong to one value."""
    incarnation: int
    until_ns: int
    events: Cursor[Event]

    @property
    def values(self) -> list[tuple[str, range]]:
        """For each value of the command, its path and the range of its items."""
        values, first = [], 0
        for path, group in groupby(self.paths):
            stop = first + len(list(group))
            values.append((path, range(first, stop)))
            first = stop
        return values


class SourceWriter:
    """Sends one writer's commands to a source, and waits for their outcomes.

    Several threads may use an object. In all methods, ``timeout_s`` is the time in s that the command
    may wait for the source; None: :attr:`timeout_s`.
    """

    def __init__(self, block: Block, writer: int) -> None:
        self.block = block
        self._sender = CommandSender(block, writer)

    def prepare(self) -> None:
        """Determine which bits are writable, so that the first :meth:`submit` is fast.

        This takes seconds for a large layout.
        """
        _ = self._writable

    def is_writable(self, register: Register) -> bool:
        """Return whether the configuration allows writing all of a register or array element."""
        own = bits_of(register)
        allowed = self._writable[register.offset : register.offset + register.size]
        return not any(bits & ~covered for bits, covered in zip(own, allowed, strict=True))

    @property
    def timeout_s(self) -> float:
        """Time in s that a command may wait for the source, if no other time is given."""
        return max(WRITE_TIMEOUT_S, WRITE_MIN_PERIODS * self.block.period_ns / 1e9)

    @cached_property
    def _writable(self) -> bytes:
        return cover(self.block.layout, self.block.attributes.writable)

    def submit(self, values: Mapping[str, object], timeout_s: float | None = None) -> PendingCommand:
        """Send values as one command, without waiting. The source accepts all values or none.

        Args:
            values: Values of registers, whole arrays or elements, by path within the block.
            timeout_s: Time in s that the command may wait for the source; None: :attr:`timeout_s`.

        Raises:
            PathError: There is no such register.
            ValueRangeError: A value does not fit its register.
            CommandError: A register is not writable, or the queue has no room.
                After any of these errors, nothing has been sent.
        """
        return self._send_values({path: (self._register(path), value) for path, value in values.items()}, timeout_s)

    def submit_writes(self, writes: Sequence[Write], timeout_s: float | None = None) -> PendingCommand:
        """Send writes as one command, without waiting. The source checks them, and accepts all or none.

        Raises:
            CommandError: The queue has no room. Nothing has been sent.
        """
        return self._send(self._paths(writes), writes, timeout_s)

    def shadow(self, injection: int, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Give values to an injection, and wait for the outcome of each value.

        An injection over ``/out`` gives the values to consumers; one over ``/in``, to the device.

        Raises:
            PathError: There is no such register.
            ValueRangeError: A value does not fit its register.
            CommandError: The queue has no room.
                After any of these errors, nothing has been sent.
        """
        found = {path: (find(self.block.layout, path), value) for path, value in values.items()}
        return self.outcomes(self._send_values(found, timeout_s, CommandKind.SHADOW, injection))

    def joined(self, values: Mapping[str, object], raw: Iterable[Write] = ()) -> list[Write]:
        """Return values by path, encoded, and the writes ``raw``; adjacent writes are joined to one.

        Raises:
            PathError: There is no such register.
            ValueRangeError: A value does not fit its register.
        """
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
        """Send writes made by :meth:`joined` as values of an injection, without waiting.

        Raises:
            CommandError: The command could not be sent.
        """
        return self._send(("",) * len(writes), writes, timeout_s, CommandKind.SHADOW, injection)

    def forward(
        self,
        number: int,
        kind: CommandKind,
        writes: Sequence[Write],
        timeout_s: float,
        injection: int = 0,
        **options: Unpack[InjectionOptions],
    ) -> PendingCommand:
        """Send a command about an injection for another program, without waiting.

        Args:
            number: Number that the program has given the command.
            kind: INJECT, SHADOW, LIFT or DECLARE.
            writes: The items.
            timeout_s: Time in s that the command may wait for the source.
            injection: Number of the injection to lift, or to give values to; 0: none.
            options: Options of the injection to create.

        Raises:
            CommandError: The command could not be sent.
        """
        paths = self._paths(writes) if kind is CommandKind.SHADOW else ("",)
        return self._send(paths, writes, timeout_s, kind, injection, number, **options)

    def inject(
        self, patterns: Iterable[str], timeout_s: float | None = None, **options: Unpack[InjectionOptions]
    ) -> int:
        """Create an injection over all registers that match the patterns, and return its number.

        Consumers see no change until the injection gets values. See
        :func:`shmio.layout.values.write.cover` for the patterns.

        Raises:
            PathError: There is no such register.
            CommandError: The source refuses, or does not answer.
        """
        bits = cover(self.block.layout, patterns)
        if not any(bits):
            raise PathError(f"{self.block.source}: no register matches {', '.join(patterns)}")
        ticket = self.ask_to_inject(merge(bits, bits, [(0, len(bits))]), timeout_s, **options)
        self._expect(ticket, EventKind.INJECTED)
        return ticket.number

    def ask_to_inject(
        self, bits: Sequence[Write], timeout_s: float | None = None, **options: Unpack[InjectionOptions]
    ) -> PendingCommand:
        """Request an injection over the bits that are set in ``bits``, without waiting.

        The injection has the number of the returned command.

        Raises:
            CommandError: The command could not be sent.
        """
        return self._send(("",), bits, timeout_s, CommandKind.INJECT, **options)

    def declare(self, declaration: Declaration, timeout_s: float | None = None, *, keep: bool = False) -> int:
        """Create a declared injection, which the source runs by itself, and return its number.

        The injection ends when this process ends, unless ``keep`` is set. The source checks the
        declaration.

        Raises:
            CommandError: The source refuses the declaration, or does not answer. The message gives
                the reason.
        """
        ticket = self.ask_to_declare(declaration, timeout_s, keep=keep)
        self._expect(ticket, EventKind.INJECTED)
        return ticket.number

    def ask_to_declare(
        self, declaration: Declaration, timeout_s: float | None = None, *, keep: bool = False
    ) -> PendingCommand:
        """Request a declared injection, without waiting.

        The injection has the number of the returned command.

        Raises:
            CommandError: The command could not be sent.
        """
        writes = [Write(0, 0, msgspec.json.encode(declaration))]
        return self._send(("",), writes, timeout_s, CommandKind.DECLARE, keep=keep, name=declaration.name)

    def note(self, text: str, timeout_s: float | None = None) -> None:
        """Add a note to the source's events.

        Raises:
            ValueRangeError: The note is empty, too long, or not UTF-8 text.
            CommandError: The source does not answer.
        """
        try:
            size = len(text.encode())
        except UnicodeEncodeError as error:  # from a terminal that is not UTF-8
            raise ValueRangeError(f"a note must be UTF-8 text, but character {error.start + 1} is not") from None
        if not 0 < size <= MAX_NAME_BYTES:
            raise ValueRangeError(f"a note must have 1 to {MAX_NAME_BYTES} bytes in UTF-8, but this one has {size}")
        self._expect(self._send(("",), [], timeout_s, CommandKind.NOTE, name=text), EventKind.NOTED)

    def lift(self, injection: int, timeout_s: float | None = None) -> None:
        """Lift an injection, whichever program created it.

        Raises:
            CommandError: There is no such injection, or the source does not answer.
        """
        self.expect_lifted(self.ask_to_lift(injection, timeout_s))

    def ask_to_lift(self, injection: int, timeout_s: float | None = None) -> PendingCommand:
        """Request that the source lift an injection, without waiting.

        Raises:
            CommandError: The command could not be sent.
        """
        return self._send(("",), [], timeout_s, CommandKind.LIFT, injection)

    def expect_lifted(self, ticket: PendingCommand) -> None:
        """Wait until the source has lifted an injection as requested by :meth:`ask_to_lift`.

        Raises:
            CommandError: The source refuses or does not answer.
        """
        self._expect(ticket, EventKind.LIFTED)

    def _expect(self, ticket: PendingCommand, kind: EventKind) -> None:
        ((_, (end, reason)),) = self._ends(ticket)
        if end is not kind:
            raise CommandError(f"{self.block.source}: {reason}")

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
        number: int = 0,
        **options: Unpack[InjectionOptions],
    ) -> PendingCommand:
        wait_s = self.timeout_s if timeout_s is None else timeout_s
        deadline_ns = time.monotonic_ns() + round(wait_s * 1e9)
        events, incarnation = self.block.events.cursor(), self.block.incarnation
        number = self._sender.submit(writes, deadline_ns, kind, injection, number, **options)
        return PendingCommand(number, paths, incarnation, deadline_ns + round(PATIENCE_S * 1e9), events)

    def outcomes(self, ticket: PendingCommand) -> list[Outcome]:
        """Wait until a command has ended, and return the outcomes of its values, in the values' order."""
        return [Outcome(path, OutcomeKind[kind.name], text) for path, (kind, text) in self._ends(ticket)]

    def _ends(self, ticket: PendingCommand) -> list[tuple[str, End]]:
        outcomes = CommandOutcomes(len(ticket.paths))
        while (event := self._next(ticket)) is not None and not outcomes.follow(event):
            pass
        missing = "" if event else self._silence(ticket)
        return [(path, outcomes.of(items, missing)) for path, items in ticket.values]

    def write(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Send values as one command, and wait for their outcomes.

        The method raises the same errors as :meth:`submit`.
        """
        return self.outcomes(self.submit(values, timeout_s))

    def _paths(self, writes: Sequence[Write]) -> tuple[str, ...]:
        """Return a path for each write."""
        layout = self.block.layout
        return tuple(path_at(layout, write.offset) or f"byte {write.offset}" for write in writes)

    def _register(self, path: str) -> Register:
        register = find(self.block.layout, path)
        self.check(register)
        return register

    def check(self, register: Register) -> None:
        """Raise CommandError if a register is not writable."""
        if not self.is_writable(register):
            why = not_writable([f"{self.block.source}/{register.path}"])
            if self.block.attributes.connector in _MODELS:
                why += ", unless its model computes it: then only shmio inject can show another value"
            raise CommandError(why)

    def unwritable(self, writes: Iterable[Write]) -> list[str]:
        """Return the paths of what writes set although commands may not write it; not more than a message lists."""
        outside = paths_outside(self.block.layout, writes, self._writable, MAX_PATHS + 1)
        return [f"{self.block.source}/{path}" for path in outside]

    def _next(self, ticket: PendingCommand) -> Event | None:
        """Return the next event about a command; None if no event comes in time."""
        while (rest_ns := ticket.until_ns - time.monotonic_ns()) > 0:
            event = ticket.events.next(rest_ns / 1e9)
            if event is None:
                return None
            if event.command == ticket.number and event.writer == self._sender.writer:
                return event
            if event.kind == EventKind.STARTED and event.incarnation != ticket.incarnation:
                # The new process reports the commands that the old process left in the queue. The outcomes of
                # others remain unknown.
                ticket.until_ns = min(ticket.until_ns, time.monotonic_ns() + round(PATIENCE_S * 1e9))
        return None

    def _silence(self, ticket: PendingCommand) -> str:
        if self.block.retired:
            return REPLACED
        if self.block.incarnation != ticket.incarnation:
            return RESTARTED
        if ticket.events.missed:
            return f"{ticket.events.missed} events were lost, and the source's answer may be among them"
        return SILENT
