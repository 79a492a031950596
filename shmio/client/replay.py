"""Moving replays: what a client may wish, and how they play. No I/O."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, TypedDict

from shmio.wire import shmio_v1_pb2 as wire

SEARCH_PATIENCE_S: Final = 600.0
"""So long a recording may be searched."""


class Wish(TypedDict, total=False):
    """What is to change. A time is seconds from the begin of what is played, or a date and time."""

    paused: bool
    speed: float
    """Times as fast as the instance's clock, 0.01 to 1000."""
    loop: bool
    """Begin anew at the end."""
    seek: float | str
    """Be at a time."""
    until: float | str
    """Pause at a time, once."""
    change: str
    """Play to the next change of this register, and pause there."""
    event: str
    """The same with the next event of this kind."""
    jump: bool
    """With these, be there at once."""
    sources: Iterable[str]
    """Only these, and what else plays the same recording."""


@dataclass(frozen=True, slots=True)
class Playing:
    """How a source plays its recording. ``time_s``: UTC of the position; ``position_s``: from the begin of what plays.

    ``until_s``: where it is to pause; None: at the end. ``over``: it has come to that.
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

    @classmethod
    def of(cls, found: Any) -> Playing:
        """From the wire."""
        return cls(
            found.source, found.time_s, found.position_s, found.length_s, found.speed, found.paused, found.loop,
            found.over, found.until_s if found.HasField("until_s") else None,
        )  # fmt: skip


def request(wish: Wish) -> Any:
    """For Replay; times go as text."""
    keys: dict[str, Any] = {**wish}
    for key in {"seek", "until"} & keys.keys():
        keys[key] = str(keys[key])
    return wire.ReplayRequest(**keys)


def patience_s(wish: Wish) -> float | None:
    """How long it may take; None: as any call."""
    return SEARCH_PATIENCE_S if "change" in wish or "event" in wish else None
