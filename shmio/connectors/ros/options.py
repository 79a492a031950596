"""The keys that the sources ``rosbridge`` and ``ros2`` share."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec

REGISTER_OPTIONS: Final = frozenset({"max_age", "latched", "time"})
"""The keys of both connectors that say how values are read, and not how to connect."""
_Topic = Annotated[str, msgspec.Meta(min_length=2, max_length=256)]


class TopicOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Keys that both ROS connectors share: time-outs, ages and time stamps."""

    timeout: Annotated[int, msgspec.Meta(ge=10, le=600_000)] = 4000
    """Time-out for connecting, for each answer, and for the writes of a cycle, in ms."""
    max_age: Annotated[int, msgspec.Meta(ge=0, le=86_400_000)] = 1000
    """Age in ms above which the last message of a topic is too old; 0 if it never is."""
    latched: Annotated[list[_Topic], msgspec.Meta(max_length=10_000)] = msgspec.field(default_factory=list)
    """Topics whose last message stays valid for ever."""
    time: Literal["stamp", "receipt"] = "stamp"
    """Which source time values get: the time stamp in a message's header, if it has one, or the time of receipt."""
