"""Moving replays: what a client may wish, and how they play. No I/O."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, TypedDict

from shmio.model.replay_status import Playing
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


def request(wish: Wish) -> Any:
    """For Replay; times go as text."""
    keys: dict[str, Any] = {**wish}
    for key in {"seek", "until"} & keys.keys():
        keys[key] = str(keys[key])
    return wire.ReplayRequest(**keys)


def told(found: Any) -> list[Playing]:
    """From a ReplayResponse."""
    return [
        Playing(
            one.source, one.time_s, one.position_s, one.length_s, one.speed, one.paused, one.loop, one.over,
            one.until_s if one.HasField("until_s") else None,
        )
        for one in found.sources
    ]  # fmt: skip


def patience_s(wish: Wish) -> float | None:
    """How long it may take; None: as any call."""
    return SEARCH_PATIENCE_S if "change" in wish or "event" in wish else None
