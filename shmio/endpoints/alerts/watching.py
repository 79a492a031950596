"""What an alert watches: a condition over registers, the quality of sources, or the state of processes."""

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
"""The follower of each source that any alert watches. Its ``frame`` is the present one."""


class Finding(NamedTuple):
    """What an alert sees at present.

    ``holds`` is None if it is unknown whether the condition is true. ``reason`` says what is seen.
    """

    holds: bool | None
    reason: str = ""
    values: Mapping[str, Number | None] = {}
    injected: bool = False
    provenance: str = ""


UNKNOWN: Final = Finding(None)


class Watch(Protocol):
    """What an alert watches."""

    sources: Collection[str]
    """The sources whose frames matter."""

    def evaluate(self, followers: Followers) -> Finding:
        """Evaluate the present state. For a condition, call it once for each frame of its sources."""


class RegisterWatch:
    """A condition over registers, with the values that consumers see.

    The values of a source with bad quality are unknown.
    """

    def __init__(self, when: str, blocks: Mapping[str, Block]) -> None:
        self._condition: Condition | None = None
        try:
            self._condition = compile_condition(when, Layouts(blocks))
        except ConfigError as error:  # a reload has removed its registers
            log.warning("an alert is unknown until its registers exist again: %s", error)
        self.sources: Collection[str] = {source for source, _ in self._condition.reads} if self._condition else ()
        self._memory = Memory()

    def evaluate(self, followers: Followers) -> Finding:
        """Evaluate the condition."""
        if self._condition is None:
            return UNKNOWN
        expression, reads = self._condition.expression, self._condition.reads
        frames = [_known(followers.get(source)) for source, _ in reads]
        values: list[Number | None] = []
        injected = False
        for frame, (_, codec) in zip(frames, reads, strict=True):
            value = None if frame is None else codec.decode(frame.image)
            values.append(value if isinstance(value, bool | int | float) else None)
            injected |= frame is not None and frame.effective is not None and codec.decode(frame.raw) != value
        holds = expression.evaluate(values, self._memory)
        named = dict(zip(expression.references, values, strict=True))
        kinds = sorted({str(frame.provenance) for frame in frames if frame is not None})
        reason = ", ".join(f"{path} = {json.dumps(value)}" for path, value in named.items())
        return Finding(holds, reason, named, injected, ", ".join(kinds))


def _known(follower: FrameFollower | None) -> Frame | None:
    """Return the present frame of a source; None if its values are unknown."""
    frame = None if follower is None else follower.frame
    if follower is None or frame is None or follower.quality is Quality.BAD or frame.source_ns == 0:
        return None
    return frame


class QualityWatch:
    """The quality of sources. The finding is true if any of them has one of the given qualities."""

    def __init__(self, patterns: Collection[str], qualities: Collection[str], blocks: Mapping[str, Block]) -> None:
        globs = [Glob(pattern) for pattern in patterns]
        self.sources: Collection[str] = [name for name in blocks if any(glob.matches(name) for glob in globs)]
        self._qualities = qualities

    def evaluate(self, followers: Followers) -> Finding:
        """Compare the present qualities."""
        if not self.sources:
            return UNKNOWN
        present = {name: followers[name] for name in self.sources}
        met = [one for one in present.items() if str(one[1].quality) in self._qualities]
        texts = [
            f"{name} is {one.quality}{f': {one.reason}' if one.reason else ''}" for name, one in met or present.items()
        ]
        frames = [one.frame for _, one in met or present.items() if one.frame is not None]
        kinds = sorted({str(frame.provenance) for frame in frames})
        return Finding(bool(met), "; ".join(texts), {}, injected=False, provenance=", ".join(kinds))


class ProcessWatch:
    """The state of processes. The finding is true if any of them is in one of the given states.

    A process that has crashed is in ``backoff`` until it runs again, also while it is being started.
    """

    sources: Collection[str] = ()

    def __init__(self, patterns: Collection[str], states: Collection[str], segment: Segment) -> None:
        self._globs = [Glob(pattern) for pattern in patterns]
        self._states = states
        self._segment = segment

    def evaluate(self, _followers: Followers) -> Finding:
        """Compare the present states."""
        supervised = self._segment.supervised
        states: dict[str, tuple[str, str]] = {}
        for slot in self._segment.processes:
            if slot.kind != "alerts" and any(glob.matches(slot.name) for glob in self._globs):
                state = slot.supervised
                phase, note = state.phase, state.note
                if not supervised:
                    phase, note = (Phase.RUNNING, "") if slot.alive() else (Phase.STOPPED, "dead, as is the supervisor")
                elif phase is Phase.STARTING and note and note != RESTARTING:
                    phase = Phase.BACKOFF
                states[slot.name] = str(phase), note
        if not states:
            return UNKNOWN
        met = {name: one for name, one in states.items() if one[0] in self._states}
        told_states = (
            f"{name} is in state {one[0]}{f': {one[1]}' if one[1] else ''}" for name, one in (met or states).items()
        )
        return Finding(bool(met), "; ".join(told_states))


RESTARTING: Final = "restarting"
"""The supervisor's note about a process whose restart was requested."""


def make_watch(alert: Alert, segment: Segment) -> Watch:
    """Return what an alert watches."""
    if alert.when is not None:
        return RegisterWatch(alert.when, segment.blocks)
    if alert.sources:
        return QualityWatch(alert.sources, alert.qualities, segment.blocks)
    return ProcessWatch(alert.processes, alert.states, segment)
