"""What an alert watches: a condition on registers, the quality of sources, or the state of processes."""

from __future__ import annotations

import json
import logging
from collections.abc import Collection, Mapping
from typing import Final, NamedTuple, Protocol

from shmio.config import Alert
from shmio.errors import ConfigError
from shmio.injection.condition import Memory
from shmio.injection.language import Number
from shmio.injection.program import Condition, compile_condition
from shmio.layout.glob import Glob
from shmio.segment import Block, Frame, Phase, Quality, Segment
from shmio.segment.block import FrameFollower, Layouts

log = logging.getLogger("shmio.alerts")

Followers = Mapping[str, FrameFollower]
"""The follower of each source that any alert watches, by source name.

``frame`` of a follower is the frame to evaluate.
"""


class Finding(NamedTuple):
    """What an alert saw, in fields of a :class:`Notice`."""

    reason: str = ""
    values: Mapping[str, Number | None] = {}
    injected: bool = False
    provenance: str = ""


class Watch(Protocol):
    """Something that an alert watches, with a condition that is true, false or unknown."""

    sources: Collection[str]
    """Names of the sources whose frames :meth:`evaluate` needs."""

    def evaluate(self, followers: Followers) -> bool | None:
        """Return whether the condition is true; None if that is unknown.

        For a condition on registers, call this once for each new frame of the sources.
        """

    def describe(self, followers: Followers) -> Finding:
        """Return what the last :meth:`evaluate` saw."""


class RegisterWatch:
    """Watches a condition on registers, with the values that consumers see.

    The values of a source with bad quality are unknown.
    """

    def __init__(self, when: str, blocks: Mapping[str, Block]) -> None:
        self._condition: Condition | None = None
        try:
            self._condition = compile_condition(when, Layouts(blocks))
        except ConfigError as error:  # a reload has removed its registers
            log.warning("an alert cannot be evaluated until its registers exist again: %s", error)
        self.sources: Collection[str] = {source for source, _ in self._condition.reads} if self._condition else ()
        self._memory = Memory()
        self._values: list[Number | None] = []

    def evaluate(self, followers: Followers) -> bool | None:
        """Return whether the condition is true for the present frames; None if that is unknown."""
        if self._condition is None:
            return None
        values: list[Number | None] = []
        for source, codec in self._condition.reads:
            frame = _known(followers.get(source))
            value = None if frame is None else codec.decode(frame.image)
            values.append(value if isinstance(value, bool | int | float) else None)
        self._values = values
        return self._condition.expression.evaluate(values, self._memory)

    def describe(self, followers: Followers) -> Finding:
        """Return the values of the registers in the condition."""
        if self._condition is None:
            return Finding()
        kinds, injected = set(), False
        for (source, codec), value in zip(self._condition.reads, self._values, strict=True):
            if (frame := _known(followers.get(source))) is not None:
                kinds.add(str(frame.provenance))
                injected |= frame.effective is not None and codec.decode(frame.raw) != value
        named = dict(zip(self._condition.expression.references, self._values, strict=True))
        reason = ", ".join(f"{path} = {json.dumps(value)}" for path, value in named.items())
        return Finding(reason, named, injected, ", ".join(sorted(kinds)))


def _known(follower: FrameFollower | None) -> Frame | None:
    """Return the present frame of a source; None if its values are unknown."""
    frame = None if follower is None else follower.frame
    if follower is None or frame is None or follower.quality is Quality.BAD or frame.source_ns == 0:
        return None
    return frame


class QualityWatch:
    """Watches the quality of sources. The condition is true if any source has one of the given qualities."""

    def __init__(self, patterns: Collection[str], qualities: Collection[str], blocks: Mapping[str, Block]) -> None:
        globs = [Glob(pattern) for pattern in patterns]
        self.sources: Collection[str] = [name for name in blocks if any(glob.matches(name) for glob in globs)]
        self._qualities = qualities

    def evaluate(self, followers: Followers) -> bool | None:
        """Return whether any source has one of the given qualities; None if no source matches the patterns."""
        return any(self._meets(followers[name]) for name in self.sources) if self.sources else None

    def describe(self, followers: Followers) -> Finding:
        """Describe the sources that have one of the given qualities; if none has, all sources."""
        present = {name: followers[name] for name in self.sources}
        met = {name: one for name, one in present.items() if self._meets(one)} or present
        texts = (f"{name} is {one.quality}{f': {one.reason}' if one.reason else ''}" for name, one in met.items())
        kinds = {str(one.frame.provenance) for one in met.values() if one.frame is not None}
        return Finding("; ".join(texts), provenance=", ".join(sorted(kinds)))

    def _meets(self, follower: FrameFollower) -> bool:
        return str(follower.quality) in self._qualities


class ProcessWatch:
    """Watches the state of processes. The condition is true if any process is in one of the given states.

    A crashed process counts as being in ``backoff`` until it runs again, even while it is starting.
    """

    sources: Collection[str] = ()

    def __init__(self, patterns: Collection[str], states: Collection[str], segment: Segment) -> None:
        self._globs = [Glob(pattern) for pattern in patterns]
        self._states = states
        self._segment = segment
        self._present: dict[str, tuple[str, str]] = {}
        """State and note of each process, by name."""

    def evaluate(self, _followers: Followers) -> bool | None:
        """Return whether any process is in one of the given states; None if no process matches the patterns."""
        supervised = self._segment.supervised
        self._present = {}
        for slot in self._segment.processes:
            if slot.kind != "alerts" and any(glob.matches(slot.name) for glob in self._globs):
                state = slot.supervised
                phase, note = state.phase, state.note
                if not supervised:
                    phase, note = (
                        (Phase.RUNNING, "")
                        if slot.alive()
                        else (Phase.STOPPED, "its process is dead, and so is the supervisor")
                    )
                elif phase is Phase.STARTING and note and note != RESTARTING:
                    phase = Phase.BACKOFF
                self._present[slot.name] = str(phase), note
        return any(phase in self._states for phase, _ in self._present.values()) if self._present else None

    def describe(self, _followers: Followers) -> Finding:
        """Describe the processes that are in one of the given states; if none is, all processes that match."""
        met = {name: one for name, one in self._present.items() if one[0] in self._states} or self._present
        return Finding(
            "; ".join(f"{name} is in state {phase}{f': {note}' if note else ''}" for name, (phase, note) in met.items())
        )


RESTARTING: Final = "restarting"
"""The supervisor's note about a process whose restart somebody has requested."""


def make_watch(alert: Alert, segment: Segment) -> Watch:
    """Create the watch that an alert's configuration describes."""
    if alert.when is not None:
        return RegisterWatch(alert.when, segment.blocks)
    if alert.sources:
        return QualityWatch(alert.sources, alert.qualities, segment.blocks)
    return ProcessWatch(alert.processes, alert.states, segment)
