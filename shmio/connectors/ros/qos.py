"""The quality of service (QoS) of ROS 2 topics: the keys of the configuration, and what they mean for each topic."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, NamedTuple

import msgspec

Milliseconds = Annotated[int, msgspec.Meta(ge=1, le=86_400_000)]
Reliability = Literal["best_effort", "reliable"]
Durability = Literal["volatile", "transient_local"]


class QosKeys(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Keys for the QoS of all topics of a source, or of one topic. None means that a key was not given.

    Raises:
        ValueError: Some keys contradict each other.

    """

    profile: Literal["default", "sensor_data", "system_default", "services", "parameters"] | None = None
    """A profile of ROS 2. The other keys replace single policies of the profile."""
    reliability: Reliability | None = None
    """The reliability that readers request from publishers. Commands are always published reliably."""
    durability: Durability | None = None
    """Whether readers request stored messages from publishers, and whether commands are stored for late subscribers."""
    history: Literal["keep_last", "keep_all"] | None = None
    """Whether a publisher of commands may replace messages that subscribers have not received yet."""
    depth: Annotated[int, msgspec.Meta(ge=1, le=10_000)] | None = None
    """The number of messages that a publisher of commands keeps. A register always shows the newest message."""
    deadline_ms: Milliseconds | None = None
    """The longest time between two messages that readers accept."""
    liveliness: Literal["automatic", "manual_by_topic"] | None = None
    """How publishers must show that they are alive."""
    lease_ms: Milliseconds | None = None
    """A publisher that has not shown for this time that it is alive counts as lost."""
    lifespan_ms: Milliseconds | None = None
    """The age at which subscribers drop a command."""

    def __post_init__(self) -> None:
        if self.history == "keep_all" and self.depth is not None:
            raise ValueError("depth: history keep_all keeps all messages; remove depth, or use keep_last")

    def given(self) -> dict[str, Any]:
        """Return the keys that were given, with their values, and the keys of ``profile`` in its place."""
        keys = {name: getattr(self, name) for name in QosKeys.__struct_fields__}
        own = {name: value for name, value in keys.items() if value is not None and name != "profile"}
        if self.profile is None:
            return own
        profile = dict(PROFILES[self.profile])
        if "history" in own:
            profile.pop("depth", None)
        return profile | own


PROFILES: Final[Mapping[str, Mapping[str, object]]] = MappingProxyType({
    "default": {"reliability": "reliable", "durability": "volatile", "history": "keep_last", "depth": 10},
    "sensor_data": {"reliability": "best_effort", "durability": "volatile", "history": "keep_last", "depth": 5},
    "system_default": {"reliability": "best_effort", "durability": "volatile", "history": "keep_last", "depth": 1},
    "services": {"reliability": "reliable", "durability": "volatile", "history": "keep_last", "depth": 10},
    "parameters": {"reliability": "reliable", "durability": "volatile", "history": "keep_last", "depth": 1000},
})  # fmt: skip
"""The QoS profiles of rmw. ``system_default`` has the defaults of DDS, so readers request best_effort."""


class TopicQos(NamedTuple):
    """The QoS of one topic. Times are in ms; 0 stands for infinite."""

    reliability: Reliability = "best_effort"
    durability: Durability = "volatile"
    history: Literal["keep_last", "keep_all"] = "keep_last"
    depth: int = 10
    deadline_ms: int = 0
    liveliness: Literal["automatic", "manual_by_topic"] = "automatic"
    lease_ms: int = 0
    lifespan_ms: int = 0


def qos_of(source: QosKeys, topic: QosKeys | None, *, latched: bool, writable: bool) -> TopicQos:
    """Return the QoS of a topic.

    Args:
        source: The keys for all topics of the source.
        topic: The keys for this topic; None if there are none. They take precedence over those of
            the source.
        latched: Whether the option ``latched`` contains the topic.
        writable: Whether the source publishes on the topic.

    Raises:
        ValueError: A key contradicts another one, or does not apply to the topic.

    """
    own = topic.given() if topic is not None else {}
    stored = {"durability": "transient_local", "reliability": "reliable"} if latched else {}
    found = TopicQos(**{**source.given(), **stored, **own})
    if found.durability == "transient_local" and found.reliability == "best_effort":
        raise ValueError(
            "durability: publishers send stored messages only to reliable readers; set reliability to reliable"
        )
    if writable:
        if (found.durability, found.history) == ("transient_local", "keep_all"):
            raise ValueError("history: all commands would be stored for ever; use keep_last with a depth")
        if own.get("deadline_ms"):
            raise ValueError(
                "deadline_ms: this source writes the topic, and publishes only when there is a command; remove the key"
            )
        if own.get("liveliness") == "manual_by_topic":
            raise ValueError(
                "liveliness: this source writes the topic, and shmio offers only automatic; remove the key"
            )
        return found._replace(deadline_ms=0, liveliness="automatic")
    if own.get("lifespan_ms"):
        raise ValueError("lifespan_ms: publishers set the lifespan of what they send; to limit the age, use max_age")
    return found
