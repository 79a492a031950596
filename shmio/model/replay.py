"""Status of a source that replays a recording, and what a program may change in it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypedDict


@dataclass(frozen=True, slots=True)
class Playing:
    """Status of one source that replays a recording.

    Unless it is paused, the position moves as the instance's clock does.

    Attributes:
        source: Name of the source.
        time_s: UTC of the position, in s.
        position_s: The position, in s from the start of the played range.
        length_s: Length of the played range, in s.
        speed: Speed relative to the instance's clock.
        paused: Whether the replay is paused.
        loop: Whether it starts again at the end.
        over: Whether it has reached the end.
        until_s: The position at which it will pause, in s; None: at the end.
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


class Wish(TypedDict, total=False):
    """What is to change in a replay. A time is seconds from the start of the played range, or a date and time."""

    paused: bool
    """Whether to pause."""
    speed: float
    """Speed relative to the instance's clock, 0.01 to 1000."""
    loop: bool
    """Whether to start again at the end."""
    seek: float | str
    """Time to go to."""
    until: float | str
    """Time at which to pause once."""
    change: str
    """Path of a register: play to its next change, and pause there."""
    event: str
    """Kind of event: play to the next one, and pause there."""
    jump: bool
    """With ``change`` or ``event``: go there at once instead of playing."""
    sources: Iterable[str]
    """Only these sources, and others that replay the same recording."""
