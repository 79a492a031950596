"""How a source plays its recording, as local programs and those on other hosts are told."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Playing:
    """One source. ``time_s``: UTC of the position; ``position_s``: from the begin of what is played.

    ``until_s``: where it is to pause; None: at the end. ``over``: it has come to that. ``paused`` or not, it moves only
    as the instance's clock does.
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
