"""The keys that the sources ``rosbridge`` and ``ros2`` share."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec

REGISTER_OPTIONS: Final = frozenset({"max_age", "latched", "time"})
"""The keys of both connectors that determine how values are read, but not how to connect."""
_Topic = Annotated[str, msgspec.Meta(min_length=2, max_length=256)]


class TopicOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Keys that both ROS connectors share: time-outs, ages and time stamps."""

    timeout: Annotated[int, msgspec.Meta(ge=10, le=600_000)] = 4000
    """Time-out in ms for connecting, for each answer, and for the writes of a cycle."""
    max_age: Annotated[int, msgspec.Meta(ge=0, le=86_400_000)] = 1000
    """Age in ms above which a topic's last message is too old; 0: no message is ever too old."""
    latched: Annotated[list[_Topic], msgspec.Meta(max_length=10_000)] = msgspec.field(default_factory=list)
    """Topics whose last message stays valid for ever."""
    time: Literal["stamp", "receipt"] = "stamp"
    """The source time of values: the time stamp in the message's header, if there is one, or the time of receipt."""
