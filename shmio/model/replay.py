"""The status of a source that replays a recording, and the changes that a program may request."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypedDict

import msgspec


class ReplayStatus(msgspec.Struct, frozen=True):
    """Status of one source that replays a recording.

    Unless the replay is paused, its position moves ``speed`` times as fast as the instance's clock.

    Attributes:
        source: Name of the source.
        time_s: UTC of the position, in s since 1970.
        position_s: The position, in s from the start of the played range.
        length_s: Length of the played range, in s.
        speed: Speed relative to the instance's clock.
        paused: True while the replay is paused.
        loop: True if the replay starts again at the end.
        over: True if the replay has reached the end.
        until_s: The position at which the replay will pause, in s; None: it plays to the end.
    """

    source: str
    time_s: float
    position_s: float
    length_s: float
    speed: float
    paused: bool
    loop: bool
    over: bool
    until_s: float | None = None


class ReplayChanges(TypedDict, total=False):
    """Requested changes of replays. A missing key requests no change.

    Give a time in seconds from the start of the played range, or as text: a date and time.
    """

    paused: bool
    """True to pause, False to resume."""
    speed: float
    """Speed relative to the instance's clock, 0.01 to 1000."""
    loop: bool
    """True to start again at the end."""
    seek: float | str
    """Time to which to move the position."""
    until: float | str
    """Time at which to pause once."""
    change: str
    """Path of a register: play to its next change, and pause there."""
    event: str
    """Kind of event: play to the next event of this kind, and pause there."""
    jump: bool
    """With ``change`` or ``event``: go there at once instead of playing."""
    sources: Iterable[str]
    """Names of sources: change only their replays, and those of other sources with the same recording."""
