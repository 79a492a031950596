"""The state that all pages share: the instance, and its overview, which is computed once for all pages."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec

from shmio.endpoints.alerts.state_file import alert_states
from shmio.endpoints.turns import Turns
from shmio.endpoints.web.cells import Cells
from shmio.endpoints.web.clients import clients
from shmio.endpoints.web.configuration import ConfigurationFile
from shmio.endpoints.web.measurements import Measurements
from shmio.endpoints.web.recordings import Recordings
from shmio.endpoints.web.register_tree import Trees
from shmio.endpoints.web.signals import Feeds
from shmio.endpoints.web.supervisor import Supervisor
from shmio.endpoints.web.timeline import Timeline
from shmio.local.attach import Attachment
from shmio.local.status import SourceStatus, status_of
from shmio.segment import Segment

OVERVIEW_S: Final = 0.9
"""Time in s for which an overview is reused."""
MINUTES: Final = (1, 10, 30)
"""Lengths of the periods, in minutes, in which losses and recoveries of a source's data are counted."""
_TICKS: Final = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES: Final = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class _Usage:
    """CPU time of a process in s, the time at which it was read, and the process's memory in bytes."""

    cpu_s: float
    at_s: float
    memory_bytes: int


class Served:
    """The instance that the pages show. Use it in the event loop's thread only."""

    def __init__(
        self,
        segment: Segment,
        cell: Attachment,
        measurements: Measurements,
        folders: Mapping[str, str],
        config_file: str = "",
        recordings: str | None = None,
        scene: Mapping[str, Any] | None = None,
        fabric: Mapping[str, Any] | None = None,
    ) -> None:
        """Create the shared state.

        Args:
            segment: The instance's segment.
            cell: The instance as programs see it. It must be writable.
            measurements: The timing of the sources.
            folders: Directories in which the instance writes files, by purpose.
            config_file: Path of the configuration.
            recordings: The recorder's directory; None if no recorder is configured.
            scene: The cell in 3D, as shmio/plan/scene.py makes it; None if the configuration has none.
            fabric: How to connect to the fabric, as JSON values of its ``Access``; None if the configuration
                has none.

        """
        self.segment, self.cell, self.measurements, self.folders = segment, cell, measurements, folders
        self.config_file, self.scene = config_file, scene
        self.supervisor = Supervisor(segment)
        self.configuration = ConfigurationFile(config_file, self.supervisor)
        self.feeds = Feeds()
        """The signals that pages plot."""
        self.trees = Trees()
        """The trees of the registers."""
        self.timeline = Timeline(segment)
        """The newest events."""
        self.recordings = Recordings(recordings)
        self.cells = None if fabric is None else Cells(fabric, segment.instance)
        """The cells of the fabric; None without a fabric."""
        self.turns = Turns()
        """The turns of the clients whose pages make calls."""
        self.messages = self.bytes = 0
        """Numbers of messages and bytes that were sent to pages."""
        self._overview: dict[str, Any] = {}
        self._overview_s = -OVERVIEW_S
        self._usages: dict[int, _Usage] = {}

    def overview(self) -> dict[str, Any]:
        """Return the status of the instance, its processes and its sources. It is at most a second old."""
        now_s = time.monotonic()
        if now_s - self._overview_s >= OVERVIEW_S:
            self._overview, self._overview_s = self._read(now_s), now_s
        return self._overview

    def _read(self, now_s: float) -> dict[str, Any]:
        self.segment.refresh()
        status = status_of(self.segment, "shmio-supervisor up takes them over, shmio-supervisor down stops them", "web")
        usages: dict[int, _Usage] = {}
        processes = []
        for process in status.processes:
            row = msgspec.structs.asdict(process) | {"cpu_percent": None, "memory_bytes": None}
            if process.pid is not None and (usage := _usage(process.pid)) is not None:
                usages[process.pid] = usage
                row["memory_bytes"] = usage.memory_bytes
                before = self._usages.get(process.pid)
                if before is not None and usage.at_s > before.at_s:
                    row["cpu_percent"] = round(100 * (usage.cpu_s - before.cpu_s) / (usage.at_s - before.at_s), 1)
            if isinstance(process, SourceStatus):
                row |= self._source(process.name, now_s)
            processes.append(row)
        self._usages = usages
        return msgspec.structs.asdict(status) | {
            "processes": processes,
            "clients": clients({one.name: (one.kind, one.pid) for one in status.processes if one.pid is not None}),
            "alerts": [
                {"name": name, "severity": alert.severity, "text": alert.text, "reason": alert.reason}
                | {"active_s": round(status.clock.time_s - alert.progress.since_ns / 1e9) if status.clock else 0}
                for name, alert in alert_states(self.folders, self.segment).items()
                if alert.progress.active
            ],
            "clock": status.clock and msgspec.structs.asdict(status.clock),
            "supervisor": status.supervisor and msgspec.structs.asdict(status.supervisor),
        }

    def _source(self, name: str, now_s: float) -> dict[str, Any]:
        block = self.segment.blocks[name]
        frame = block.latest()
        timing = next((one for one in self.measurements if one.block.source == name), None)
        changes = [] if timing is None else list(timing.connections)
        return {
            "period_ms": block.period_ns / 1e6,
            "registers": len(block.layout.registers),
            "age_s": None if frame is None else round(frame.age_ns(block.now_ns()) / 1e9, 3),
            "round_trip_ms": None if frame is None else frame.delay_us / 1000,
            "lost": [_count(changes, now_s - 60 * minutes, bad=True) for minutes in MINUTES],
            "recovered": [_count(changes, now_s - 60 * minutes, bad=False) for minutes in MINUTES],
        }


def _count(changes: list[tuple[float, bool]], since_s: float, *, bad: bool) -> int:
    return sum(at_s >= since_s and became_bad == bad for at_s, became_bad in changes)


def _usage(pid: int) -> _Usage | None:
    """Read the CPU time and the memory of a process, proc(5); None if the process has ended."""
    with suppress(OSError, ValueError, IndexError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return _Usage((int(fields[11]) + int(fields[12])) / _TICKS, time.monotonic(), int(fields[21]) * _PAGE_BYTES)
    return None
