"""What of a recording cannot be read, told where the rest of the output has come to."""

from __future__ import annotations

import sys
from pathlib import Path

from shmio.cli.dumping.moments import lost
from shmio.dump.damage import Damage
from shmio.logs import printable


class Complaints:
    """Tells on standard error."""

    def __init__(self) -> None:
        self.any = False

    def damage(self, file: Path, damage: Damage) -> None:
        """A part of a file is lost."""
        self.say(f"{file}: {lost(damage)}")

    def say(self, text: str) -> None:
        """One line; the exit status will be 1."""
        self.any = True
        sys.stdout.flush()
        print(printable(text), file=sys.stderr, flush=True)
