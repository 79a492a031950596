"""Where commands toward a source are taken, judged, and kept until the next cycle carries them out.

They are taken in a thread of its own, so that a device that does not answer delays no decision; the loop's thread
carries them out, before it reads, so that the next frame shows them.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.commands.batch import End, Item, coalesce, ends, one_each, records
from shmio.connectors.commands.finite import FiniteCheck
from shmio.connectors.injection.declared_injections import Blocks
from shmio.connectors.injection.layers import Layer, uncovered
from shmio.connectors.injection.processor import InjectionProcessor, OwnerOf
from shmio.connectors.injection.published import divert_command, pieces
from shmio.connectors.output import Output
from shmio.layout.values.write import Write, cover
from shmio.segment import NO_WRITER, Command, CommandKind, EventKind, Record

MAX_WAITING: Final = 256
"""Items that wait for the next cycle; what comes beyond stays in its queue. A command alone may have more."""
MAX_WAITING_BLOCKS: Final = 4
"""The same in bytes, as a multiple of the block's."""
FAR_NS: Final = 1 << 62
"""The deadline of what a delay has held: the next cycle writes it, or nobody does."""
TELL_NS: Final = 1_000_000_000
"""How often a writer that sends garbage is told."""

_UNARMED: Final = "an injection toward a device needs `armed = true` in the source's configuration"

log = logging.getLogger("shmio.source")


class CommandProcessor:
    """Judges the commands of one block. :meth:`run` is for a thread of its own, all else for the loop's."""

    def __init__(
        self,
        output: Output,
        writable: Iterable[str] | None,
        now_ns: Callable[[], int],
        *,
        allow_nonfinite: Iterable[str] = (),
        armed: bool = False,
        owner_of: OwnerOf = lambda _: None,
        blocks: Blocks | None = None,
        accepted: Callable[[], None] = lambda: None,
    ) -> None:
        """``writable``: patterns; None: the device cannot be written at all. ``armed``: injections may reach it.

        ``allow_nonfinite``: patterns of what may be written NaN and infinities.
        ``owner_of``: which process has a command queue. ``blocks``: of all sources, for the conditions of declared
        injections; default: this one. ``accepted``: called when items wait.
        """
        self._writer = output.writer
        self._output = output
        self._now_ns = now_ns
        self._accepted = accepted
        self._cannot = "this source's connector cannot write" if writable is None else ""
        layout = self._writer.block.layout
        self._writable = cover(layout, writable or ())
        self._finite = FiniteCheck(layout, allow_nonfinite)
        self._most_bytes = MAX_WAITING_BLOCKS * layout.size
        refuse_in = self._cannot or ("" if armed else _UNARMED)
        blocks = blocks or (lambda: {output.writer.block.source: output.writer.block})
        self._injections = InjectionProcessor(output, self._writable, refuse_in, owner_of, blocks)
        self._turn = threading.Lock()
        self._verdict = threading.Lock()  # held from the word that items are accepted until they wait
        self._closed = "the source is not connected yet"
        self._items: list[Item] = []
        self._held: Command | None = None  # taken from its queue, but there is no room for it before the next cycle
        self._garbage_ns: dict[int, int] = {}
        self._stopped = False

    def open(self) -> None:
        """The device is there, and its block is as it should be: accept."""
        with self._turn:
            self._closed = ""

    def close(self, reason: str) -> None:
        """The device is gone: what waits is not done later, and nothing more is accepted until it is back."""
        with self._turn:
            self._closed = f"the source is not connected: {reason}"
            items, self._items = self._items, []
        self._end(items, [(EventKind.EXPIRED, reason)] * len(items))
        self._injections.declared.forget(reason)
        self._make_room()

    def settle(self) -> None:
        """Wait until whatever somebody has been told is accepted is :attr:`waiting`, too."""
        with self._verdict:
            pass

    def release(self, cycle: int) -> None:
        """Send on what delays over ``/in`` have held for their time; before the cycle carries out what waits."""
        for layer, write in self._injections.declared.release(cycle):
            command = Command(NO_WRITER, layer.id, self._writer.incarnation, FAR_NS, (write,))
            self._accept(command, layer)

    @property
    def waiting(self) -> bool:
        """Whether there is something to carry out."""
        return bool(self._items)

    def carry_out(self, write: Callable[[Sequence[Write]], list[str]]) -> None:
        """Write all that waits, each byte and bit once, the last value wins; tell what became of each item.

        Commands go in the order in which they were accepted. Whatever ``write`` raises is raised, after it has been
        told of each item what is known.
        """
        items = self._take(lambda _: True)
        now_ns = self._now_ns()
        late = [item for item in items if now_ns > item.command.deadline_ns]
        self._expire(late)
        items = [item for item in items if now_ns <= item.command.deadline_ns]
        try:
            if items:
                self._write(items, write)
        finally:
            self._make_room()

    def _write(self, items: Sequence[Item], write: Callable[[Sequence[Write]], list[str]]) -> None:
        writes, superseded = coalesce(items, self._writer.block.layout.size)
        outcomes: Sequence[str | Lost] = [Lost.UNKNOWN] * len(writes)
        error = ""
        try:
            outcomes = one_each(write(writes), writes)
        except WriteLostError as lost:
            error = str(lost)
            outcomes = one_each(lost.outcomes, writes)
            raise
        except BaseException as unforeseen:
            error = str(unforeseen)
            raise
        finally:
            self._end(items, ends(items, writes, superseded, outcomes, error))

    def run(self) -> None:
        """Take commands until :meth:`stop`."""
        queues = self._writer.block.commands
        while not self._stopped:
            seen = queues.bell()
            taken = True
            while taken and not self._stopped:
                taken = False
                for writer in range(queues.writers):  # one of each in turn
                    taken |= self._take_one(writer)
            self._expire(self._take(lambda item: self._now_ns() > item.command.deadline_ns))
            self._injections.look()
            self._output.flush()
            if not self._stopped:
                queues.wait(seen, self._patience_ns())

    def stop(self) -> None:
        """Make :meth:`run` return; from any thread."""
        self._stopped = True
        self._writer.block.commands.wake()

    def _take(self, which: Callable[[Item], bool]) -> list[Item]:
        """Take what waits and is of this kind."""
        with self._turn:
            kinds = [(item, which(item)) for item in self._items]
            self._items = [item for item, wanted in kinds if not wanted]
        return [item for item, wanted in kinds if wanted]

    def _expire(self, items: Sequence[Item]) -> None:
        self._end(items, [(EventKind.EXPIRED, "no cycle came before its deadline")] * len(items))

    def _patience_ns(self) -> int:
        """Until the first deadline of what waits, or until clients are looked after; negative: for ever."""
        with self._turn:
            deadlines = [item.command.deadline_ns for item in self._items]
        waits = [max(0, min(deadlines) - self._now_ns()) + 1_000_000] if deadlines else []
        waits += [wait_ns for wait_ns in (self._injections.patience_ns, self._output.patience_ns) if wait_ns >= 0]
        return min(waits, default=-1)

    def _make_room(self) -> None:
        """What was held for want of room can be judged."""
        if self._held is not None:
            self._writer.block.commands.wake()

    def _take_one(self, writer: int) -> bool:
        """Judge the oldest command of a writer; whether there was one, and room for it."""
        if self._held is not None:
            command, self._held = self._held, None
            return self._judge(command)
        try:
            record = self._writer.block.commands.pop(writer)
            if record is None:
                return False
            command = Command.unpack(writer, record)
        except ValueError as error:
            self._garbage(writer, error)
            return True
        return self._judge(command)

    def _garbage(self, writer: int, error: ValueError) -> None:
        """A writer that sends what is no command is told now and then, however much it sends."""
        now_ns = time.monotonic_ns()
        if now_ns - self._garbage_ns.get(writer, -TELL_NS) >= TELL_NS:
            self._garbage_ns[writer] = now_ns
            log.warning("writer %d sends what is no command: %s", writer, error)
            self._writer.event(Record(EventKind.REJECTED, f"not a command: {error}", writer))

    def _judge(self, command: Command) -> bool:
        """Accept or reject; False if there is no room before the next cycle, and the command is held."""
        layer = self._injections.toward_device(command)
        write = command.kind is CommandKind.WRITE or layer is not None
        reason = self._refusal(command)
        if not reason and command.kind is CommandKind.NOTE:
            self._writer.event(Record(EventKind.NOTED, command.name, command.writer, command.id, 0, 1))
            return True
        if not reason and layer is not None:
            reason = uncovered(layer, command.writes)
        if not reason:
            reason = self._unwritable(command) if write else self._injections.take(command)
        if not reason and write:
            reason = self._injections.declared.overload
        if reason:
            count = max(1, len(command.writes))
            told = Record(EventKind.REJECTED, reason, command.writer, command.id, 0, count)
            if write:
                offset, mask, data = command.writes[0]
                told = told._replace(offset=offset, mask=mask, size=len(data))
            self._writer.event(told)
        if reason or not write:
            return True
        if not self._has_room(command):
            self._held = command
            return False
        self._accept(command, layer)
        return True

    def _accept(self, command: Command, layer: Layer | None) -> None:
        """Let a command meet the injections below ``layer``, and have what they leave of it wait for the cycle."""
        left, taken = divert_command(self._output, command, layer)
        left = [pair for pair in left if not self._made_unfit(pair[0])]
        self._end(taken, [(EventKind.TAKEN, "")] * len(taken))  # now all that injections get of it has been told
        items = [item for item, _ in left]
        with self._verdict:
            for item, source in left:  # outside the other lock, which the loop must never wait for long
                for part in pieces(EventKind.ACCEPTED, command, item.place, item.parts(), source):
                    self._writer.event(part)
            with self._turn:
                closed = self._closed
                if not closed:
                    self._items += items
        if closed:
            self._end(items, [(EventKind.EXPIRED, closed)] * len(items))
        elif items:
            self._accepted()

    def _made_unfit(self, item: Item) -> bool:
        """Whether declared injections have made of it what is not written; that is told."""
        reason = "" if item.data is None else self._finite.refusal(item.parts())
        if reason:
            self._end([item], [(EventKind.REFUSED, f"the injection {item.changed_by!r} changes it: {reason}")])
        return bool(reason)

    def _has_room(self, command: Command) -> bool:
        with self._turn:
            items = list(self._items)
        if not items:
            return True
        size = sum(len(item.write.data) for item in items) + sum(len(write.data) for write in command.writes)
        return len(items) + len(command.writes) <= MAX_WAITING and size <= self._most_bytes

    def _refusal(self, command: Command) -> str:
        """Why a command is not accepted; empty if it is."""
        if command.incarnation != self._writer.incarnation:
            return "it was meant for the source's process before this one, which ended: try again"
        late_ns = self._now_ns() - command.deadline_ns
        if late_ns > 0:
            return f"it came {late_ns / 1e6:.0f} ms after its deadline"
        return ""

    def _unwritable(self, command: Command) -> str:
        """Why nothing, or not this, can be written to the device; empty if it can."""
        if self._cannot:
            return self._cannot
        if self._closed:
            return self._closed
        for write in command.writes:
            stop = write.offset + len(write.data)
            if stop > len(self._writable):
                return f"byte {stop - 1} lies outside the block"
            allowed = self._writable[write.offset : stop]
            if not (allowed[0] & write.mask if write.mask else allowed == b"\xff" * len(allowed)):
                return f"bytes {write.offset} to {stop - 1} are not writable; name them in the source's `writable`"
        return self._finite.refusal(command.writes)

    def _end(self, items: Sequence[Item], ends: Sequence[End]) -> None:
        """Tell what became of accepted items: one event for neighbours in a command that ended alike."""
        for record in records(items, ends):
            self._writer.event(record)
