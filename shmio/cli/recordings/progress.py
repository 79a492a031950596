"""Show the progress of long work on a terminal."""

from __future__ import annotations

import sys
import time
from contextlib import suppress

from shmio.logs import printable

FIRST_S = 1.0
EACH_S = 0.2
"""Work that is done sooner says nothing; then so often."""


class Progress:
    """Progress line on standard error, if that is a terminal; removed at the end.

    Use it as a context manager.
    """

    def __init__(self, what: str, *, silent: bool = False) -> None:
        """Begin; ``silent`` shows nothing, because the terminal has other output."""
        self.total = 0
        """How much there is to do: bytes, or ns of a recording."""
        self._what = what
        self._shown = False
        self._next_s = time.monotonic() + FIRST_S if sys.stderr.isatty() and not silent else float("inf")

    def at(self, done: int) -> None:
        """Show how much is done."""
        if time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + EACH_S
            share = f"{min(done / self.total, 1):4.0%}" if self.total else ""
            self._show(f"\r{printable(self._what)} {share}\x1b[K")
            self._shown = True

    def _show(self, text: str) -> None:
        with suppress(OSError):
            sys.stderr.write(text)
            sys.stderr.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            self._show("\r\x1b[K")
