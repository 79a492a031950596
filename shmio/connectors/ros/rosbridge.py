"""The connector ``rosbridge``: subscribes to topics of a rosbridge server, and publishes commands."""

from __future__ import annotations

import importlib.util
import itertools
import time
from collections.abc import Sequence
from typing import Annotated, Any, Final
from urllib.parse import urlsplit

import msgspec

from shmio.config import Address
from shmio.connectors.base import Connector, Lost, WriteLostError
from shmio.connectors.browsing import Browsed, Wanted
from shmio.connectors.request_count import CycleRequests
from shmio.connectors.ros.browse import Seen, browsed, levels
from shmio.connectors.ros.commands import Publication, Sending, plan, stamped
from shmio.connectors.ros.messages import finite, from_json, plain
from shmio.connectors.ros.options import REGISTER_OPTIONS, TopicOptions
from shmio.connectors.ros.topics import Topic, Topics
from shmio.connectors.ros.websocket import Link, decode
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.model import Layout
from shmio.layout.values.write import Write
from shmio.wording import counted

DEFAULT_PORT: Final = 9090
FIRST_S: Final = 0.1
"""Maximum time in s for which a new connection waits for the first messages."""


class RosbridgeOptions(TopicOptions, frozen=True, kw_only=True):
    """The server's address, and how topics are read.

    Raises:
        ValueError: The URL is wrong.

    """

    url: Annotated[str, msgspec.Meta(min_length=1, max_length=1000)]
    max_message_bytes: Annotated[int, msgspec.Meta(ge=1000, le=1 << 26)] = 1 << 20
    """Size in bytes of the largest message that is accepted."""
    throttle_ms: Annotated[int, msgspec.Meta(ge=0, le=3_600_000)] = 0
    """Minimum time in ms that the server must keep between two messages of a topic."""

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        try:
            port = parts.port
        except ValueError:
            port = 0
        if parts.scheme != "ws" or not parts.hostname or port == 0 or "@" in parts.netloc:
            raise ValueError(f"url: expected ws://HOST:PORT, found {self.url!r}")

    @property
    def address(self) -> Address:
        """Host and port of the server."""
        parts = urlsplit(self.url)
        return Address(parts.hostname or "", parts.port or DEFAULT_PORT)

    @property
    def full_url(self) -> str:
        """The URL with its port."""
        parts = urlsplit(self.url)
        return self.url if parts.port else parts._replace(netloc=f"{parts.netloc}:{DEFAULT_PORT}").geturl()


class RosbridgeConnector(Connector):
    """Reads fields of topics through a rosbridge server, and publishes commands."""

    Options = RosbridgeOptions
    can_write = True
    register_quality = True
    register_options = REGISTER_OPTIONS | {"throttle_ms"}

    def __init__(self, options: RosbridgeOptions, layout: Layout) -> None:
        _check_library()
        self._options = options
        self._topics = Topics(layout, options, known_types=False)
        self._numbers = itertools.count(1)
        self._link: Link | None = None
        self._sending = Sending([], [], 0.0)

    @classmethod
    def browse(cls, options: RosbridgeOptions, wanted: Wanted) -> Browsed:
        """List the topics that the server's node rosapi knows, and the fields of their messages.

        Raises:
            ConnectorError: The server cannot be reached, or has no rosapi.

        """
        _check_library()
        timeout_s = options.timeout / 1000
        link = Link(options.full_url, options.address, timeout_s, options.max_message_bytes, ())
        try:
            seen, incomplete = _survey(link, wanted)
            waiting = {name for name, one in seen.items() if one.awaited}
            link.keep(set(waiting))
            for name in waiting:
                _subscribe(link, name, seen[name].type)
            end_s = time.monotonic() + timeout_s
            while waiting and time.monotonic() < end_s:
                link.check()
                for name, received in link.newest().items():
                    seen[name].message = from_json(decode(received.text), plain(seen[name].type))
                    waiting.discard(name)
                link.wait_any(min(end_s, time.monotonic() + timeout_s / 4))
        finally:
            link.close()
        return browsed(seen, wanted, incomplete)

    @property
    def timeout_s(self) -> float:
        """The longest time that any method may block, in s."""
        return 3 * self._options.timeout / 1000

    def describe(self) -> str:
        """Return, for the log, the server's address and the number of topics."""
        return f"to {self._options.address}, {len(self._topics.by_name)} topics by rosbridge"

    def cycle_requests(self) -> CycleRequests:
        """Return a description with the number of topics. A cycle sends no requests."""
        return CycleRequests(counted(len(self._topics.by_name), "topic"), note="the server sends their messages")

    def connect(self) -> None:
        """Open the connection, and subscribe to all topics.

        Raises:
            ConnectorError: The server cannot be reached.

        """
        self.close()
        self._topics.reset()
        options = self._options
        link = self._link = Link(
            options.full_url, options.address, options.timeout / 1000, options.max_message_bytes, self._topics.by_name
        )
        try:
            for topic in self._topics.by_name.values():
                _subscribe(link, topic.name, topic.type, options.throttle_ms)
                if topic.writable:
                    _advertise(link, topic)
            link.wait_newest(time.monotonic() + min(FIRST_S, options.timeout / 1000))
            link.check()
        except ConnectorError:
            self.close()
            raise

    def take_over(self, other: RosbridgeConnector) -> bool:
        """Take over the connection of ``other``, and the last messages of the topics that both connectors have."""
        link = other._link
        if link is None:
            return False
        self._link, other._link = link, None
        link.check()
        other._pull(link)
        self._topics.inherit(other._topics)
        link.keep(self._topics.by_name)
        self._numbers = other._numbers
        same_rate = self._options.throttle_ms == other._options.throttle_ms
        before, after = other._topics.by_name, self._topics.by_name
        for name, topic in before.items():
            there = after.get(name)
            if topic.writable and not (there and there.writable and there.type == topic.type):
                link.send(op="unadvertise", id=f"advertise:{name}", topic=name)
            if not (there and there.type == topic.type and same_rate):
                link.send(op="unsubscribe", id=f"subscribe:{name}", topic=name)
        for name, topic in after.items():
            there = before.get(name)
            if not (there and there.type == topic.type and same_rate):
                _subscribe(link, name, topic.type, self._options.throttle_ms)
            if topic.writable and not (there and there.writable and there.type == topic.type):
                _advertise(link, topic)
        return True

    def read(self) -> bytes:
        """Return the image of the newest messages, after checking that the server still answers.

        Raises:
            ConnectorError: The connection is lost, or the server has not answered in time.

        """
        link = self._link
        if link is None:
            raise ConnectorError(f"not connected to {self._options.address}")
        link.check()
        self._pull(link)
        return self._topics.image(time.monotonic_ns())

    def _pull(self, link: Link) -> None:
        for name, received in link.newest().items():
            message = from_json(decode(received.text), plain(self._topics.by_name[name].type))
            self._topics.take(name, message, received.monotonic_ns, received.utc_ns)

    def close(self) -> None:
        """Close the connection. You may call this at any time and more than once."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def send(self, writes: Sequence[Write]) -> None:
        """Prepare the messages for these writes; :meth:`confirm` publishes them one after the other."""
        link = self._link
        if link is None:
            raise WriteLostError(f"not connected to {self._options.address}", [Lost.UNSENT] * len(writes))
        self._pull(link)
        publications, refusals = plan(self._topics, writes)
        self._sending = Sending(publications, [*refusals], time.monotonic() + self._options.timeout / 1000)

    def confirm(self, until_ns: int) -> list[str] | None:
        """Publish the messages, one after the other. The server confirms a message by sending it back.

        Raises:
            WriteLostError: The server did not send a message back in time, or the connection was
                lost.

        """
        link, sending = self._link, self._sending
        if link is None:
            raise sending.lost(f"not connected to {self._options.address}")
        try:
            while (publication := sending.publication) is not None:
                refusal = self._publish(link, publication, min(until_ns / 1e9, sending.until_s))
                if refusal is None:
                    if time.monotonic() < sending.until_s:
                        return None
                    name = publication.topic.name
                    raise ConnectorError(
                        f"no answer within {self._options.timeout} ms from {self._options.address}: it did not send "
                        f"back what was published on {name}"
                    )
                sending.end(refusal)
        except ConnectorError as error:
            raise sending.lost(str(error)) from None
        return [str(outcome) for outcome in sending.outcomes]

    def _publish(self, link: Link, publication: Publication, until_s: float) -> str | None:
        """Publish a message, if this was not done yet; return its outcome, or None if it has none by ``until_s``."""
        message, topic = publication.message, publication.topic
        if not publication.begun:
            if not finite(message):
                return "JSON has neither NaN nor infinity; write a finite number"
            link.check()
            publication.begun = True
            link.publish(topic.name, self._stampless(message, publication), f"write:{next(self._numbers)}")
        return link.outcome(until_s)

    def _stampless(self, message: Any, publication: Publication) -> Any:
        """Return the message without its time stamp, which the server then sets.

        The stamp is kept if a register contains it.
        """
        if "header" not in message or stamped(self._topics, publication.topic):
            return message
        return message | {"header": {name: one for name, one in message["header"].items() if name != "stamp"}}


def _check_library() -> None:
    if importlib.util.find_spec("websockets") is None:
        raise ConfigError("connector: rosbridge needs another library; run pip install 'shmio[rosbridge]'")


def _survey(link: Link, wanted: Wanted) -> tuple[dict[str, Seen], str]:
    """Return the topics that rosapi knows, and why they may not be all.

    Raises:
        ConnectorError: The server does not answer, or has no rosapi.

    """
    try:
        answer = link.call("/rosapi/topics", {})
    except ConnectorError as error:
        raise ConnectorError(
            f"{error}; browse needs the node rosapi beside the server, which rosbridge_websocket_launch.xml starts"
        ) from None
    found = _texts(answer, "topics")
    types = _texts(answer, "types")
    seen: dict[str, Seen] = {}
    for at, name in enumerate(found):
        if not wanted.enters(levels(name)):
            continue
        if len(seen) == wanted.nodes:
            return seen, "there are more topics; select some of them by a PATTERN, or raise --limit"
        kind = types[at] if at < len(types) else _text(link.call("/rosapi/topic_type", {"topic": name}), "type")
        publishers = _texts(link.call("/rosapi/publishers", {"topic": name}), "publishers")
        seen[name] = Seen(kind, published=bool(publishers))
    return seen, ""


def _texts(answer: Any, name: str) -> list[str]:
    found = answer.get(name) if isinstance(answer, dict) else None
    return [one for one in found if isinstance(one, str)] if isinstance(found, list) else []


def _text(answer: Any, name: str) -> str:
    found = answer.get(name) if isinstance(answer, dict) else None
    return found if isinstance(found, str) else ""


def _subscribe(link: Link, name: str, kind: str, throttle_ms: int = 0) -> None:
    link.send(
        op="subscribe", id=f"subscribe:{name}", topic=name, type=kind, queue_length=1, throttle_rate=throttle_ms
    )  # fmt: skip


def _advertise(link: Link, topic: Topic) -> None:
    link.send(op="advertise", id=f"advertise:{topic.name}", topic=topic.name, type=topic.type)
