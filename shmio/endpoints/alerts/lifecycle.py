"""Decides when an alert becomes active, when it ends, and which of these changes to announce by a notice.

This module does no I/O and reads no clock.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import msgspec


class Change(StrEnum):
    """The change of an alert that a notice announces."""

    ACTIVE = "active"
    RESOLVED = "resolved"


class Progress(msgspec.Struct):
    """The part of an alert's state that must survive a restart of the process. Times are in ns of instance time."""

    active: bool = False
    since_ns: int = 0
    """When the alert last became active."""
    announced: bool = False
    """True if a notice has announced the present activation."""
    notice_ns: int | None = None
    """When the last notice of an activation was made; None if there was none."""
    suppressed: int = 0
    """Number of activations without a notice of their own since :attr:`notice_ns`."""
    notices: int = 0
    """Number of notices so far: of activations and of ends."""


@dataclass(slots=True)
class Lifecycle:
    """The state of one alert.

    An alert becomes active once its condition has been true for ``for_ns``, and ends when its
    condition is false. An unknown condition (None) changes nothing, but restarts ``for_ns``. Two
    notices of activations are at least ``every_ns`` apart. An activation that comes sooner is
    announced at the end of this interval, if the alert is still active then. Otherwise it only
    counts as suppressed.
    """

    for_ns: int
    every_ns: int
    resolved: bool
    """True if the end of an announced activation gets a notice, too."""
    progress: Progress
    held_ns: int | None = None
    """Instance time since which the condition has been true, in ns.

    None if the condition is not true, or if the alert is active already.
    """

    def observe(self, holds: bool | None, now_ns: int) -> Iterator[Change]:
        """Process the present value of the condition, and yield the changes to announce.

        Args:
            holds: Whether the condition is true; None if that is unknown.
            now_ns: The present instance time, in ns.

        """
        yield from self.advance(now_ns)
        progress = self.progress
        if holds:
            if not progress.active and self.held_ns is None:
                self.held_ns = now_ns
                yield from self.advance(now_ns)
            return
        self.held_ns = None
        if holds is None or not progress.active:
            return
        progress.active = False
        if not progress.announced:
            progress.suppressed += 1
        elif self.resolved:
            progress.notices += 1
            yield Change.RESOLVED
        progress.announced = False

    def advance(self, now_ns: int) -> Iterator[Change]:
        """Process the time that has passed, and yield the changes to announce.

        Args:
            now_ns: The present instance time, in ns.
        """
        progress = self.progress
        if self.held_ns is not None and now_ns >= self.held_ns + self.for_ns:
            self.held_ns, progress.active, progress.since_ns = None, True, now_ns
        if progress.active and not progress.announced and not self._too_soon(now_ns):
            progress.announced, progress.notice_ns = True, now_ns
            progress.notices += 1
            yield Change.ACTIVE
            progress.suppressed = 0  # after the notice, which reports the number

    @property
    def due_ns(self) -> int | None:
        """Instance time at which to call :meth:`advance` next, in ns; None if no call is needed."""
        progress = self.progress
        if self.held_ns is not None:
            return self.held_ns + self.for_ns
        if progress.active and not progress.announced and progress.notice_ns is not None:
            return progress.notice_ns + self.every_ns
        return None

    def _too_soon(self, now_ns: int) -> bool:
        last_ns = self.progress.notice_ns
        return last_ns is not None and 0 <= now_ns - last_ns < self.every_ns  # a replay may set the clock back
