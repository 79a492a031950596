"""Assesses the state of the instance, and publishes it to the segment, the service manager and the log."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from shmio.audit import trail
from shmio.config.folder import unwritable
from shmio.errors import SegmentError
from shmio.local.status import assess
from shmio.segment import Quality, Segment
from shmio.segment import State as InstanceState
from shmio.supervisor.fleet import Fleet, log
from shmio.supervisor.policy import State
from shmio.supervisor.process import NOTIFY_VARIABLES

QUALITY_S: Final = 0.5
"""Interval in s at which the quality of the sources is checked after the start of the instance."""
LOOK_S: Final = 5.0
"""Interval in s at which the folder of the log files is checked."""
SILENT_S: Final = 15.0
"""Time in s after which a disk that does not answer counts as a problem."""

_SOCKET, _WATCHDOG_USEC, _WATCHDOG_PID = NOTIFY_VARIABLES


class LogFolder:
    """Checks whether the log folder is writable, in a thread, because a disk may not answer."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._looking: threading.Thread | None = None
        self._begun_ns: int | None = None
        self._found = ""

    def problem(self, now_ns: int) -> str:
        """Return the problem that the last check found; "" if none. Start another check if it is due."""
        waited_s = 0.0 if self._begun_ns is None else (now_ns - self._begun_ns) / 1e9
        if self._looking is not None and self._looking.is_alive():
            return f"log_dir: {self._folder}: the disk does not answer" if waited_s > SILENT_S else self._found
        if self._begun_ns is None or waited_s >= LOOK_S:
            self._begun_ns = now_ns
            self._looking = threading.Thread(target=self._check_folder, name="log folder", daemon=True)
            with suppress(RuntimeError):  # no thread can be started now: try again later
                self._looking.start()
        return self._found

    def _check_folder(self) -> None:
        obstacle = unwritable(self._folder)
        self._found = f"log_dir: {obstacle.reason}; log lines are lost until that is fixed" if obstacle else ""


class Notifier:
    """Sends notifications to the service manager, if ``$NOTIFY_SOCKET`` is set; see sd_notify(3).

    No method fails or blocks, with or without a service manager.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._path = _socket_address(environment.get(_SOCKET, ""))
        self._period_ns = _watchdog_ns(environment) // 2  # twice as often as required
        self._beat_ns = 0

    def ready(self) -> None:
        """Report that the start of the instance, or a reload, is complete."""
        self._send("READY=1")

    def reloading(self) -> None:
        """Report that a reload has begun."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """Report that the instance is stopping."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """Report a line of text, which the service manager shows to the user."""
        self._send("STATUS=" + text.replace("\n", " "))

    def beat(self, now_ns: int) -> None:
        """Notify the watchdog of the service manager, if a notification is due."""
        if self._period_ns and now_ns - self._beat_ns >= self._period_ns:
            self._beat_ns = now_ns
            self._send("WATCHDOG=1")

    def _send(self, *lines: str) -> None:
        if not self._path:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
            client.setblocking(False)
            client.sendto("\n".join(lines).encode(), self._path)


def _socket_address(name: str) -> str:
    """Return the address of the service manager's socket: a path, an abstract name (``@…``), or ""."""
    if name.startswith("@"):
        return "\0" + name[1:]
    return name if name.startswith("/") else ""


def _watchdog_ns(environment: Mapping[str, str]) -> int:
    """Return the watchdog period in ns; 0 if there is no watchdog, or it is for another process."""
    if environment.get(_WATCHDOG_PID, str(os.getpid())) != str(os.getpid()):
        return 0
    text = environment.get(_WATCHDOG_USEC, "")
    return int(text) * 1000 if text.isascii() and text.isdigit() else 0


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
        """Create the object, which calls ``on_state`` with each new state of the instance."""
        self._segment = segment
        self._fleet = fleet
        self._notifier = notifier
        self._logs = logs
        self._on_state = on_state
        self._state = InstanceState.STARTING
        self._qualities: list[Quality | None] = []
        self._qualities_ns = 0

    def qualities(self) -> list[Quality | None]:
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
        """Publish the state of the instance, and the supervisor's heartbeat.

        Args:
            now_ns: The present time, CLOCK_MONOTONIC.
            started: Whether the start of the instance is complete.
            stopping: Whether the instance is stopping.
        """
        note = self._logs.problem(now_ns) or trail.problem()
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
            log.info("the instance is %s", text)
            self._notifier.status(text)
            self._on_state(state)

    def _assess(self, now_ns: int, note: str) -> InstanceState:
        if now_ns - self._qualities_ns >= QUALITY_S * 1e9 or len(self._qualities) != len(self._segment.blocks):
            self._qualities, self._qualities_ns = self.qualities(), now_ns
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
