"""Damaged places of a recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from shmio.recording.format.records import Record


class Damage(NamedTuple):
    """Bytes ``first`` to ``last`` of a file, which cannot be read, or only in part.

    ``after_ns``, ``before_ns``: log times of the readable entries before and after them; 0: none.
    """

    first: int
    last: int
    why: str
    after_ns: int
    before_ns: int


class DamageLog:
    """Collects damage while a file is read from front to back. Between two intact chunks it is reported as one.

    Use: :meth:`end` before a chunk that can be read, :meth:`after` behind it, :meth:`end` at the end.
    """

    def __init__(self, tell: Callable[[Damage], object]) -> None:
        self._tell = tell
        self._after_ns = 0
        self._found: Damage | None = None

    def add(self, record: Record, why: object) -> None:
        """Add a record that cannot be read completely."""
        first, last = record.at, record.at + record.size - 1
        if self._found is None:
            self._found = Damage(first, last, str(why), self._after_ns, 0)
        else:
            self._found = self._found._replace(last=last)

    def after(self, last_ns: int) -> None:
        """Note that a chunk was read, up to this log time."""
        self._after_ns = last_ns

    def end(self, before_ns: int = 0) -> None:
        """Report pending damage. ``before_ns``: log time of the entry behind it; 0: there is none."""
        if self._found is not None:
            self._tell(self._found._replace(before_ns=before_ns))
            self._found = None
