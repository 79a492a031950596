"""Reads the frames, events, steps and process changes of an instance, in order."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from operator import itemgetter
from typing import Final, NamedTuple

from shmio.model.clock import Clock
from shmio.recording.block_follower import BlockEntry, BlockFollower
from shmio.recording.format.encoding import BlockPosition, ProcessChange, ProcessEvent, Reason, StepMark
from shmio.recording.selection import Selection
from shmio.segment import Block, Segment
from shmio.segment.events import EVENT_SIZE
from shmio.segment.processes import Phase, ProcessSlot

TURN_S: Final = 0.1
"""Longest pause between two turns of the recorder, in s.

In a turn, the recorder reads the entries that are new since the last turn.
"""
LIVELY: Final = 256
"""If one block has more entries than this in a turn, the next turn comes sooner.

The reason is that many commands fill an event ring fast.
"""
BATCH_BYTES: Final = 2 << 20
"""Approximate number of bytes to read from one block in a turn; the next turn reads the rest."""

_DOWN: Final[Mapping[Phase, ProcessEvent]] = {Phase.BACKOFF: ProcessEvent.DIED, Phase.FATAL: ProcessEvent.GAVE_UP}


class InstanceEntry(NamedTuple):
    """The end of a step or a process change of the instance, with its log time."""

    log_ns: int
    item: StepMark | ProcessChange


class _ProcessState(NamedTuple):
    """The state of a process at one check."""

    kind: str
    phase: Phase
    pid: int
    restarts: int
    why: str


class ProcessWatch:
    """Finds changes in the process table, including restarts of processes between two checks."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._known = self._now()

    def check(self) -> list[ProcessChange]:
        """Return the changes since the last check; at the first check, since this object was created."""
        before, self._known = self._known, self._now()
        changes = []
        for name, old in before.items():
            if name not in self._known:
                changes.append(_change(name, old, ProcessEvent.REMOVED))
        for name, now in self._known.items():
            changes += _between(name, before.get(name), now)
        return changes

    def present(self) -> list[ProcessChange]:
        """Return a process change for each process that was running, or had failed, at the last check."""
        found = []
        for name, state in self._known.items():
            what = ProcessEvent.IS if state.phase is Phase.RUNNING else _DOWN.get(state.phase)
            if what is not None:
                found.append(_change(name, state, what))
        return found

    def _now(self) -> dict[str, _ProcessState]:
        return {slot.name: _state(slot) for slot in self._segment.processes}


def _state(slot: ProcessSlot) -> _ProcessState:
    supervised = slot.supervised
    return _ProcessState(slot.kind, supervised.phase, slot.report.pid, supervised.restarts, supervised.note)


def _change(name: str, state: _ProcessState, what: ProcessEvent) -> ProcessChange:
    return ProcessChange(name, state.kind, state.pid, what, state.why, state.restarts)


def _between(name: str, old: _ProcessState | None, now: _ProcessState) -> Iterator[ProcessChange]:
    phase = old.phase if old else Phase.STOPPED
    again = now.phase is Phase.STARTING or (old is not None and now.restarts > old.restarts)
    if old and phase is Phase.RUNNING and again and now.phase not in _DOWN:
        crashed = now.restarts > old.restarts and now.why  # a requested restart has no reason
        yield _change(name, old._replace(why=now.why), ProcessEvent.DIED if crashed else ProcessEvent.ENDED)
    if now.phase in _DOWN and now.phase is not phase:
        yield _change(name, now, _DOWN[now.phase])
    if now.phase is Phase.RUNNING and (old is None or phase is not Phase.RUNNING or now.pid != old.pid):
        yield _change(name, now._replace(why=""), ProcessEvent.STARTED)
    if now.phase is Phase.STOPPED and phase is not Phase.STOPPED:
        yield _change(name, now, ProcessEvent.ENDED)


class StartPositions(NamedTuple):
    """The positions in the blocks after which to start reading: ``places``, by the section of each block.

    For a block without a position, reading starts with the oldest frame if ``first`` is True, else
    with the next new frame.
    """

    places: Mapping[int, BlockPosition] = {}
    first: bool = True
    reason: Reason = Reason.NOT_RUNNING
    """Reason of a gap at the start."""


FROM_THE_FIRST: Final = StartPositions()


class InstanceFollower:
    """Reads each entry of an instance once, in order. Use it from one thread only.

    The follower also reads blocks that a reload adds or replaces. A recorder may write several files
    from one follower, one after another; no entry is lost between the files.
    """

    def __init__(
        self, segment: Segment, start: StartPositions = FROM_THE_FIRST, selection: Selection | None = None
    ) -> None:
        """Create the follower.

        ``selection`` names the sources and registers to record; None selects all.
        """
        self.segment = segment
        self.start = start
        self.followers: list[BlockFollower] = []
        """Followers of the present blocks, and of retired blocks that have unread entries."""
        self.done = 0
        """Number of the last step of virtual time whose frames have all been read."""
        self.went_back = False
        """True after a snapshot has set time back, until :meth:`restart_time`."""
        self._selection = selection or Selection()
        self._watched: set[str] = set()
        self._watching: list[BlockFollower] = []
        self._seen: set[int] = set()
        """Sections of all blocks that were found so far."""
        self._blocks = 0
        self._lively = False
        self._watch = ProcessWatch(segment)
        self._watched_s = time.monotonic()
        self._follow(start)

    def restart_time(self) -> None:
        """Let the log time go back: give the next entries their own times, even if earlier ones have later times."""
        self.went_back = False
        for follower in (*self.followers, *self._watching):
            follower.restart_time()

    def again(self, start: StartPositions) -> InstanceFollower:
        """Return a new follower of the same instance and selection, which starts at other positions."""
        tap = InstanceFollower(self.segment, start, self._selection)
        tap.done = self.done
        return tap

    def watch(self, sources: Collection[str]) -> None:
        """From now on, also read these sources, even if they are not selected for recording.

        A follower of a source that is not selected has number 0, and is not in :attr:`followers`.
        """
        self._watched |= set(sources)
        followed = {follower.block.section for follower in (*self.followers, *self._watching)}
        for block in self._known.values():
            if block.source in self._watched and block.section not in followed:
                self._watch_block(block)

    def _watch_block(self, block: Block) -> None:
        place = BlockPosition(block.ring.head(), block.events.head())
        self._watching.append(BlockFollower(block, 0, place, Reason.OVERTAKEN, self.segment.header.started_utc_ns))

    def log_time(self, monotonic_ns: int) -> int:
        """Convert CLOCK_MONOTONIC to log time, in ns.

        Log time is UTC, but changes of the host's clock do not affect it.
        """
        head = self.segment.header
        return max(0, head.started_utc_ns + monotonic_ns - head.started_ns)

    def now(self) -> int:
        """Return the present log time in ns."""
        return self.log_time(time.monotonic_ns())

    def take(self) -> tuple[list[BlockEntry | InstanceEntry], bool]:
        """Return (entries, more): new entries in order, and whether further entries are unread."""
        state = self.segment.clock.read()  # before the blocks, so that all frames of a finished step are read
        self.segment.refresh()
        if self.segment.blocks is not self._known:
            self._follow(FROM_THE_FIRST)
        entries: list[BlockEntry | InstanceEntry] = []
        more, most = False, 0
        for follower in (*self.followers, *self._watching):
            batch = max(16, BATCH_BYTES // (follower.block.layout.size + EVENT_SIZE))
            taken = follower.take(batch)
            more |= len(taken) >= batch
            if follower.done:
                taken += follower.remaining()
            most = max(most, len(taken))
            entries += taken
        self._lively = most > LIVELY
        self.followers = [follower for follower in self.followers if not follower.done]
        self._watching = [follower for follower in self._watching if not follower.done]
        entries.sort(key=itemgetter(0))  # by log time; stable: entries of a block stay in order
        if state.virtual and state.done != self.done and not more:
            entries += self._step(state)
        now_s = time.monotonic()
        if now_s - self._watched_s >= TURN_S:
            self._watched_s = now_s
            entries += self._asides(self._watch.check())
        return entries, more

    def present(self) -> list[InstanceEntry]:
        """Return the present state of the processes as entries."""
        return self._asides(self._watch.present())

    def _asides(self, changes: Iterable[ProcessChange]) -> list[InstanceEntry]:
        now_ns = self.now()
        return [InstanceEntry(now_ns, change) for change in changes]

    def remaining(self) -> list[BlockEntry]:
        """Return gaps for the frames and events that were overwritten after the last entries that were read."""
        return [entry for follower in self.followers for entry in follower.remaining()]

    @property
    def pause_s(self) -> float:
        """Time in s to wait before the next turn, which is much shorter than the rings keep entries."""
        rings = [follower.block.ring for follower in (*self.followers, *self._watching)]
        return min(
            [TURN_S / 10 if self._lively else TURN_S, *(ring.slot_count * ring.period_ns / 8e9 for ring in rings)]
        )

    def _step(self, state: Clock) -> list[InstanceEntry]:
        """Return the mark for the end of a step whose frames have all been read."""
        self.went_back |= state.done < self.done
        self.done = state.done
        if state.done != state.step or not state.dt_ns:  # the length of that step is unknown
            return []
        log_ns = self.log_time(self.segment.clock.monotonic_ns(state.time_ns))
        return [InstanceEntry(log_ns, StepMark(state.step, state.time_ns, state.dt_ns))]

    def _follow(self, start: StartPositions) -> None:
        """Follow new blocks, including those that a reload has added and already retired."""
        self._known = self.segment.blocks
        ended = self.segment.ended
        for block in (*ended, *self._known.values()):
            if block.section in self._seen:
                continue
            self._seen.add(block.section)
            part = self._selection.part(block, self._known)
            if part is None:
                if block.source in self._watched and block not in ended:
                    self._watch_block(block)
                continue
            place = start.places.get(block.section)
            reason = start.reason if place or start.first else Reason.OVERTAKEN
            if place is None:
                place = BlockPosition() if start.first else BlockPosition(block.ring.head(), block.events.head())
            over = block in ended
            if over and (place.frame, place.event) == (block.ring.head(), block.events.head()):
                continue
            self._blocks += 1
            self.followers.append(
                BlockFollower(
                    block, self._blocks, place, reason, self.segment.header.started_utc_ns, over=over, part=part
                )
            )
