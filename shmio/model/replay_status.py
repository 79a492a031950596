"""Status of a source that replays a recording, for local programs and clients alike."""

from __future__ import annotations

from dataclasses import dataclass


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
