"""Whether any stream is open that steps are delivered to: only then a step has to wait for this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class OpenStreams:
    """The open streams, counted; for the event loop's thread."""

    def __init__(self) -> None:
        self.changed: Callable[[], object] = lambda: None
        """Called when the first comes, before it is given anything, and when the last is gone."""
        self._count = 0

    def __bool__(self) -> bool:
        return self._count > 0

    @contextmanager
    def joined(self) -> Iterator[None]:
        """One more, as long as it is open."""
        self._count += 1
        if self._count == 1:
            self.changed()
        try:
            yield
        finally:
            self._count -= 1
            if not self._count:
                self.changed()
