"""Moving replays: what a client may wish, and how they play. No I/O."""

from __future__ import annotations

from typing import Any, Final

from shmio.model.replay import Playing, Wish
from shmio.wire import shmio_v1_pb2 as wire

SEARCH_PATIENCE_S: Final = 600.0
"""So long a recording may be searched."""


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
