"""Checks the recordings: compares every file with the truth once its recorder has closed it or was killed.

Checked files are removed, except the newest, from which a new recorder continues.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from shmio.recording.format.encoding import FRAME, Channel, Gap, ProcessChange, StepMark
from shmio.recording.reading.reader import Reader
from shmio.recording.reading.survey import survey
from shmio.segment import Event, Frame
from tests.faults.checker import Checker
from tests.faults.checks import Complain, Counts, FrameCheck, Source

LOOK_S: Final = 0.1
KEPT: Final = 3
"""Number of files that remain in addition to the one being written."""
START_NS: Final = 2 * 10**9
"""Maximum time from the creation of a file until its recorder first reads the rings."""
REMEMBERED_NS: Final = 600 * 10**9
"""Maximum age of frames that are compared with the truth, whose file has limited room."""


@dataclass
class BlockCheck:
    """Checks the recordings of one source, file after file."""

    source: Source
    ring_ns: int
    """Time for which the source's ring keeps a frame, in ns."""
    complain: Complain
    counts: Counts = field(default_factory=Counts)
    _block: tuple[str, int] | None = None
    """Epoch of the instance and section of the block, whose numbers continue across files."""
    _last: dict[str, int] = field(default_factory=dict)
    _missed: dict[str, int] = field(default_factory=dict)
    _publish_ns: int = 0
    _away_ns: int | None = None

    def __post_init__(self) -> None:
        self._frames = FrameCheck(self.source, self.complain, self.counts)

    def begin(self, epoch: str, started_ns: int, away_ns: int) -> None:
        """Begin a file. ``away_ns``: maximum time in ns, before the file, in which nothing was recorded."""
        self._away_ns = away_ns
        self._epoch, self._started_ns = epoch, started_ns

    def item(self, item: Frame | Event | Gap, section: int) -> None:
        """Check the next frame, event or gap of this source, of the block in this section."""
        if (self._epoch, section) != self._block:
            self._block = self._epoch, section
            self._last, self._missed = {}, {}
            self._frames.begin(self._started_ns)
        if isinstance(item, Gap):
            self._missed[item.what] = self._missed.get(item.what, 0) + item.count
        elif isinstance(item, Frame):
            self._frame(item)
        else:
            self._event(item)

    def _frame(self, frame: Frame) -> None:
        missed = self._missed.pop("frames", 0)
        if frame.event < self._last.get("events", 0):
            self._say(f"frame {frame.number}, of before event {frame.event + 1}, comes after a later event")
        away_ns, self._away_ns = self._away_ns, None
        lost_ns = frame.publish_ns - self._publish_ns
        if away_ns is not None and "frames" in self._last and missed and lost_ns > max(0, away_ns - self.ring_ns):
            self._say(
                f"{missed} frames in {lost_ns / 1e6:.0f} ms before frame {frame.number} are lost, but nothing was "
                f"recorded for at most {away_ns / 1e6:.0f} ms, and the ring holds {self.ring_ns / 1e6:.0f} ms"
            )
        if time.monotonic_ns() - frame.publish_ns < REMEMBERED_NS:
            self._frames.frame(frame, missed, frame.publish_ns)
        else:
            self._frames.begin(self._started_ns)
        self._last["frames"], self._publish_ns = frame.number, frame.publish_ns

    def _event(self, event: Event) -> None:
        missed = self._missed.pop("events", 0)
        last = self._last.get("events")
        if last is not None and event.number != last + 1 + missed:
            self._say(f"event {event.number} comes after event {last} with {missed} missed")
        if event.frame < self._last.get("frames", 0):
            self._say(f"event {event.number}, of after frame {event.frame}, comes after a later frame")
        self.counts.values += 1
        self._last["events"] = event.number

    def _say(self, problem: str) -> None:
        self.complain(f"recording of {self.source.name}: {problem}")


def check(file: Path, away_ns: int, checks: Mapping[str, BlockCheck]) -> None:
    """Read and check one file to its end. RecordingError: it is damaged."""

    def wanted(channel: Channel) -> bool:
        return not channel.source or channel.source in checks

    begun = False
    with Reader(file) as reader:
        survey(reader)  # a first gap comes before the description of its block
        for message in reader.messages(wanted):
            if not begun:
                begun = True
                for block in checks.values():
                    block.begin(reader.about["epoch"], int(reader.about["started_ns"]), away_ns)
            item, channel = message.item, message.channel
            if isinstance(item, StepMark | ProcessChange):
                continue
            if isinstance(item, Gap):
                channel = next(c for c in reader.channels.values() if c.encoding == FRAME and c.block == item.block)
            if channel.source in checks:
                checks[channel.source].item(item, channel.section)


class Watch:
    """Finds files, and passes them to ``check`` in the order in which they were written."""

    def __init__(self, folder: Path, check: Callable[[Path, int], None]) -> None:
        self._folder = folder
        self._check = check
        self._seen_ns: dict[Path, int] = {}
        self._checked: list[Path] = []

    def look(self, *, ended: bool, slack_ns: int) -> None:
        """Check the files that have ended: all but the newest; with ``ended``, all."""
        now_ns = time.time_ns()
        for file in self._folder.glob("*.mem"):
            self._seen_ns.setdefault(file, now_ns)  # not by name: faults set the clock of the names
        files = sorted(self._seen_ns, key=self._seen_ns.__getitem__)
        for file in files if ended else files[:-1]:
            if file not in self._checked and file.stat().st_size:  # empty: the recorder was killed before it wrote
                before_ns = self._checked[-1].stat().st_mtime_ns if self._checked else self._seen_ns[file]
                self._check(file, self._seen_ns[file] - before_ns + slack_ns)
                self._checked.append(file)
        for file in self._checked[:-KEPT]:
            file.unlink()
            self._checked.remove(file)
            del self._seen_ns[file]


def main() -> None:
    checker = Checker()
    rings = checker.description.rings_ns
    checks = {
        source.name: BlockCheck(source, rings[source.name], checker.complain, checker.counts(f"recorded {source.name}"))
        for source in checker.sources
    }
    watch = Watch(Path(checker.description.recordings), lambda file, away_ns: check(file, away_ns, checks))

    def work() -> None:
        while not checker.stopping.wait(LOOK_S):
            watch.look(ended=False, slack_ns=checker.slack_ns + round(START_NS * checker.slowness))
        watch.look(ended=True, slack_ns=checker.slack_ns + round(START_NS * checker.slowness))

    checker.work(work)
    checker.run()


if __name__ == "__main__":
    main()
