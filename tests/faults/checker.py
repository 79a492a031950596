"""What the checking processes share: their description, what they tell, how they end.

A checker is ``python -m tests.faults.<module> DESCRIPTION``. It prints a JSON line for each violation and, ten times a
second, what it has counted; it ends, with a last count, when its standard input does.
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
"""The truths of a source beside that of what its PLC's program did; see :class:`Source`."""
TELL_S: Final = 0.1
SLACK_NS: Final = 1_000_000_000
"""How much later than it was sent something may come to a checker's notice on a machine that is not overloaded."""
TRACED: Final = 4096
"""Characters of a traceback that are told."""


@dataclass(frozen=True)
class Description:
    """What a checker is to look at."""

    instance: str
    grpc: str
    mqtt: str
    seed: int
    reader: str
    """The program of examples/reader.c, compiled."""
    recordings: str
    """The recorder's folder."""
    rings_ns: Mapping[str, int]
    """For how long each source's ring holds a frame."""
    sources: tuple[Mapping[str, Any], ...]
    """The fields of :class:`Source`, with paths of files for ``truth`` and the :data:`NOTES`."""

    def to_json(self) -> str:
        """As an argument of a command line."""
        return json.dumps(asdict(self))


def open_source(fields: Mapping[str, Any]) -> Source:
    """A source whose truth is mapped."""
    files = {name: Truth(Path(fields[name])) if fields[name] else None for name in ("truth", *NOTES)}
    return Source(**{**fields, **files})


class Checker:
    """A checking process: threads that work, and the one that tells."""

    def __init__(self) -> None:
        self.description = Description(**json.loads(sys.argv[1]))
        self.sources = [open_source(fields) for fields in self.description.sources]
        self.stopping = threading.Event()
        self._counts: dict[str, Counts] = {}
        self._turn = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._pulse = Pulse()

    def complain(self, problem: str) -> None:
        """Tell a violation."""
        self._tell({"violation": problem, "at_ns": time.monotonic_ns()})

    def counts(self, name: str) -> Counts:
        """New counts that are told from now on."""
        counts = self._counts[name] = Counts()
        return counts

    def work(self, function: Callable[[], None]) -> None:
        """Run ``function`` in a thread; it returns when ``stopping`` is set."""

        def run() -> None:
            try:
                function()
            except Exception:  # noqa: BLE001 - whatever it is, it is a finding
                self.complain(f"a checker failed: {traceback.format_exc()[-TRACED:]}")

        thread = threading.Thread(target=run)
        self._threads.append(thread)
        thread.start()

    @property
    def slack_ns(self) -> int:
        """How late something may come to our notice: more, when the machine has lately kept us waiting."""
        return round(SLACK_NS * self.slowness) + 3 * self._pulse.held_up_ns

    @property
    def slowness(self) -> float:
        """How many times longer than on an idle machine a process that has much to do takes for it."""
        return self._pulse.slowness

    def _beat(self) -> None:
        while not self.stopping.is_set():
            self._pulse.beat()

    def run(self) -> None:
        """Tell until standard input ends."""
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
        with self._turn:
            print(json.dumps(message), flush=True)
