"""The connector ``ros2``: subscribes to topics of ROS 2 by DDS, without an installation of ROS."""

from __future__ import annotations

import importlib.util
import logging
import re
import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec

from shmio.connectors.base import Connector, Lost, UnconfirmedError, WriteLostError
from shmio.connectors.browsing import Browsed, Wanted
from shmio.connectors.request_count import CycleRequests
from shmio.connectors.ros.browse import Seen, browsed, levels
from shmio.connectors.ros.commands import Publication, Sending, plan, stamped
from shmio.connectors.ros.options import REGISTER_OPTIONS, TopicOptions
from shmio.connectors.ros.qos import QosKeys, TopicQos, qos_of
from shmio.connectors.ros.topics import Topic, Topics
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.model import Layout
from shmio.layout.values.write import Write
from shmio.model.statuses import BAD_CONFIGURATION_ERROR, BAD_NO_COMMUNICATION, GOOD
from shmio.wording import counted, unknown

if TYPE_CHECKING:
    from shmio.connectors.ros.discovery import Discovery
    from shmio.connectors.ros.participant import Participant

POLL_S: Final = 0.005
"""Interval in s at which the connector looks for the first publisher or subscriber while it connects."""

DISCOVERIES: Final = 4
"""Maximum number of discovered publishers and subscribers to examine in a cycle; each takes about 0.2 ms."""
DISCOVERIES_AT_END: Final = 1000
"""Maximum number to examine where no cycle waits: in ``browse``, and before an error."""
MAX_REASONS: Final = 3
"""Maximum number of reasons in a message to the user."""
DISCOVERY_S: Final = 1.0
"""Time in s after the creation of readers and writers during which a write waits for a first subscriber."""

log = logging.getLogger("shmio.source")


class Ros2Options(TopicOptions, frozen=True, kw_only=True):
    """The DDS domain and the network interface, and how topics are read, with their QoS.

    Raises:
        ValueError: Some keys contradict each other.

    """

    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] = 0
    """``ROS_DOMAIN_ID`` of the robot."""
    interface: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_.:@-]{1,40}$")] = "lo"
    """The name of the network interface; ``lo`` is for this host only."""
    peers: Annotated[
        list[Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_.:-]{1,253}$")]], msgspec.Meta(max_length=100)
    ] = msgspec.field(default_factory=list)
    """Hosts to contact directly, without multicast."""
    qos: QosKeys = QosKeys()
    """The QoS of all topics."""
    topic_qos: Annotated[dict[str, QosKeys], msgspec.Meta(max_length=10_000)] = msgspec.field(default_factory=dict)
    """The QoS of single topics, which takes precedence over ``qos``."""
    max_message_bytes: Annotated[int, msgspec.Meta(ge=1000, le=1 << 26)] = 1 << 20
    """Size in bytes of the largest message that is received; larger messages are dropped."""

    def __post_init__(self) -> None:
        if self.interface == "lo" and self.peers:
            raise ValueError(
                "peers: to reach other hosts, set interface to the name of a network interface, such as eth0"
            )


class Ros2Connector(Connector):
    """Reads fields of ROS 2 topics as a DDS participant, and publishes commands."""

    Options = Ros2Options
    can_write = True
    register_quality = True
    register_options = REGISTER_OPTIONS | {"qos", "topic_qos"}

    def __init__(self, options: Ros2Options, layout: Layout) -> None:
        _check_library()
        self._options = options
        self._topics = Topics(layout, options, known_types=True)
        self._set_qos(options)
        self._participant: Participant | None = None
        self._sending = Sending([], [], 0.0)
        self._obstructed: set[str] = set()
        """The topics that have a publisher or subscriber that does not fit this source."""
        self._discovered_s = 0.0
        """When all present subscribers should have been discovered, s of CLOCK_MONOTONIC."""

    @classmethod
    def browse_options(cls, url: str) -> dict[str, Any]:
        """Return the options for a URL such as ``ros2://0``, which contains the domain."""
        domain = url.removeprefix("ros2://").rstrip("/")
        if not re.fullmatch(r"[0-9]{1,3}", domain):
            raise ConfigError(f"{url}: expected ros2://DOMAIN with the robot's ROS_DOMAIN_ID, such as ros2://0")
        return {"domain": int(domain)}

    @classmethod
    def browse(cls, options: Ros2Options, wanted: Wanted) -> Browsed:
        """List the topics that DDS discovers within the time-out, and the fields of their messages."""
        _check_library()
        joined = _join(options, ())
        try:
            seen = _survey(joined, wanted, time.monotonic() + options.timeout / 1000)
            full = joined.discovery.full
        finally:
            joined.close()
        if not seen and wanted.everything:
            raise ConnectorError(
                f"no topic of ROS was discovered in DDS domain {options.domain} on {options.interface} within "
                f"{options.timeout} ms; check ROS_DOMAIN_ID, and that --set interface=… is the robot's network"
            )
        return browsed(seen, wanted, "there are more publishers and subscribers; raise --limit" if full else "")

    def _set_qos(self, options: Ros2Options) -> None:
        names = self._topics.by_name
        for name in options.topic_qos:
            if name not in names:
                raise ConfigError(f"topic_qos: {unknown('topic', name, sorted(names))}")
        if options.qos.lifespan_ms and not any(topic.writable for topic in names.values()):
            raise ConfigError("qos: lifespan_ms: this source writes no topic; to limit the age of values, use max_age")
        for topic in names.values():
            own = options.topic_qos.get(topic.name)
            try:
                topic.qos = qos_of(options.qos, own, latched=topic.latched, writable=topic.writable)
            except ValueError as error:
                raise ConfigError(f"{'qos' if own is None else 'topic_qos'}: {topic.name}: {error}") from None

    @property
    def timeout_s(self) -> float:
        """The longest time that any method may block, in s."""
        return 3 * self._options.timeout / 1000

    @property
    def _where(self) -> str:
        return f"domain {self._options.domain} on {self._options.interface}"

    def describe(self) -> str:
        """Return, for the log, the domain and the number of topics."""
        return f"to DDS {self._where}, {len(self._topics.by_name)} topics"

    def cycle_requests(self) -> CycleRequests:
        """Return a description with the number of topics. A cycle sends no requests."""
        return CycleRequests(counted(len(self._topics.by_name), "topic"), note="their publishers send messages")

    def connect(self) -> None:
        """Join the domain, and wait until another participant publishes on or subscribes to a topic of this source.

        Raises:
            ConnectorError: No participant has done so within the time-out.

        """
        self.close()
        self._topics.reset()
        self._obstructed.clear()
        end_s = time.monotonic() + self._options.timeout / 1000
        joined = self._participant = _join(self._options, self._topics.by_name.values())
        self._meet(joined, end_s)

    def take_over(self, other: Ros2Connector) -> bool:
        """Take over the participant of ``other``, and the last messages of the topics that both connectors have."""
        joined = other._participant
        if joined is None:
            return False
        self._participant, other._participant = joined, None
        end_s = time.monotonic() + self._options.timeout / 1000
        other._pull(joined)
        self._topics.inherit(other._topics)
        joined.change(self._topics.by_name.values())
        self._meet(joined, end_s)
        return True

    def _meet(self, joined: Participant, end_s: float) -> None:
        """Wait until another participant publishes or subscribes to one of the topics.

        Raises:
            ConnectorError: None does so by ``end_s``, a time of CLOCK_MONOTONIC.

        """
        options = self._options
        self._discovered_s = time.monotonic() + DISCOVERY_S
        discovered: set[str] = set()
        while not joined.met():
            if time.monotonic() > end_s:
                joined.discover(DISCOVERIES_AT_END)
                reasons = [f"{name}: {one}" for name in self._topics.by_name for one in joined.obstacles(name)]
                self.close()
                compatible = "compatible " if reasons else ""
                why = ". ".join(reasons[:MAX_REASONS]) or (
                    "check that ROS_DOMAIN_ID, topic names and types are those of the robot"
                )
                raise ConnectorError(
                    f"found no {compatible}publisher or subscriber of this source's topics in DDS {self._where} within "
                    f"{options.timeout} ms; {why}"
                )
            discovered |= joined.discover(DISCOVERIES)
            time.sleep(POLL_S)
        for name in sorted(discovered):
            self._report(joined, self._topics.by_name[name])

    def read(self) -> bytes:
        """Return the image of the newest messages.

        Raises:
            ConnectorError: All other participants that published on or subscribed to a topic of
                this source have left.

        """
        joined = self._participant
        if joined is None:
            raise ConnectorError(f"this process has not joined DDS {self._where}")
        self._pull(joined)
        if not joined.met():
            raise ConnectorError(f"all publishers and subscribers of this source's topics have left DDS {self._where}")
        for name in joined.discover(DISCOVERIES):
            self._report(joined, self._topics.by_name[name])
        without_publisher = joined.without_publisher()
        for topic in self._topics.by_name.values():
            topic.fault = GOOD
            if topic.received_ns:
                if topic.name in without_publisher and not topic.writable:
                    topic.fault = BAD_NO_COMMUNICATION
            elif topic.name in self._obstructed and not joined.publishers(topic.name):
                topic.fault = BAD_CONFIGURATION_ERROR
        return self._topics.image(time.monotonic_ns())

    def _report(self, joined: Participant, topic: Topic) -> None:
        """Log why other participants' publishers and subscribers of a topic do not fit."""
        obstacles = joined.obstacles(topic.name)
        for one in obstacles:
            self._topics.report(topic.registers[0], f"{topic.name}: {one}")
        if obstacles:
            self._obstructed.add(topic.name)
        else:
            self._obstructed.discard(topic.name)

    def _pull(self, joined: Participant) -> None:
        for name, message in joined.take():
            self._topics.take(name, message, time.monotonic_ns(), time.time_ns())

    def close(self) -> None:
        """Leave the domain. You may call this at any time and more than once."""
        if self._participant is not None:
            self._participant.close()
            self._participant = None

    def send(self, writes: Sequence[Write]) -> None:
        """Prepare the messages for these writes; :meth:`confirm` publishes them one after the other."""
        joined = self._participant
        if joined is None:
            raise WriteLostError(f"this process has not joined DDS {self._where}", [Lost.UNSENT] * len(writes))
        self._pull(joined)
        publications, refusals = plan(self._topics, writes)
        self._sending = Sending(publications, [*refusals], time.monotonic() + self._options.timeout / 1000)

    def confirm(self, until_ns: int) -> list[str] | None:
        """Publish the messages, one after the other. All reliable subscribers must confirm each message.

        Raises:
            UnconfirmedError: A subscriber did not acknowledge a message in time.
            WriteLostError: The library reports an error.

        """
        joined, sending = self._participant, self._sending
        if joined is None:
            raise sending.lost(f"this process has left DDS {self._where}")
        try:
            while (publication := sending.publication) is not None:
                refusal = self._publish(joined, publication, min(until_ns / 1e9, sending.until_s))
                if refusal is None:
                    if time.monotonic() < sending.until_s:
                        return None
                    name = publication.topic.name
                    lost = sending.lost(
                        f"no answer within {self._options.timeout} ms: a subscriber of {name} did not acknowledge the "
                        "message"
                    )
                    raise UnconfirmedError(str(lost), lost.outcomes)
                sending.end(refusal)
        except WriteLostError:
            raise
        except ConnectorError as error:
            raise sending.lost(str(error)) from None
        return [str(outcome) for outcome in sending.outcomes]

    def _publish(self, joined: Participant, publication: Publication, until_s: float) -> str | None:
        """Publish a message, if this was not done yet, and wait until all subscribers have received it.

        A subscriber may not be discovered yet, shortly after this participant has joined the domain.

        Returns:
            "" if they have, or why the message is refused; None if they have not by ``until_s``.

        """
        name, message = publication.topic.name, publication.message
        if not publication.begun:
            while not joined.subscribers(name) and time.monotonic() < min(self._discovered_s, until_s):
                time.sleep(POLL_S)
            if not joined.subscribers(name):
                if until_s < min(self._discovered_s, self._sending.until_s):
                    return None
                if reasons := joined.obstacles(name):
                    return f"no compatible node subscribes to {name}: {'. '.join(reasons[:MAX_REASONS])}"
                return f"no node subscribes to {name}: nobody would receive the message"
            if "header" in message and not stamped(self._topics, publication.topic):
                message["header"]["stamp"] = _time(time.time_ns())
            publication.begun = True
            joined.publish(name, message)
        if not joined.received(name, until_s):
            return None
        self._pull(joined)  # what others published before the confirmation is older
        self._topics.take(name, message, time.monotonic_ns(), time.time_ns())
        return ""


def _check_library() -> None:
    if importlib.util.find_spec("cyclonedds") is None:
        raise ConfigError("connector: ros2 needs another library; run pip install 'shmio[ros2]'")


def _join(options: Ros2Options, topics: Collection[Topic]) -> Participant:
    """Join the domain. Raise ConnectorError if that is not possible, or if a topic cannot be read."""
    from shmio.connectors.ros import participant  # noqa: PLC0415  its library is optional

    configured = participant.configuration(options.domain, options.interface, options.peers, options.max_message_bytes)
    return participant.Participant(
        options.domain, configured, topics, options.timeout / 1000, loopback=options.interface == "lo"
    )


def _survey(joined: Participant, wanted: Wanted, end_s: float) -> dict[str, Seen]:
    """Return the topics that are discovered by ``end_s``, a time of CLOCK_MONOTONIC, with their newest messages."""
    seen: dict[str, Seen] = {}
    read: set[str] = set()
    joined.watch_all(wanted.nodes)
    while time.monotonic() < end_s:
        if joined.discovery.update(DISCOVERIES_AT_END):
            _note(joined.discovery, wanted, seen)
        for name, found in seen.items():
            if name not in read and found.awaited:
                read.add(name)
                topic = Topic(name, found.type)
                if found.stored:
                    topic.qos = TopicQos("reliable", "transient_local")
                with suppress(ConnectorError):  # DDS refuses some names that ROS does not have
                    joined.add([topic])
        for name, message in joined.take():
            seen[name].message = message
        time.sleep(POLL_S)
    return seen


def _note(discovery: Discovery, wanted: Wanted, seen: dict[str, Seen]) -> None:
    """Add the topics of all publishers and subscribers to ``seen``."""
    from shmio.connectors.ros.dds_types import ros_topic, ros_type  # noqa: PLC0415  its library is optional
    from shmio.connectors.ros.discovery import stores  # noqa: PLC0415

    for published, endpoints in ((True, discovery.publishers()), (False, discovery.subscribers())):
        for one in endpoints:
            name = ros_topic(one.topic)
            if name and wanted.enters(levels(name)):
                topic = seen.setdefault(name, Seen(ros_type(one.type)))
                topic.published |= published
                topic.stored |= published and stores(one.qos)


def _time(utc_ns: int) -> dict[str, Any]:
    sec, nanosec = divmod(utc_ns, 10**9)
    return {"sec": sec, "nanosec": nanosec}
