"""What DDS discovers in a domain: the publishers and subscribers of topics, with their types and QoS."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator
from typing import Any, Final, NamedTuple

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import DDSException
from cyclonedds.qos import Policy, Qos

from shmio.connectors.ros.qos import TopicQos

INFINITE_NS: Final = (1 << 63) - 1
POLICIES: Final = {
    2: "durability", 3: "presentation", 4: "deadline", 5: "latency budget", 6: "ownership", 8: "liveliness",
    10: "partition", 11: "reliability", 12: "destination order", 23: "data representation", 24: "type consistency",
}  # fmt: skip
"""The names of policies by their numbers in DDS."""
_DURABILITIES: Final = ("Volatile", "TransientLocal", "Transient", "Persistent")
_LIVELINESS: Final = ("Automatic", "ManualByParticipant", "ManualByTopic")

log = logging.getLogger("shmio.source")


class Endpoint(NamedTuple):
    """A publisher or subscriber of another participant."""

    topic: str
    """The DDS name of the topic."""
    type: str
    """The DDS name of the type."""
    qos: Qos


class Discovery:
    """The publishers and subscribers that other participants have in the domain."""

    def __init__(self) -> None:
        self._readers: list[Any] = []
        self._found: list[dict[Any, Endpoint]] = [{}, {}]
        self._topics: Collection[str] | None = None
        self._limit = 0
        self.full = False
        """True if there are more publishers or subscribers than the limit."""

    def begin(self, participant: Any, topics: Collection[str] | None, limit: int) -> None:
        """Start the discovery, or start it anew.

        Args:
            participant: The participant of the library.
            topics: The DDS names of the topics that matter; None: all topics.
            limit: Maximum number of publishers, and of subscribers, to remember.

        """
        self.close()
        self._topics, self._limit, self._own = topics, limit, participant.guid
        self._readers = [
            BuiltinDataReader(participant, kind) for kind in (BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription)
        ]

    def close(self) -> None:
        """End the discovery, and forget everything."""
        for reader in self._readers:
            reader.__del__()
        self._readers, self._found, self.full = [], [{}, {}], False

    def update(self, most: int) -> list[str]:
        """Process changes of publishers and of subscribers, at most ``most`` of each. A change takes about 0.2 ms.

        Returns:
            The DDS names of the topics with changes.

        """
        topics: list[str] = []
        for reader, found in zip(self._readers, self._found, strict=True):
            try:
                changes = reader.take(most)
            except DDSException:
                continue
            except Exception as error:  # noqa: BLE001  decoding of a peer's bytes may fail in any way
                log.warning("shmio cannot decode what a node says about its topics: %s", type(error).__name__)
                continue
            topics += [name for name in (self._note(one, found) for one in changes) if name]
        return topics

    def _note(self, one: Any, found: dict[Any, Endpoint]) -> str:
        if one.topic_name is None:  # the publisher or subscriber has left
            gone = found.pop(one.key, None)
            return gone.topic if gone is not None else ""
        if one.participant_key == self._own or (self._topics is not None and one.topic_name not in self._topics):
            return ""
        if len(found) >= self._limit and one.key not in found:
            self.full = True
            return ""
        found[one.key] = Endpoint(one.topic_name, one.type_name, one.qos)
        return str(one.topic_name)

    def publishers(self, topic: str | None = None) -> list[Endpoint]:
        """Return the publishers of a topic (None: of all topics) that are known so far."""
        return [one for one in self._found[0].values() if topic in (None, one.topic)]

    def subscribers(self, topic: str | None = None) -> list[Endpoint]:
        """Return the subscribers of a topic (None: of all topics) that are known so far."""
        return [one for one in self._found[1].values() if topic in (None, one.topic)]


def reader_qos(qos: TopicQos) -> Qos:
    """Return what a topic's reader requests.

    The reader keeps only the newest message, because a register shows no other.
    """
    return Qos(
        Policy.Reliability.Reliable(0) if qos.reliability == "reliable" else Policy.Reliability.BestEffort,
        _durability(qos), Policy.History.KeepLast(1), Policy.IgnoreLocal.Participant, _liveliness(qos),
        Policy.Deadline(_ns(qos.deadline_ms)),
    )  # fmt: skip


def writer_qos(qos: TopicQos, blocking_ns: int) -> Qos:
    """Return what a topic's writer offers.

    ``blocking_ns`` is the maximum time in ns for which a write waits for room in the writer's
    queue.
    """
    history = Policy.History.KeepAll if qos.history == "keep_all" else Policy.History.KeepLast(qos.depth)
    return Qos(
        Policy.Reliability.Reliable(blocking_ns), _durability(qos), Policy.IgnoreLocal.Participant, _liveliness(qos),
        history, Policy.DurabilityService(0, history, -1, -1, -1), Policy.Lifespan(_ns(qos.lifespan_ms)),
    )  # fmt: skip


def _durability(qos: TopicQos) -> Any:
    return Policy.Durability.TransientLocal if qos.durability == "transient_local" else Policy.Durability.Volatile


def _liveliness(qos: TopicQos) -> Any:
    kind = Policy.Liveliness.ManualByTopic if qos.liveliness == "manual_by_topic" else Policy.Liveliness.Automatic
    return kind(_ns(qos.lease_ms))


def _ns(ms: int) -> int:
    return ms * 1_000_000 if ms else INFINITE_NS


def stores(qos: Qos) -> bool:
    """Return whether a publisher with a QoS stores its messages for late subscribers, and sends them reliably."""
    return _DURABILITIES.index(_name(qos[Policy.Durability])) > 0 and isinstance(
        qos[Policy.Reliability], Policy.Reliability.Reliable
    )


def unmet(offered: Qos, requested: Qos) -> Iterator[tuple[str, str, str]]:
    """Yield each policy in which a publisher's offer does not satisfy a subscriber's request.

    Yields:
        The policy's name, what is offered, and what is requested.

    """
    has, wants = offered[Policy.Reliability], requested[Policy.Reliability]
    if isinstance(wants, Policy.Reliability.Reliable) and not isinstance(has, Policy.Reliability.Reliable):
        yield "reliability", "best_effort", "reliable"
    has, wants = _name(offered[Policy.Durability]), _name(requested[Policy.Durability])
    if _DURABILITIES.index(has) < _DURABILITIES.index(wants):
        yield "durability", _plain(has), _plain(wants)
    has, wants = _deadline(offered), _deadline(requested)
    if has > wants:
        yield "deadline", _duration(has), _duration(wants)
    has, wants = offered[Policy.Liveliness], requested[Policy.Liveliness]
    if _LIVELINESS.index(_name(has)) < _LIVELINESS.index(_name(wants)):
        yield "liveliness", _plain(_name(has)), _plain(_name(wants))
    if has.lease_duration > wants.lease_duration:
        yield "lease", _duration(has.lease_duration), _duration(wants.lease_duration)


def _deadline(qos: Qos) -> int:
    return qos[Policy.Deadline].deadline if Policy.Deadline in qos else INFINITE_NS


def _name(policy: Any) -> str:
    return type(policy).__name__.rpartition(".")[2]


def _plain(name: str) -> str:
    return "".join(f"_{one.lower()}" if one.isupper() else one for one in name).lstrip("_")


def _duration(duration_ns: int) -> str:
    return "none" if duration_ns >= INFINITE_NS else f"{duration_ns / 1e6:g} ms"
