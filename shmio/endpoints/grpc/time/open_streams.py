"""Counts the streams that steps are delivered to: only if there are any, steps wait for us."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class OpenStreams:
    """Number of the open streams of all services; for the event loop's thread."""

    def __init__(self) -> None:
        self.changed: Callable[[], object] = lambda: None
        """Called when the first stream opens, before it gets values, and when the last closes."""
        self._count = 0

    def __bool__(self) -> bool:
        return self._count > 0

    @contextmanager
    def joined(self) -> Iterator[None]:
        """Count a stream for as long as it is open."""
        self._count += 1
        if self._count == 1:
            self.changed()
        try:
            yield
        finally:
            self._count -= 1
            if not self._count:
                self.changed()
