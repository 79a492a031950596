"""The state of the instance, derived from its processes and sources, and its publication."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Final

from shmio.errors import SegmentError
from shmio.local.status import assess
from shmio.segment import Quality, Segment
from shmio.segment import State as InstanceState
from shmio.supervisor.fleet import Fleet
from shmio.supervisor.log_folder import LogFolder
from shmio.supervisor.managed import log
from shmio.supervisor.notify import Notifier
from shmio.supervisor.states import State

QUALITY_S: Final = 0.5
"""How often the sources' quality is checked after the start."""


class Health:
    """Publishes the state of an instance to the segment, the service manager and the log."""

    def __init__(
        self,
        segment: Segment,
        fleet: Fleet,
        notifier: Notifier,
        logs: LogFolder,
        on_state: Callable[[InstanceState], None],
    ) -> None:
        """Create it; ``on_state`` is called with each new state."""
        self._segment = segment
        self._fleet = fleet
        self._notifier = notifier
        self._logs = logs
        self._on_state = on_state
        self._state = InstanceState.STARTING
        self._qualities: list[Quality | None] = []
        self._qualities_ns = 0

    def look(self) -> list[Quality | None]:
        """Return the present quality of each source; None for a source without a frame."""
        qualities: list[Quality | None] = []
        for block in self._segment.blocks.values():
            try:
                frame = block.latest()
            except SegmentError:
                qualities.append(Quality.BAD)
            else:
                qualities.append(None if frame is None else block.assess(frame)[0])
        return qualities

    def publish(self, now_ns: int, *, started: bool, stopping: bool) -> None:
        """Publish the state of the instance. This is the supervisor's heartbeat too."""
        note = self._logs.problem(now_ns)
        state = self._assess(now_ns, note) if started and not stopping else InstanceState.STARTING
        if stopping:
            state = InstanceState.STOPPING
        self._segment.set_state(os.getpid(), state, note)
        self._notifier.beat(now_ns)
        if state is not self._state:
            if self._state is InstanceState.STARTING and state is not InstanceState.STOPPING:
                self._notifier.ready()
            self._state = state
            reasons = ", ".join([*self._weak(), *filter(None, [note])]) if state is InstanceState.DEGRADED else ""
            text = f"{state}: {reasons}" if reasons else str(state)
            log.info("instance %s", text)
            self._notifier.status(text)
            self._on_state(state)

    def _assess(self, now_ns: int, note: str) -> InstanceState:
        if now_ns - self._qualities_ns >= QUALITY_S * 1e9 or len(self._qualities) != len(self._segment.blocks):
            self._qualities, self._qualities_ns = self.look(), now_ns
            for managed in self._fleet:
                managed.listen()
        well = [m.life.state is State.RUNNING and not m.complaint for m in self._fleet]
        return assess(well, self._qualities, note)

    def _weak(self) -> list[str]:
        """Return the reasons why the instance is degraded."""
        weak = [f"{m.name} is not running" for m in self._fleet if m.life.state is not State.RUNNING]
        weak += [f"{m.name}: {m.complaint}" for m in self._fleet if m.complaint]
        named = zip(self._segment.blocks, self._qualities, strict=True)
        return weak + [f"source {name} is bad" for name, quality in named if quality in (None, Quality.BAD)]
