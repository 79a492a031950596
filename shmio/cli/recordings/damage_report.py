"""Report damaged parts of a recording between the lines of the output."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from shmio.logs import printable
from shmio.recording.dump import Dump, open_dump
from shmio.recording.format.damage import Damage
from shmio.recording.times import lost


class DamageReport:
    """Reports damage on standard error."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    @property
    def any(self) -> bool:
        """Whether anything was reported."""
        return bool(self.texts)

    def open(self, files: Sequence[Path]) -> Dump:
        """Open a recording and report its damage; OSError, RecordingError as ``open_dump``."""
        dump = open_dump(files, self.damage)
        for text in dump.damage:
            self.say(text)
        return dump

    def damage(self, file: Path, damage: Damage) -> None:
        """Report that a part of a file is lost."""
        self.say(f"{file}: {lost(damage)}")

    def say(self, text: str) -> None:
        """Print a line; the exit status will be 1."""
        self.texts.append(text)
        sys.stdout.flush()
        print(printable(text), file=sys.stderr, flush=True)
