"""A participant in a DDS domain, with a reader for each topic and a writer for each command topic."""

from __future__ import annotations

import logging
import os
import socket
import stat
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException, DDSStatus, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic

from shmio.connectors.ros.dds_types import (
    dds_topic,
    dds_type,
    ros_topic,
    ros_type,
    sample_type,
    to_sample,
)
from shmio.connectors.ros.discovery import POLICIES, Discovery, reader_qos, unmet, writer_qos
from shmio.connectors.ros.messages import plain
from shmio.connectors.ros.topics import Topic
from shmio.errors import ConnectorError

MAX_PARTICIPANTS: Final = 60
"""Maximum number of participants on a host that can be found without multicast."""
MAX_ENDPOINTS: Final = 10_000
"""Maximum number of publishers, and of subscribers, that are remembered for messages to the user."""
_KEYS: Final = {"deadline": "deadline_ms", "lease": "lease_ms"}
"""The configuration keys of those policies whose keys have other names."""
_COMPARED: Final = frozenset({2, 4, 8, 11})
"""The numbers of the policies that ``unmet`` compares."""
_MATCHING: Final = DDSStatus.SubscriptionMatched | DDSStatus.LivelinessChanged
"""The changes of a reader that change which publishers it has."""
_HEARTBEAT: Final = '<HeartbeatInterval min="2 ms" minsched="2 ms" max="1 s">5 ms</HeartbeatInterval>'
"""Makes writers ask for acknowledgements at short intervals, because the poll loop waits for them."""

log = logging.getLogger("shmio.source")


def configuration(domain: int, interface: str, peers: Iterable[str], max_message_bytes: int) -> str:
    """Return the configuration of Cyclone DDS for one domain."""
    loopback = interface == "lo"
    addresses = ["127.0.0.1"] if loopback else list(peers)
    given = "".join(f"<Peer address={quoteattr(address)}/>" for address in addresses)
    multicast = "<AllowMulticast>false</AllowMulticast>" if loopback else ""
    return (
        f'<CycloneDDS><Domain Id="{domain}"><General><Interfaces><NetworkInterface name={quoteattr(interface)}/>'
        f"</Interfaces>{multicast}</General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{MAX_PARTICIPANTS}</MaxAutoParticipantIndex><Peers>{given}</Peers></Discovery>"
        f"<Internal><MaxSampleSize>{max_message_bytes} B</MaxSampleSize>"
        f"{_HEARTBEAT}</Internal></Domain></CycloneDDS>"
    )


def _sockets() -> Iterator[int]:
    """Yield the descriptors of this process's sockets."""
    for path in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            if stat.S_ISSOCK(os.fstat(int(path.name)).st_mode):
                yield int(path.name)


def _keep_to_loopback(before: set[int]) -> None:
    """Let the sockets that are not in ``before`` receive from this host only.

    Cyclone DDS sends only through the configured interface, but receives from all interfaces.

    Raises:
        ConnectorError: The kernel does not allow this.

    """
    for descriptor in set(_sockets()) - before:
        with socket.socket(fileno=os.dup(descriptor)) as made:
            if made.family != socket.AF_INET or made.type != socket.SOCK_DGRAM:
                continue
            try:
                made.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
            except OSError as error:
                raise ConnectorError(
                    f"cannot restrict DDS to this host: {error.strerror}; use Linux 5.7 or later, or set interface"
                ) from None


class _Endpoint:
    """The reader of a topic, and the writer of a command topic."""

    def __init__(self, participant: Any, changes: WaitSet, topic: Topic, blocking_ns: int) -> None:
        self.kind, self.qos = plain(topic.type), topic.qos
        self._participant, self._changes = participant, changes
        self.publishers = self.subscribers = 0
        self.alive = False
        """Whether a publisher has shown, within its lease, that it is alive."""
        self._dds = DdsTopic(participant, dds_topic(topic.name), sample_type(self.kind))
        self.requested, self.offered = reader_qos(topic.qos), writer_qos(topic.qos, blocking_ns)
        self.reader = DataReader(participant, self._dds, qos=self.requested)
        self.reader.set_status_mask(_MATCHING)
        changes.attach(self.reader)
        self.writer: Any = None
        self.set_writable(topic.writable)

    def set_writable(self, writable: bool) -> None:
        """Create the writer if the topic is writable and has none; delete it if the topic is not writable."""
        if not writable:
            self._delete(self.writer)
            self.writer = None
        elif self.writer is None:
            self.writer = DataWriter(self._participant, self._dds, qos=self.offered)
            self.writer.set_status_mask(DDSStatus.PublicationMatched)
            self._changes.attach(self.writer)

    def count(self) -> None:
        """Count the publishers and subscribers, not counting this participant, and acknowledge the changes."""
        self.publishers = self.reader.get_subscription_matched_status().current_count
        living = self.reader.get_liveliness_changed_status().alive_count
        self.alive = bool(living if self.qos.lease_ms else self.publishers)
        self.subscribers = 0 if self.writer is None else self.writer.get_publication_matched_status().current_count

    def close(self) -> None:
        """Delete the reader, the writer and the topic at once."""
        for entity in (self.writer, self.reader):
            self._delete(entity)
        _delete(self._dds)

    def _delete(self, entity: Any) -> None:
        if entity is not None:
            self._changes.detach(entity)
        _delete(entity)


def _other_policies(endpoint: _Endpoint) -> list[str]:
    """Return the policies that the library finds incompatible, for those that ``obstacles`` does not compare."""
    statuses = [endpoint.reader.get_requested_incompatible_qos_status()]
    if endpoint.writer is not None:
        statuses.append(endpoint.writer.get_offered_incompatible_qos_status())
    return [
        f"another node's QoS is incompatible: {POLICIES.get(one.last_policy_id, f'policy {one.last_policy_id}')}"
        for one in statuses
        if one.total_count and one.last_policy_id not in _COMPARED
    ]


def _delete(entity: Any) -> None:
    """Delete an entity of the library, with the entities in it, at once."""
    if entity is not None:
        entity.__del__()


class Participant:
    """A participant in a DDS domain; it leaves the domain when it is closed."""

    def __init__(
        self, domain: int, configured: str, topics: Collection[Topic], timeout_s: float, *, loopback: bool
    ) -> None:
        """Join the domain.

        Args:
            domain: The domain's id.
            configured: The configuration of Cyclone DDS, from :func:`configuration`.
            topics: The topics to read. Those that are writable are also written.
            timeout_s: Maximum time in s for which a write waits for room in the queue.
            loopback: Whether to receive from this host only.

        Raises:
            ConnectorError: The interface does not exist, or the domain cannot be joined.

        """
        self._endpoints: dict[str, _Endpoint] = {}
        self._blocking_ns = round(timeout_s * 1e9)
        self._domain = self._participant = None
        self._changes: Any = None
        """The readers and writers whose publishers or subscribers have changed since they were counted."""
        self._counted = False
        """False if readers or writers were created or deleted since the last count: DDS does not report a deletion."""
        self._without_publisher: frozenset[str] = frozenset()
        self.discovery = Discovery()
        try:
            before = set(_sockets())
            self._domain = Domain(domain, configured)
            if loopback:
                _keep_to_loopback(before)
            self._participant = DomainParticipant(domain)
            self._changes = WaitSet(self._participant)
            self.add(topics)
            self._watch()
        except ConnectorError:
            self.close()
            raise
        except DDSException as error:
            self.close()
            raise ConnectorError(
                f"cannot join DDS domain {domain}: {error.msg or error}; check that the interface exists and is up"
            ) from None

    def add(self, topics: Iterable[Topic]) -> None:
        """Start to read more topics, and prepare to write to those that are writable.

        Raises:
            ConnectorError: The library reports an error.

        """
        for topic in topics:
            if topic.name not in self._endpoints:
                self._counted = False
                try:
                    self._endpoints[topic.name] = _Endpoint(self._participant, self._changes, topic, self._blocking_ns)
                except DDSException as error:
                    raise ConnectorError(f"cannot read {topic.name}: {error}") from None

    def _watch(self) -> None:
        self.discovery.begin(self._participant, {dds_topic(name) for name in self._endpoints}, MAX_ENDPOINTS)

    def watch_all(self, limit: int) -> None:
        """Discover the publishers and subscribers of all topics, at most ``limit`` of each."""
        self.discovery.begin(self._participant, None, limit)

    def change(self, topics: Collection[Topic]) -> None:
        """From now on, read and write these topics only. Unchanged topics keep their readers and writers.

        Raises:
            ConnectorError: The library reports an error.

        """
        wanted = {topic.name: topic for topic in topics}
        self._counted = False
        try:
            for name, endpoint in list(self._endpoints.items()):
                topic = wanted.get(name)
                if topic is not None and (endpoint.kind, endpoint.qos) == (plain(topic.type), topic.qos):
                    endpoint.set_writable(topic.writable)
                else:
                    endpoint.close()
                    del self._endpoints[name]
            self.add(topics)
            self._watch()
        except DDSException as error:
            raise ConnectorError(f"cannot change the topics that are read: {error.msg or error}") from None

    def close(self) -> None:
        """Leave the domain."""
        self._endpoints.clear()
        self.discovery.close()
        for entity in (self._changes, self._participant, self._domain):
            _delete(entity)
        self._changes = self._participant = self._domain = None

    def _count(self) -> None:
        """Count publishers and subscribers again if they, or the readers and writers, have changed."""
        if not self._counted or self._changes.wait(0):
            self._counted = True
            for endpoint in self._endpoints.values():
                endpoint.count()
            self._without_publisher = frozenset(name for name, one in self._endpoints.items() if not one.alive)

    def publishers(self, topic: str) -> int:
        """Return how many publishers a topic has, not counting this participant."""
        self._count()
        return self._endpoints[topic].publishers

    def subscribers(self, topic: str) -> int:
        """Return how many subscribers a command topic has, not counting this participant."""
        self._count()
        return self._endpoints[topic].subscribers

    def met(self) -> bool:
        """Return whether any topic has a publisher or a subscriber."""
        self._count()
        return any(endpoint.publishers or endpoint.subscribers for endpoint in self._endpoints.values())

    def without_publisher(self) -> frozenset[str]:
        """Return the topics that have no publisher that is alive."""
        self._count()
        return self._without_publisher

    def discover(self, most: int) -> set[str]:
        """Process at most ``most`` discovered changes of each kind; return the names of the topics with changes."""
        return {ros_topic(name) for name in self.discovery.update(most)} & self._endpoints.keys()

    def obstacles(self, topic: str) -> list[str]:
        """Return why publishers and subscribers of a topic do not match this participant's reader and writer."""
        endpoint, name = self._endpoints[topic], dds_topic(topic)
        found: dict[str, None] = {}
        for one in self.discovery.publishers(name):
            if one.type != dds_type(endpoint.kind):
                found[f"a publisher sends {ros_type(one.type)}, not {endpoint.kind}"] = None
            for policy, offered, requested in unmet(one.qos, endpoint.requested):
                remedy = f"set {_KEYS.get(policy, policy)} in topic_qos.{topic!r}"
                found[f"a publisher offers {policy} {offered}, but this source requests {requested}; {remedy}"] = None
        for one in self.discovery.subscribers(name) if endpoint.writer is not None else ():
            if one.type != dds_type(endpoint.kind):
                found[f"a subscriber expects {ros_type(one.type)}, not {endpoint.kind}"] = None
            for policy, offered, requested in unmet(endpoint.offered, one.qos):
                own = policy in ("durability", "lease")
                remedy = (
                    f"set {_KEYS.get(policy, policy)} in topic_qos.{topic!r}" if own else "change the subscriber's QoS"
                )
                found[f"a subscriber requests {policy} {requested}, but this source offers {offered}; {remedy}"] = None
        return list(found) or _other_policies(endpoint)

    def take(self) -> Iterator[tuple[str, Any]]:
        """Yield each topic with a new message, and its newest message, which is None if it is malformed.

        Raises:
            ConnectorError: The library reports an error.

        """
        for name, endpoint in self._endpoints.items():
            try:
                for sample in endpoint.reader.take(1):
                    if not isinstance(sample, InvalidSample):
                        yield name, sample.message
            except DDSException as error:
                raise ConnectorError(f"{name}: {error.msg or error}") from None
            except Exception as error:  # noqa: BLE001  decoding of a peer's bytes may fail in any way
                log.warning("%s: a message cannot be decoded: %s", name, type(error).__name__)
                yield name, None

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message.

        Raises:
            ConnectorError: The message cannot be sent.

        """
        endpoint = self._endpoints[topic]
        assert endpoint.writer is not None  # noqa: S101 - for the type checker
        try:
            endpoint.writer.write(to_sample(message, endpoint.kind))
        except DDSException as error:
            raise ConnectorError(f"{topic}: {error.msg or error}") from None

    def received(self, topic: str, until_s: float) -> bool:
        """Wait until all reliable subscribers have received what was published on a topic.

        Returns:
            False if some have not received everything by ``until_s``, a time of CLOCK_MONOTONIC.

        """
        endpoint = self._endpoints[topic]
        assert endpoint.writer is not None  # noqa: S101 - for the type checker
        rest_ns = max(100_000, round((until_s - time.monotonic()) * 1e9))
        try:
            return bool(endpoint.writer.wait_for_acks(rest_ns))
        except (DDSException, AttributeError):  # the library's own comparison for a time-out fails
            return False
