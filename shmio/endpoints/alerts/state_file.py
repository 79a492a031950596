"""The file with the state of the alerts. With it, a restart of their process repeats no notice.

The web page and the metrics for Prometheus read this file, too.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

from shmio.config import Alert
from shmio.endpoints.alerts.lifecycle import Progress
from shmio.endpoints.alerts.notice import Notice
from shmio.files import replace_file
from shmio.segment import Segment

FILE_NAME: Final = "alerts.json"
"""Name of the file, in the directory of the log files."""
MAX_BYTES: Final = 64 << 20

log = logging.getLogger("shmio.alerts")


class AlertState(msgspec.Struct):
    """The state of one alert. ``digest`` identifies what the alert watches; see :func:`digest`."""

    digest: str
    severity: str
    text: str
    reason: str
    progress: Progress


class Waiting(msgspec.Struct):
    """The notices that have not been delivered yet, for each kind of action."""

    command: list[Notice] = []
    mqtt: list[Notice] = []
    webhook: list[Notice] = []


class State(msgspec.Struct):
    """The state of all alerts of one run of the instance.

    Attributes:
        epoch: Identifies the run.
        alerts: The state of each alert, by name.
        waiting: The notices that have not been delivered yet.
    """

    epoch: int = 0
    alerts: dict[str, AlertState] = {}
    waiting: Waiting = msgspec.field(default_factory=Waiting)

    def progress(self, alerts: list[Alert]) -> dict[str, Progress]:
        """Return the saved progress of each alert, by name. Leave out alerts that now watch something else."""
        return {
            alert.title: self.alerts[alert.title].progress
            for alert in alerts
            if alert.title in self.alerts and self.alerts[alert.title].digest == digest(alert)
        }


_DECODER: Final = msgspec.json.Decoder(State)


def digest(alert: Alert) -> str:
    """Return a hash of what the alert watches. It shows whether the configuration has changed."""
    watched = alert.when, alert.processes, alert.states, alert.sources, alert.qualities
    return hashlib.sha256(msgspec.json.encode(watched)).hexdigest()[:16]


def read_state(file: Path, epoch: int) -> State:
    """Return the state in a file; an empty state if the file is missing, damaged, or from another run.

    Args:
        file: The file.
        epoch: Identifies the present run.
    """
    with suppress(OSError, msgspec.MsgspecError):
        with file.open("rb") as stream:
            state = _DECODER.decode(stream.read(MAX_BYTES))
        if state.epoch == epoch:
            return state
    return State(epoch)


class StateWriter:
    """Writes the newest state to the file, in a thread, because a disk may hang."""

    def __init__(self, file: Path) -> None:
        self.problem = ""
        """Why the last state could not be written; empty if it could."""
        self._file = file
        self._condition = threading.Condition()
        self._newest: bytes | None = None
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="alerts' state", daemon=True)
        self._thread.start()

    def write(self, state: State) -> None:
        """Make the thread write this state soon. If an earlier state is not written yet, this one replaces it."""
        data = msgspec.json.encode(state)
        with self._condition:
            self._newest = data
            self._condition.notify()

    def close(self, timeout_s: float) -> None:
        """Let the thread write the last state and end. Wait for it at most ``timeout_s``."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._newest is not None or self._stopping)
                data, self._newest = self._newest, None
            if data is None:
                return
            try:
                replace_file(self._file, data, private=True)
            except OSError as error:
                problem = f"{self._file}: {error.strerror}; after a restart of this process, notices may come again"
                if problem != self.problem:
                    log.warning("%s", problem)
                self.problem = problem
            else:
                self.problem = ""


def alert_states(folders: Mapping[str, str], segment: Segment) -> Mapping[str, AlertState]:
    """Return the state of all alerts, by name, as their process last saved it.

    The result is empty if the instance has no alerts, or their state cannot be read.

    Args:
        folders: The directories in which the instance writes files, by purpose.
        segment: The instance's segment.

    """
    if not any(slot.kind == "alerts" for slot in segment.processes):
        return {}
    return read_state(Path(folders["logs"]) / FILE_NAME, segment.header.epoch).alerts
