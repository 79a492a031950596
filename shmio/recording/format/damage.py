"""What of a recording cannot be read: from where to where, and what was recorded before and after it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from shmio.recording.format.records import Record


class Damage(NamedTuple):
    """Bytes ``first`` to ``last`` of a file, which are lost, or some of what is in them.

    ``after_ns``, ``before_ns``: log times of what is there before and after it; 0: nothing.
    """

    first: int
    last: int
    why: str
    after_ns: int
    before_ns: int


class DamageLog:
    """Collects damage on a walk from front to back. What lies between two whole chunks is told as one.

    Use: :meth:`end` before a chunk that can be read, :meth:`after` behind it, :meth:`end` at the end.
    """

    def __init__(self, tell: Callable[[Damage], object]) -> None:
        self._tell = tell
        self._after_ns = 0
        self._found: Damage | None = None

    def add(self, record: Record, why: object) -> None:
        """A record that cannot be read as a whole."""
        first, last = record.at, record.at + record.size - 1
        if self._found is None:
            self._found = Damage(first, last, str(why), self._after_ns, 0)
        else:
            self._found = self._found._replace(last=last)

    def after(self, last_ns: int) -> None:
        """It was read, up to this log time."""
        self._after_ns = last_ns

    def end(self, before_ns: int = 0) -> None:
        """Tell what is still to be told: nothing comes after it, or something of this log time."""
        if self._found is not None:
            self._tell(self._found._replace(before_ns=before_ns))
            self._found = None
