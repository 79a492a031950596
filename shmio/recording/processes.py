"""Starts and ends of the instance's processes, as its process table tells them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

from shmio.dump.encoding import Life, ProcessChange
from shmio.segment import Segment
from shmio.segment.processes import Phase, ProcessSlot

_DOWN: Final[Mapping[Phase, Life]] = {Phase.BACKOFF: Life.DIED, Phase.FATAL: Life.GAVE_UP}


class _State(NamedTuple):
    """A process at one look."""

    kind: str
    phase: Phase
    pid: int
    restarts: int
    why: str


class Watch:
    """Compares the table with what it was at the last look. An end is told however soon the process is back."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._known = self._now()

    def look(self) -> list[ProcessChange]:
        """What has happened since the last look, or since it was made."""
        before, self._known = self._known, self._now()
        changes = []
        for name, old in before.items():
            if name not in self._known:
                changes.append(_change(name, old, Life.REMOVED))
        for name, now in self._known.items():
            changes += _between(name, before.get(name), now)
        return changes

    def standing(self) -> list[ProcessChange]:
        """What runs, or fails to, as of the last look."""
        found = []
        for name, state in self._known.items():
            what = Life.IS if state.phase is Phase.RUNNING else _DOWN.get(state.phase)
            if what is not None:
                found.append(_change(name, state, what))
        return found

    def _now(self) -> dict[str, _State]:
        return {slot.name: _state(slot) for slot in self._segment.processes}


def _state(slot: ProcessSlot) -> _State:
    told = slot.supervised
    return _State(slot.kind, told.phase, slot.report.pid, told.restarts, told.note)


def _change(name: str, state: _State, what: Life) -> ProcessChange:
    return ProcessChange(name, state.kind, state.pid, what, state.why, state.restarts)


def _between(name: str, old: _State | None, now: _State) -> Iterator[ProcessChange]:
    phase = old.phase if old else Phase.STOPPED
    again = now.phase is Phase.STARTING or (old is not None and now.restarts > old.restarts)
    if old and phase is Phase.RUNNING and again and now.phase not in _DOWN:
        crashed = now.restarts > old.restarts and now.why  # one that was told to begin anew leaves no reason
        yield _change(name, old._replace(why=now.why), Life.DIED if crashed else Life.ENDED)
    if now.phase in _DOWN and now.phase is not phase:
        yield _change(name, now, _DOWN[now.phase])
    if now.phase is Phase.RUNNING and (old is None or phase is not Phase.RUNNING or now.pid != old.pid):
        yield _change(name, now._replace(why=""), Life.STARTED)
    if now.phase is Phase.STOPPED and phase is not Phase.STOPPED:
        yield _change(name, now, Life.ENDED)
