"""The common part of the checking processes: their input, their output and their end.

A checker is ``python -m tests.faults.<module> DESCRIPTION``. It prints a JSON line for each
violation and, ten times a second, its counters. When its standard input ends, it prints the
counters again and ends.
"""

from __future__ import annotations

import json
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from tests.faults.checks import Counts, Source
from tests.faults.pulse import Pulse
from tests.faults.truth import Truth

NOTES: Final = ("landed", "guarded", "given", "chained")
"""Truths of a source in addition to that of its PLC's program; see :class:`Source`."""
TELL_S: Final = 0.1
SLACK_NS: Final = 1_000_000_000
"""Maximum delay until a checker sees a value, on a machine that is not overloaded."""
TRACED: Final = 4096
"""Maximum number of characters of a traceback in a violation."""


@dataclass(frozen=True)
class Description:
    """The input of a checker: the instance, its sources and its files."""

    instance: str
    grpc: str
    mqtt: str
    seed: int
    reader: str
    """Path of the compiled examples/reader.c."""
    recordings: str
    """Folder of the recordings."""
    rings_ns: Mapping[str, int]
    """Time for which each source's ring keeps a frame, in ns."""
    sources: tuple[Mapping[str, Any], ...]
    """Fields of each :class:`Source`, with file paths as ``truth`` and :data:`NOTES`."""

    def to_json(self) -> str:
        """Encode the description as a command-line argument."""
        return json.dumps(asdict(self))


def open_source(fields: Mapping[str, Any]) -> Source:
    """Create a source from its fields, and map its truths."""
    files = {name: Truth(Path(fields[name])) if fields[name] else None for name in ("truth", *NOTES)}
    return Source(**{**fields, **files})


class Checker:
    """A checking process: threads that check, and the main thread, which prints the counters."""

    def __init__(self) -> None:
        self.description = Description(**json.loads(sys.argv[1]))
        self.sources = [open_source(fields) for fields in self.description.sources]
        self.stopping = threading.Event()
        self._counts: dict[str, Counts] = {}
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._pulse = Pulse()

    def complain(self, problem: str) -> None:
        """Report a violation."""
        self._tell({"violation": problem, "at_ns": time.monotonic_ns()})

    def counts(self, name: str) -> Counts:
        """Return new counters, which are reported from now on."""
        counts = self._counts[name] = Counts()
        return counts

    def work(self, function: Callable[[], None]) -> None:
        """Run ``function`` in a thread. It must return when ``stopping`` is set."""

        def run() -> None:
            try:
                function()
            except Exception:  # noqa: BLE001 - any error is a violation
                self.complain(f"a checker failed: {traceback.format_exc()[-TRACED:]}")

        thread = threading.Thread(target=run)
        self._threads.append(thread)
        thread.start()

    @property
    def slack_ns(self) -> int:
        """Maximum delay in ns until this process sees a value; more on an overloaded machine."""
        return round(SLACK_NS * self.slowness) + 3 * self._pulse.held_up_ns

    @property
    def slowness(self) -> float:
        """Factor by which work takes longer than on an idle machine."""
        return self._pulse.slowness

    def _beat(self) -> None:
        while not self.stopping.is_set():
            self._pulse.beat()

    def run(self) -> None:
        """Report the counters until standard input ends."""
        threading.Thread(target=self._await_end, daemon=True).start()
        threading.Thread(target=self._beat, daemon=True).start()
        while not self.stopping.wait(TELL_S):
            self._tell({"counts": {name: asdict(counts) for name, counts in self._counts.items()}})
        for thread in self._threads:
            thread.join()
        self._tell({"counts": {name: asdict(counts) for name, counts in self._counts.items()}})

    def _await_end(self) -> None:
        sys.stdin.read()
        self.stopping.set()

    def _tell(self, message: object) -> None:
        with self._lock:
            print(json.dumps(message), flush=True)
