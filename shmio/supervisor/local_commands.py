"""Writes to the audit log what programs on this host do to the instance through its shared memory.

These programs use no endpoint that could write the entries. Only the sources receive their commands,
and a source must not wait for a disk. Therefore, a thread of the supervisor reads the sources'
events. An event about a command has the command's number, which contains the pid of the program. The
instance's own processes write entries about their commands themselves. If such a process was killed
before it knew the outcome of a command, this module writes the entry.

A mirror also shows the events of another host, and a replay those of a recording. The pids in them
name no process of this host, so they get no entries.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from shmio.audit import trail
from shmio.audit.trail import MAX_NAMED, Acting, Actor, uid_actor
from shmio.model.clock import Clock
from shmio.model.values import NO_WRITER, ROLES, WRITERS, pid_of
from shmio.segment import Block, Event, EventKind, Segment
from shmio.segment.clock import StateAction
from shmio.segment.commands import worst
from shmio.segment.events import ENDS, EVENT_DATA_SIZE

if TYPE_CHECKING:
    from shmio.segment.explain import Explained, Explainer

TURN_S: Final = 0.05
"""Pause in s between two turns of the thread, which is shorter than the time in which an event ring fills."""
LIVELY_S: Final = 0.005
"""Pause in s after a turn in which a block had many events."""
LIVELY: Final = 256
"""Number of events of a block in one turn above which they count as many."""
MAX_READ: Final = 1024
"""Maximum number of events of a block to read in one turn, so that the other blocks do not wait."""
MAX_OPEN: Final = 4096
"""Maximum number of commands of a block for whose outcomes to wait."""
CLOSE_S: Final = 2.0
"""Longest time in s to wait for the end of the thread."""
RESTARTED: Final = "the source was restarted before it reported the outcome"

_WRITES: Final = frozenset(
    {EventKind.WRITTEN, EventKind.REFUSED, EventKind.EXPIRED, EventKind.UNKNOWN, EventKind.TAKEN}
)

log = logging.getLogger("shmio.audit")


class Programs:
    """The programs that may change the instance: its own processes and others."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._own: set[int] = set()
        self._uplink = 0  # the pid of the present or last process "fabric"
        self._others: dict[int, Actor] = {}
        self._ended: dict[int, bool] = {}

    def look(self) -> None:
        """Read the process table. Call this often, because a program may end before its events are read."""
        self._ended.clear()
        for slot in self._segment.processes:
            pid = slot.report.pid
            self._own.add(pid)
            if slot.writer == WRITERS["fabric"] and pid:
                self._uplink = pid
        for slot in self._segment.processes.external:
            report = slot.report
            if report.pid and report.pid not in self._others:
                uid = _uid_of(report.pid, report.counters[0])
                self._others[report.pid] = uid_actor(uid, f"pid {report.pid} {report.note}".rstrip())
        if len(self._others) > MAX_OPEN:
            self._others.clear()

    def sender(self, number: int, writer: int) -> int:
        """Return the pid of the process that sent a command.

        It is in the number of the command. But the process ``fabric`` also passes on commands of other cells,
        whose numbers contain pids of other hosts.

        Args:
            number: The number of the command.
            writer: The queue from which it came.
        """
        pid = pid_of(number)
        return self._uplink if writer == WRITERS["fabric"] and pid not in self._own else pid

    def is_own(self, pid: int, writer: int | None = None) -> bool:
        """Return whether a process belongs to the instance, and therefore writes its entries itself.

        Args:
            pid: The process.
            writer: The queue from which its command came; None if it is unknown.
        """
        return pid in self._own or writer in ROLES

    def has_ended(self, pid: int) -> bool:
        """Return whether a process has ended."""
        if pid not in self._ended:
            self._ended[pid] = not Path(f"/proc/{pid}").exists()
        return self._ended[pid]

    def actor(self, pid: int, writer: int | None = None) -> Acting:
        """Return who acts through the process with this pid, for an entry.

        ``writer`` is the queue from which its command came; None if it is unknown.
        """
        if self.is_own(pid, writer):
            kind = "web" if writer is None else ROLES.get(writer, "web")
            return Acting(Actor("process", kind, f"pid {pid}, which ended before shmio could find its user"), kind)
        found = self._others.get(pid)
        if found is None:
            uid = _uid_of(pid, None)
            origin = f"pid {pid} {trail.program_of(pid)}".rstrip()
            found = uid_actor(uid, origin)
        return Acting(found, "local")


def _uid_of(pid: int, told: int | None) -> int | None:
    """Return the uid of a process; if the process has ended, ``told``, the uid that it reported."""
    try:
        return Path(f"/proc/{pid}").stat().st_uid
    except OSError:
        return told


class _OpenCommand:
    """The events of a command that is not known to be over, and the pid of the process that sent it."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.events: list[Event] = []
        self._accepted: set[int] = set()
        self._ended: set[int] = set()

    def add(self, event: Event) -> bool:
        """Add an event; return whether the command may be over now."""
        self.events.append(event)
        if event.kind == EventKind.ACCEPTED:
            self._accepted.add(event.item)
        elif event.kind in _WRITES:
            self._ended.update(range(event.item, event.item + max(1, event.items)))
        return event.kind in ENDS

    @property
    def over(self) -> bool:
        """True if each accepted item has an outcome, or the last event is not the outcome of a write."""
        return self._accepted <= self._ended or self.events[-1].kind not in _WRITES


class BlockCommands:
    """Follows the commands to one block. Use it from one thread."""

    def __init__(self, block: Block, programs: Programs, after: int) -> None:
        """Start reading after the event with the number ``after``."""
        self.block = block
        self._programs = programs
        self._cursor = block.events.cursor(after=after)
        self._open: dict[tuple[int, int, int], _OpenCommand] = {}
        self._ending: dict[tuple[int, int, int], None] = {}
        self._explainer: Explainer | None = None
        self._asked = 0 if block.playhead is None else block.playhead.asked()
        self._present = block.events.head()
        self._reproduces = block.attributes.connector == "fabric" or block.attributes.replay

    @property
    def over(self) -> bool:
        """True if a reload has retired the block, and all its events have been read."""
        return self._cursor.ended

    def turn(self) -> int:
        """Read new events; return their number."""
        count = 0
        while count < MAX_READ and (event := self._cursor.poll()) is not None:
            count += 1
            if missed := self._cursor.take_missed():
                self._lose(missed, event.number)
            self._take(event)
        if count < MAX_READ:  # all events have been read, so these commands have no others yet
            self._end([key for key in self._ending if self._open[key].over])
            self._ending.clear()
            self._follow_replay()
        return count

    def _lose(self, missed: int, before: int) -> None:
        self._open.clear()
        self._ending.clear()
        self._explainer = None
        reason = "events were overwritten before they were read, and commands of local programs may be among them"
        trail.record("audit", {"source": self.block.source, "events": missed}, "lost", reason, event=before - 1)

    def _take(self, event: Event) -> None:
        if event.kind == EventKind.STARTED:
            self._end([key for key in self._open if key[0] != event.incarnation], RESTARTED)
            self._ending.clear()
        if not event.command or (self._reproduces and event.writer == NO_WRITER):
            return
        key = event.command_key
        known = self._open.get(key)
        if known is None:
            if len(self._open) >= MAX_OPEN:
                oldest = next(iter(self._open))
                self._ending.pop(oldest, None)
                self._end([oldest], "too many commands are in flight")
            known = self._open[key] = _OpenCommand(self._programs.sender(event.command, event.writer))
        if known.add(event):
            self._ending[key] = None

    def _end(self, keys: Iterable[tuple[int, int, int]], missing: str = "") -> None:
        """Write the entries of commands; ``missing`` says why some outcomes are unknown."""
        for key in keys:
            command = self._open.pop(key)
            pid, events = command.pid, command.events
            if events[0].kind == EventKind.INJECTED and not self._is_whole(events):
                self._open[key] = command
                continue
            _, writer, number = key
            if self._programs.is_own(pid, writer):  # it has written the entry, unless it was killed before
                wanted = events[-1].number > self._present and self._programs.has_ended(pid)
            else:
                wanted = True
            if wanted:
                self._record_safely(events, self._programs.actor(pid, writer), number, missing)

    @staticmethod
    def _is_whole(events: Sequence[Event]) -> bool:
        """Return whether all parts of an injection's definition are there."""
        if len(events[-1].data) < EVENT_DATA_SIZE:
            return True
        try:
            msgspec.json.decode(b"".join(event.data for event in events))
        except (msgspec.MsgspecError, UnicodeDecodeError):
            return False
        return True

    def _record_safely(self, events: Sequence[Event], who: Acting, number: int, missing: str) -> None:
        """Write the entry of a command, even if its events cannot be explained."""
        try:
            self._record(events, who, number, missing)
        except Exception as error:
            log.exception("a command to %s cannot be explained", self.block.source)
            self._explainer = None
            reason = f"the command cannot be explained: {type(error).__name__}"
            outcome = str(EventKind(events[-1].kind))
            trail.record("command", {"source": self.block.source}, outcome, reason, who=who, command=number)

    def _record(self, events: Sequence[Event], who: Acting, number: int, missing: str) -> None:
        found = [self._explain(event) for event in events]
        last, kind = events[-1], EventKind(events[-1].kind)
        places = {place.path: place for one in found for place in one.places}
        values: dict[str, Any] = {path: place.plain if place.valued else None for path, place in places.items()}
        for one in found:
            values |= {place.path: place.plain for place in one.places if place.valued}
        outcome, reason = str(kind), last.text
        if kind is EventKind.INJECTED:
            definition = next((one.definition for one in reversed(found) if one.definition is not None), None) or {}
            action = "declare" if "target" in definition else "inject"
            what = {"source": self.block.source, "injection": last.injection, "name": last.text, **definition}
            if places:
                what["paths"] = list(places)[:MAX_NAMED]
            reason = ""
        elif kind in (EventKind.LIFTED, EventKind.NOTED):
            action = "lift" if kind is EventKind.LIFTED else "note"
            about = {"injection": last.injection} if kind is EventKind.LIFTED else {"note": reason}
            what, reason = {"source": self.block.source, **about}, ""
        elif kind in _WRITES or kind is EventKind.ACCEPTED:
            ends = [(EventKind(one.kind), one.text) for one in events if one.kind in _WRITES]
            action, what = "write", values
            kind, reason = worst([*ends, (EventKind.UNKNOWN, missing)] if missing else ends)
            outcome = str(kind)
        elif kind is EventKind.SHADOWED:
            action, what, reason = "feed", values, ""  # its text is the injection's name
        else:
            action, what = ("write" if last.size else "command"), values
        what = what or {"source": self.block.source}
        trail.record(action, what, outcome, reason, who=who, command=number, event=last.number)

    def _explain(self, event: Event) -> Explained:
        if self._explainer is None:
            from shmio.segment.explain import Explainer  # noqa: PLC0415  loads numpy, which is not always needed

            self._explainer = Explainer(self.block.source, self.block.layout, MAX_NAMED)
            self._explainer.know(self.block.injections.read())
        return self._explainer.explain(event)

    def _follow_replay(self) -> None:
        """Write an entry if a program has asked to move the replay; of several requests in a turn, for the last."""
        playhead = self.block.playhead
        if playhead is None or (asked := playhead.asks(self._asked)) is None:
            return
        self._asked, request = asked
        pid = playhead.asker()
        if not self._programs.is_own(pid):
            what = {"source": self.block.source, **({} if request is None else msgspec.to_builtins(request))}
            trail.record("replay", what, "requested", who=self._programs.actor(pid))


_SNAPSHOTS: Final = {StateAction.SAVE: "save snapshot", StateAction.RESTORE: "restore snapshot"}


class TimeChanges:
    """Records in the audit log which programs move the instance's time, save snapshots or restore them.

    Use it from one thread.
    """

    def __init__(self, segment: Segment, programs: Programs) -> None:
        self._clock = segment.clock
        self._programs = programs
        self._before = self._clock.last_written()
        self._asked = self._clock.state_request().number

    def turn(self) -> None:
        """Write entries for all changes since the last turn.

        All steps since the last turn share one entry. If several snapshots were saved or restored,
        only the last has an entry.
        """
        asked, before, now = self._clock.state_request(), self._before, self._clock.last_written()
        snapshot, self._asked = asked.number != self._asked and asked.action in _SNAPSHOTS, asked.number
        if now == before and not snapshot:
            return
        self._before = now
        if snapshot and not self._programs.is_own(asked.pid):
            who = self._programs.actor(asked.pid)
            trail.record(_SNAPSHOTS[asked.action], {"snapshot": asked.name}, "requested", who=who)
        if snapshot and asked.action is StateAction.RESTORE:
            before = now._replace(owner=before.owner)  # the jump is no step
        pid = now.owner or before.owner
        if not pid or self._programs.is_own(pid):
            return
        who = self._programs.actor(pid)
        for action, what in _changes(before, now):
            count = now.step - before.step if action == "step" else 1
            trail.record(action, what, "done", who=who, count=count)


def _changes(before: Clock, now: Clock) -> Iterable[tuple[str, Mapping[str, Any]]]:
    if now.step_size_ns != before.step_size_ns:
        yield "step size", {"dt_s": now.step_size_ns / 1e9}
    if now.step > before.step and not before.playing:
        yield "step", {
            "step": now.step, "dt_s": now.dt_ns / 1e9, "time_s": now.time_ns / 1e9
        }  # fmt: skip
    if now.playing != before.playing:
        yield ("play", {"rate": now.rate}) if now.playing else ("pause", {})
    if now.virtual != before.virtual:
        yield ("stop time", {}) if now.virtual else ("release", {})


class LocalCommands:
    """Writes to the audit log, in a thread, what local programs do to all sources of an instance."""

    def __init__(self, instance: str, after: Mapping[str, int] | None) -> None:
        """Start the thread.

        Args:
            instance: Name of the instance.
            after: For each source, the number of the last event that an earlier supervisor has recorded.
                Other sources are read from their oldest event on.

        """
        self._segment = Segment.open(instance)
        self._programs = Programs(self._segment)
        self._time = TimeChanges(self._segment, self._programs)
        self._after = dict(after or {})
        self._blocks: dict[int, BlockCommands] = {}
        self._seen: set[int] = set()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="local commands", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Read the remaining events, and end the thread."""
        self._stopping.set()
        self._thread.join(CLOSE_S)
        if not self._thread.is_alive():
            self._segment.close()

    def _run(self) -> None:
        pause_s, failure = 0.0, ""
        while True:
            stopping, count = self._stopping.wait(pause_s), 0
            try:
                count = self._turn()
                pause_s = LIVELY_S if count > LIVELY else TURN_S
            except Exception as error:
                pause_s, before, failure = 1.0, failure, repr(error)
                if failure != before:
                    log.exception("commands of local programs cannot be written to the audit log")
            if stopping and count < MAX_READ:
                return

    def _turn(self) -> int:
        """Read new events of all sources, and return the largest number of events of a source."""
        self._segment.refresh()
        self._programs.look()
        for block in (*self._segment.ended, *self._segment.blocks.values()):
            if block.section not in self._seen:
                self._seen.add(block.section)
                after = min(self._after.pop(block.source, 0), block.events.head())
                self._blocks[block.section] = BlockCommands(block, self._programs, after)
        most = max((commands.turn() for commands in self._blocks.values()), default=0)
        for section in [section for section, commands in self._blocks.items() if commands.over]:
            del self._blocks[section]
        self._time.turn()
        return most
