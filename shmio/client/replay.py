"""Requests that control replays, and their answers. No I/O."""

from __future__ import annotations

from typing import Any, Final

from shmio.model.replay import Playing, Wish
from shmio.wire import shmio_v1_pb2 as wire

SEARCH_PATIENCE_S: Final = 600.0
"""So long a recording may be searched."""


def request(wish: Wish) -> Any:
    """Return the request for Replay; times are sent as text."""
    keys: dict[str, Any] = {**wish}
    for key in {"seek", "until"} & keys.keys():
        keys[key] = str(keys[key])
    return wire.ReplayRequest(**keys)


def told(found: Any) -> list[Playing]:
    """Convert the answer to Replay."""
    return [
        Playing(
            one.source, one.time_s, one.position_s, one.length_s, one.speed, one.paused, one.loop, one.over,
            one.until_s if one.HasField("until_s") else None,
        )
        for one in found.sources
    ]  # fmt: skip


def patience_s(wish: Wish) -> float | None:
    """Return the time limit for a request in s; None for that of any call."""
    return SEARCH_PATIENCE_S if "change" in wish or "event" in wish else None
