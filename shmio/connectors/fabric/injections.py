"""The injections of a mirror: the owner carries them out, and this instance shows them."""

from __future__ import annotations

import logging
import os
import threading
import time
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate, count
from typing import Final

import msgspec
import numpy as np

from shmio.config import Declaration
from shmio.config.declaration import contradictions
from shmio.connectors.injection_layers import DeclaredLayer, Layer, Owner, covering
from shmio.connectors.injections import LOOK_NS, NO_OWNER, Blocks, OwnerOf
from shmio.connectors.output import unwritable
from shmio.errors import ConfigError
from shmio.fabric.messages import CommandReply, InjectionRequest, SourceState, WriteItem
from shmio.fabric.names import CellName
from shmio.injection import compile_program
from shmio.injection.renaming import renamed
from shmio.layout.values.write import Write
from shmio.model.injection import Running
from shmio.model.values import NO_WRITER, OutcomeKind
from shmio.segment import BlockWriter, Command, CommandKind, Direction, Event, EventKind, Record
from shmio.segment.block import Layouts
from shmio.segment.commands import CommandOutcomes, first_number
from shmio.segment.events import EVENT_DATA_SIZE
from shmio.segment.header import LIST_SIZE
from shmio.segment.injection_list import InjectionEntry, encode
from shmio.wording import counted

BEGIN_NS: Final = 1_000_000_000
"""Time in ns after which the owner no longer begins a command."""
RENEW_NS: Final = 1_000_000_000
"""Interval in ns for telling the owner which programs still run."""
REPEAT_NS: Final = 2_000_000_000
"""Time in ns after which the mirror asks again to lift an injection whose program has ended."""
FOLLOW_NS: Final = 3_000_000_000
"""Time in ns for which the events about a command may come. It is longer than the time limit for the reply."""
GONE_NS: Final = 2_000_000_000
"""Time in ns for which the event about the end of an injection may come after the end itself."""
UNSEEN_NS: Final = 30_000_000_000
"""Time in ns for which an injection may be missing in the owner's list after its creation."""
LEAVE_S: Final = 1.0
"""Longest wait in s for the owner when the instance ends."""
MAX_TIME_NS: Final = (1 << 63) - 1
"""Latest time that a command or an injection can have; a faulty owner may send later ones."""
MAX_S: Final = 1e9
"""Latest start and end of an injection, in s."""
MAX_SENT: Final = 256
"""Maximum number of commands whose outcomes are not known yet."""

_DECLARATIONS: Final = msgspec.json.Decoder(Declaration)
_FAILED: Final = frozenset({OutcomeKind.REJECTED, OutcomeKind.REFUSED, OutcomeKind.EXPIRED, OutcomeKind.UNKNOWN})

Ask = Callable[[InjectionRequest, int], Future[CommandReply] | None]
"""Function that sends a command to the owner, which must begin it within the given time in ns.

None: nothing is known of the owner yet, so the command was not sent.
"""

log = logging.getLogger("shmio.source")


@dataclass
class _Sent:
    """A command that was sent to the owner.

    Attributes:
        command: The command of a program of this instance.
        owner: The program, if the command creates an injection.
        outcomes: The outcomes that the owner's events have given.
        until_ns: Time until which events about the command are awaited.
        reply: The owner's reply; None until the command is sent.
        answered: True if the reply was evaluated.
        seen: True if an event about the command has come.
        known: True if all outcomes have come as events.
        told: True if the mirror itself has published outcomes, because no event came.

    """

    command: Command
    owner: Owner | None
    outcomes: CommandOutcomes
    until_ns: int
    reply: Future[CommandReply] | None = None
    answered: bool = False
    seen: bool = False
    known: bool = False
    told: bool = False


@dataclass
class _Held:
    """An injection that a program of this instance has created at the owner.

    Attributes:
        owner: The program.
        keep: True if the injection stays when the program ends.
        since_ns: Time of its creation.
        seen: True if the owner's list has it, or had it.
        gone_ns: Time since which the owner's list no longer has it; 0 if it has it.
        lift_ns: Time before which the mirror does not ask again to lift it.

    """

    owner: Owner
    keep: bool
    since_ns: int
    seen: bool = False
    gone_ns: int = 0
    lift_ns: int = 0


@dataclass(frozen=True)
class _OwnersClock:
    """The owner's clock: its time ``clock_ns`` at the time ``at_ns`` of this host."""

    clock_ns: int
    at_ns: int
    virtual: bool


class MirroredInjections:
    """Sends commands about injections to the owner, and shows the owner's list of injections.

    An injection has the same number on both hosts. The owner's events about it are the outcomes of the
    commands of this instance. As long as a program runs that has created an injection, the mirror renews
    the injection at the owner.

    The command thread calls :meth:`take` and :meth:`follow_changes`. The loop's thread calls
    :meth:`writer_of`, :meth:`show` and :meth:`turn`.
    """

    def __init__(
        self,
        cell: CellName,
        writer: BlockWriter,
        writable: bytes,
        refuse_in: str,
        *,
        ask: Ask,
        names: Mapping[str, str],
        owner_of: OwnerOf,
        blocks: Blocks,
        now_ns: Callable[[], int],
        wake: Callable[[], None],
    ) -> None:
        """Continue with the injections of the source's previous process.

        Args:
            cell: The cell that owns the source.
            writer: Writes the block.
            writable: The bits that commands may write, as an image of the block.
            refuse_in: Why injections over ``/in`` are refused; empty if they are allowed.
            ask: Sends a command to the owner.
            names: For each source of this instance that mirrors a source of the owner, its name there.
            owner_of: Returns the process that uses a command queue.
            blocks: Returns the blocks of all sources.
            now_ns: The loop's clock.
            wake: Wakes the loop's thread.

        """
        self._cell, self._writer, self._block = cell, writer, writer.block
        self._writable = writable
        self._refuse_in, self._ask, self._names = refuse_in, ask, names
        own = {name: other for name, other in names.items() if name == writer.block.source}
        self._own_names = {other: name for name, other in [*names.items(), *own.items()]}
        self._owner_of, self._blocks, self._now_ns, self._wake = owner_of, blocks, now_ns, wake
        self._lock = threading.Lock()
        self._sent: dict[int, _Sent] = {}
        self._held = {
            one.number: _Held(Owner(one.writer, one.pid), one.keep, now_ns(), seen=True)
            for one in writer.block.injections.read()
            if not (one.cell or one.configured)
        }
        self._present = set(self._held)  # numbers in the owner's list
        self._clock: _OwnersClock | None = None
        self._shown: bytes | None = None
        self._all_shown = True
        self._refusal = ""  # why the owner did not renew injections when it was asked last
        self._numbers = count(first_number(os.getpid()) + 1)
        self._look_ns = self._renew_ns = 0

    # ---- in the command thread -----------------------------------------------------------------------------------

    @property
    def patience_ns(self) -> int:
        """Time in ns until :meth:`follow_changes` must be called; negative if no call is needed."""
        with self._lock:
            if not self._sent and all(held.keep for held in self._held.values()):
                return -1
        return max(0, self._look_ns - time.monotonic_ns())

    @property
    def overload(self) -> str:
        """Empty: the owner says if it cannot accept a write."""
        return ""

    def toward_device(self, _command: Command) -> Layer | None:
        """Return None: the owner decides what values of an injection over ``/in`` become."""
        return None

    def release(self, _cycle: int) -> list[tuple[DeclaredLayer, Write]]:
        """Return nothing: only the owner delays writes."""
        return []

    def forget(self, reason: str) -> None:
        """Do nothing: only the owner delays writes."""

    def take(self, command: Command) -> str:
        """Send a command to the owner. Return "", or why it was not sent."""
        owner = None
        if command.kind in (CommandKind.INJECT, CommandKind.DECLARE):
            owner = self._owner_of(command.writer)
            if owner is None:
                return NO_OWNER
        try:
            request = self._request(command)
        except (msgspec.MsgspecError, UnicodeDecodeError, ConfigError, ValueError, RecursionError) as error:
            return str(error)
        items = len(command.writes) if command.kind is CommandKind.SHADOW else 1
        now_ns = self._now_ns()
        sent = _Sent(command, owner, CommandOutcomes(items), now_ns + FOLLOW_NS)
        with self._lock:
            if command.id in self._sent:
                return f"command {command.id} was sent already; send it again under another number"
            if len(self._sent) >= MAX_SENT:
                return f"too many commands wait for cell {self._cell}; wait for their outcomes"
            self._sent[command.id] = sent  # first, because events about it may come at once
        reply = self._ask(request, min(BEGIN_NS, command.deadline_ns - now_ns))
        if reply is None:
            with self._lock:
                del self._sent[command.id]
            return f"no new message of cell {self._cell} has come yet; shmio fabric cells shows its state"
        sent.reply = reply
        reply.add_done_callback(lambda _: self._wake())
        return ""

    def _request(self, command: Command) -> InjectionRequest:
        """Return a command as the owner needs it.

        Raises:
            ConfigError: A declaration is wrong, or the owner cannot carry it out.
            ValueError: The command is malformed, or not allowed.

        """
        number, injection = command.id, command.injection
        items = [WriteItem(*write) for write in command.writes]
        if command.kind is CommandKind.DECLARE:
            data = msgspec.json.encode(self._translated(b"".join(write.data for write in command.writes)))
            return InjectionRequest("declare", number, keep=command.keep, name=command.name, declaration=data)
        if command.kind is CommandKind.INJECT:
            cover = covering(self._block.layout.size, command.writes)
            self._check_direction(command.direction, cover)
            return InjectionRequest(
                "inject", number, 0, command.direction, command.priority, command.keep, command.name, items
            )
        if command.kind is CommandKind.SHADOW:
            return InjectionRequest("shadow", number, injection, items=items)
        return InjectionRequest("lift", number, injection)

    def _check_direction(self, direction: Direction, cover: np.ndarray[tuple[int], np.dtype[np.uint8]]) -> None:
        if direction is Direction.IN:
            if self._refuse_in:
                raise ValueError(self._refuse_in)
            if reason := unwritable(self._block.source, self._block.layout, cover, self._writable):
                raise ValueError(reason)

    def _translated(self, data: bytes) -> Declaration:
        """Return a declaration with the owner's names and times.

        Raises:
            ConfigError: The declaration is wrong, or the owner cannot carry it out.
            ValueError: The injection is not allowed.

        """
        declaration = _DECLARATIONS.decode(data)
        for complaint in contradictions(declaration):
            raise ConfigError(complaint)
        blocks = dict(self._blocks())
        own = self._block.source
        program = compile_program(declaration, Layouts(blocks), {name: one.period_ns for name, one in blocks.items()})
        if program.source != own:
            raise ConfigError(f"target: it names source {program.source}, but the declaration was sent to source {own}")
        self._check_direction(Direction.IN if program.direction == "in" else Direction.OUT, program.cover)
        if others := sorted(program.foreign - self._names.keys()):
            raise ConfigError(
                f"when: cell {self._cell} evaluates the condition, but {others[0]} is no mirror of one of its sources; "
                "read only sources of that cell"
            )
        default = next(iter(blocks)) if len(blocks) == 1 else None
        return renamed(self._on_owners_clock(declaration), self._names, default)

    def _on_owners_clock(self, declaration: Declaration) -> Declaration:
        """Convert the start and the end of an injection to the owner's clock.

        Raises:
            ConfigError: The clocks cannot be compared, or the end has passed.

        """
        start_s, end_s = declaration.start_s, declaration.end_s
        if not start_s and end_s is None:
            return declaration
        clock, key = self._clock, "start_s" if start_s else "end_s"
        if clock is None:
            raise ConfigError(f"{key}: the clock of cell {self._cell} is not known yet; try again")
        ahead_ns = self._ahead_ns()
        if ahead_ns is None:
            who = f"cell {self._cell}" if clock.virtual else "this instance"
            raise ConfigError(
                f"{key}: {who} runs in virtual time, so the clocks of both cells differ; leave out start_s and end_s, "
                f"or declare the injection in cell {self._cell}"
            )
        ahead_s = ahead_ns / 1e9
        begin_s = max(0.0, start_s + ahead_s) if start_s else None
        if end_s is not None:
            end_s += ahead_s
            if end_s <= (begin_s or 0.0):
                raise ConfigError(f"end_s: cell {self._cell} was started after this time")
        return msgspec.structs.replace(declaration, start_s=begin_s, end_s=end_s)

    def _ahead_ns(self) -> int | None:
        """Return by how much the owner's clock is ahead of this instance's clock, in ns.

        None: the clocks cannot be compared, because time is virtual in one of the cells.
        """
        clock, own = self._clock, self._block.clock
        if clock is None or clock.virtual or own.last_written().virtual:
            return None
        return clock.clock_ns + self._now_ns() - clock.at_ns - own.present_ns()

    def follow_changes(self) -> None:
        """Every ``LOOK_NS``, check which programs still run that have created injections.

        The mirror renews their injections each ``RENEW_NS``, and lifts the others, except those with
        ``keep``.
        """
        if self.patience_ns != 0:
            return
        now_ns = time.monotonic_ns()
        self._look_ns = now_ns + LOOK_NS
        with self._lock:
            some = [(number, held) for number, held in self._held.items() if not held.keep]
        ended = [pair for pair in some if self._owner_of(pair[1].owner.writer) != pair[1].owner]
        for number, held in ended:
            if now_ns >= held.lift_ns:
                held.lift_ns = now_ns + REPEAT_NS
                self._lift(number)
        gone = {number for number, _ in ended}
        alive = [number for number, _ in some if number not in gone]
        if alive and now_ns >= self._renew_ns:
            self._renew_ns = now_ns + RENEW_NS
            reply = self._ask(InjectionRequest("renew", renewed=alive), BEGIN_NS)
            if reply is not None:
                reply.add_done_callback(self._on_renewed)

    def _lift(self, number: int) -> Future[CommandReply] | None:
        return self._ask(InjectionRequest("lift", next(self._numbers), number), BEGIN_NS)

    def leave(self) -> None:
        """Ask the owner to lift the injections of this instance, which ends, except those with ``keep``."""
        with self._lock:
            numbers = [number for number, held in self._held.items() if not held.keep]
        wait([reply for number in numbers if (reply := self._lift(number)) is not None], LEAVE_S)

    def _on_renewed(self, reply: Future[CommandReply]) -> None:
        """Tell why the owner will end injections of this instance. The link's thread calls this."""
        if reply.cancelled() or reply.exception() is not None:
            return
        refusal = ""
        if OutcomeKind.REJECTED in reply.result().outcomes:
            refusal = next(filter(None, reply.result().reasons), "it gives no reason")
        if refusal not in ("", self._refusal):
            log.warning(
                "cell %s does not renew the injections of this instance, so it ends them: %s", self._cell, refusal
            )
        self._refusal = refusal

    # ---- in the loop's thread ------------------------------------------------------------------------------------

    def writer_of(self, event: Event) -> int | None:
        """Return the command queue of this instance for an event of the owner; ``NO_WRITER`` if it has none.

        None: leave the event out, because the mirror has published it already.
        """
        with self._lock:
            sent = self._sent.get(event.command)
            held = self._held.get(event.command)
            if event.kind == EventKind.LIFTED:
                self._held.pop(event.injection, None)
            if sent is None:
                return NO_WRITER if held is None else held.owner.writer
            if sent.told:
                return None if event.kind == EventKind.REJECTED else NO_WRITER
            sent.seen = True
            sent.known = sent.outcomes.follow(event) or sent.known
            if event.kind == EventKind.INJECTED:
                self._hold(sent)
            return sent.command.writer

    def sender_of(self, event: Event) -> str:
        """Return who sent the command of an event, if it came through this instance; otherwise empty."""
        with self._lock:
            sent = self._sent.get(event.command)
        return "" if sent is None else sent.command.by

    def _hold(self, sent: _Sent) -> None:
        """Renew an injection from now on. The caller holds the lock."""
        if sent.owner is not None and sent.command.id not in self._held:
            seen = sent.command.id in self._present
            self._held[sent.command.id] = _Held(sent.owner, sent.command.keep, self._now_ns(), seen)

    def show(self, state: SourceState, late_ns: int) -> None:
        """Show the owner's injections in the list of this source.

        Args:
            state: The owner's state.
            late_ns: Time since the owner had this state, in ns.

        """
        now_ns = self._now_ns()
        with self._lock:
            self._clock = _OwnersClock(state.clock_ns + late_ns, now_ns, state.virtual)
            entries = [self._entry(one) for one in state.injections]
            self._present = present = {one.number for one in entries}
            for number, held in self._held.items():
                held.seen = held.seen or number in present or now_ns - held.since_ns > UNSEEN_NS
                held.gone_ns = 0 if number in present or not held.seen else held.gone_ns or now_ns
        document = self._document(entries)
        if document != self._shown:
            self._shown = document
            self._block.injections.write(document)

    def _document(self, entries: Sequence[InjectionEntry]) -> bytes:
        """Encode the list. If it is too long, leave out its last injections, which the owner's list still has."""
        items = [msgspec.json.encode(one) for one in entries]
        ends = list(accumulate(len(item) + 1 for item in items))
        fit = bisect_right(ends, LIST_SIZE - 1)  # each item has a comma or a bracket after it, and the list one before
        all_shown, self._all_shown = self._all_shown, fit == len(items)
        if all_shown and not self._all_shown:
            log.warning(
                "only %d of %s of cell %s are shown here, because their list is too long",
                fit, counted(len(items), "injection"), self._cell,
            )  # fmt: skip
        return encode(items[:fit])

    def _entry(self, one: InjectionEntry) -> InjectionEntry:
        """Return an entry of the owner's list as this instance shows it. The caller holds the lock."""
        size = self._block.layout.size
        ranges = tuple(
            (offset, count, mask)
            for offset, count, mask in one.ranges
            if 0 <= offset < offset + count <= size and 0 < mask < 256
        )
        running = one.running
        if running is not None:
            running = self._on_own_clock(running)
            with suppress(ConfigError):  # a condition of a newer version of the language: show it as it is
                running = msgspec.structs.replace(running, declaration=renamed(running.declaration, self._own_names))
        held, sent = self._held.get(one.number), self._sent.get(one.number)
        owner = held.owner if held is not None else sent.owner if sent is not None else None
        if owner is None:
            pid = 0 if one.cell else one.pid  # if a cell is named, this is the pid of the owner's uplink
            return msgspec.structs.replace(
                one, ranges=ranges, running=running, cell=one.cell or str(self._cell), pid=pid
            )
        return msgspec.structs.replace(one, ranges=ranges, running=running, cell="", writer=owner.writer, pid=owner.pid)

    def _on_own_clock(self, running: Running[Declaration]) -> Running[Declaration]:
        """Convert the times of an injection to this instance's clock, in ms; in virtual time, keep the owner's."""
        ahead_ns = self._ahead_ns()
        if ahead_ns is None:
            return running
        declaration = running.declaration
        start_s, end_s = (
            None if time_s is None else round(min(max(0.0, time_s - ahead_ns / 1e9), MAX_S), 3)
            for time_s in (declaration.start_s, declaration.end_s)
        )
        declaration = msgspec.structs.replace(declaration, start_s=start_s, end_s=end_s)
        time_ns = running.time_ns and min(max(1, running.time_ns - ahead_ns), MAX_TIME_NS)
        return msgspec.structs.replace(running, declaration=declaration, time_ns=time_ns)

    def turn(self) -> None:
        """Evaluate the owner's replies, and publish outcomes and ends for which no events have come."""
        now_ns = self._now_ns()
        records: list[Record] = []
        with self._lock:
            for number, sent in list(self._sent.items()):
                late = now_ns >= sent.until_ns
                if not sent.told and not sent.known:
                    records += self._outcomes(sent, late=late)
                if late:
                    del self._sent[number]
            gone = [number for number, held in self._held.items() if 0 < held.gone_ns < now_ns - GONE_NS]
            for number in gone:
                owner = self._held.pop(number).owner
                text = f"cell {self._cell} no longer has the injection"
                records.append(Record(EventKind.LIFTED, text, owner.writer, number, 0, 1, injection=number))
        for record in records:
            self._writer.event(record)

    @property
    def busy(self) -> bool:
        """True if :meth:`turn` must be called again soon."""
        return bool(self._sent) or any(held.gone_ns for held in self._held.values())

    def _outcomes(self, sent: _Sent, *, late: bool) -> Iterator[Record]:
        """Yield events with outcomes that the reply has, unless the owner's events will have them."""
        reply = sent.reply
        if reply is None or not reply.done() or (sent.answered and not late):
            return
        sent.answered = True
        result = reply.result()
        if "injected" in result.outcomes:
            self._hold(sent)
        failed = not _FAILED.isdisjoint(result.outcomes)
        if not late and (sent.seen or not failed):
            return  # the owner's events have the outcomes
        sent.told = True
        command = sent.command
        for item, (outcome, reason) in enumerate(zip(result.outcomes, result.reasons, strict=True)):
            if sent.outcomes.of([item], "") != (EventKind.UNKNOWN, ""):
                continue  # an event had it
            kind = EventKind[outcome.upper()]
            injection = command.id if kind is EventKind.INJECTED else command.injection
            record = Record(kind, reason, command.writer, command.id, item, 1, injection=injection, by=command.by)
            if command.kind is CommandKind.SHADOW:
                offset, mask, data = command.writes[item]
                record = record._replace(offset=offset, mask=mask, size=len(data))
                if kind is EventKind.SHADOWED:
                    record = record._replace(data=data[:EVENT_DATA_SIZE])
            yield record
