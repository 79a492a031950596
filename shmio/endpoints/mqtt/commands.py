"""Receives commands on the ``/in`` topics, and publishes a result for each."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

import msgspec
from paho.mqtt.client import MQTTMessage
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from shmio.endpoints.mqtt.channel import Message
from shmio.endpoints.mqtt.feed import Feed
from shmio.endpoints.mqtt.topic_rules import TopicRules
from shmio.errors import CommandError, PathError, ValueRangeError
from shmio.layout.model import Register
from shmio.layout.topic import look_up, parse_topic, shorten
from shmio.layout.values.text import MAX_TEXT, from_text
from shmio.segment import DONE, EventKind

REPLIES: Final = "shmio/results"
"""Below the prefix, the topics that clients may choose for their results.

A response topic elsewhere could make us write, or publish false values.
"""
OUTPUTS: Final = ("/out", "/frames")
RETAINED: Final = "a retained command is not carried out; publish commands without the retain flag"
MAX_CORRELATION_BYTES: Final = 1024
MAX_TOPIC_BYTES: Final = 65535 - len("/result")
"""Maximum length of a command's topic.

A topic has at most 65535 bytes (MQTT 5.0, section 1.5.4), and the result's topic is longer.
"""

Answer = Callable[[Message, Properties | None], None]

log = logging.getLogger("shmio.mqtt")


def command_filters(prefix: str, feeds: Iterable[Feed]) -> list[str]:
    """The filters for commands: one for each path depth of a source; none matches our own topics."""
    return [f"{prefix}/{feed.block.source}/{'+/' * depth}in" for feed in feeds for depth in feed.depths]


def output_filters(prefix: str, feeds: Iterable[Feed]) -> list[str]:
    """The filters for values that an earlier bridge may have published, for these sources."""
    deep = [
        f"{prefix}/{feed.block.source}/{'+/' * depth}out" for feed in feeds for depth in range(max(feed.depths) + 1)
    ]
    return deep + [f"{prefix}/{feed.block.source}/frames" for feed in feeds]


def result_filters(prefix: str, feeds: Iterable[Feed]) -> list[str]:
    """The filters for the topics of results."""
    return [f"{one}/result" for one in command_filters(prefix, feeds)] + [f"{prefix}/{REPLIES}/#"]


class CommandReceiver:
    """Receives commands, and sends them to their sources. Use it from the bridge's thread."""

    def __init__(self, prefix: str, rules: TopicRules, feeds: Mapping[str, Feed], answer: Answer) -> None:
        self.received = 0
        self.refused = 0
        """Commands that were not sent to a source, such as retained ones."""
        self._prefix, self._rules, self._feeds, self._answer = prefix, rules, feeds, answer

    def take(self, message: MQTTMessage) -> None:
        """Handle a message: if its topic is a command's, send the value to the source."""
        try:
            topic = message.topic
        except UnicodeDecodeError:
            self.refused += 1
            return
        if not topic.startswith(f"{self._prefix}/") or not topic.endswith("/in"):
            return
        self.received += 1
        if len(topic.encode()) > MAX_TOPIC_BYTES:
            self.refused += 1
            return
        tell = _Reply(self._prefix, topic, message, self._answer)
        if message.retain:  # the broker may have stored it before we connected: its age is unknown
            self.refused += 1
            tell(EventKind.REJECTED, RETAINED)
            return
        try:
            feed, register = self._find(topic.removeprefix(f"{self._prefix}/"))
            feed.command_client.check(register)  # before decoding: no value would be accepted
            value = _value(bytes(message.payload), register, json=self._is_json(feed, register))
            feed.command_client.send(register, value, tell)
        except (CommandError, PathError, ValueRangeError) as error:
            self.refused += 1
            tell(EventKind.REJECTED, str(error))

    def _find(self, text: str) -> tuple[Feed, Register]:
        topic = parse_topic(text, self._feeds, None)
        feed = self._feeds.get(topic.source)
        if feed is None:
            raise PathError(f"{topic.source}: no such source")
        return feed, look_up(feed.block.layout, topic)

    def _is_json(self, feed: Feed, register: Register) -> bool:
        return self._rules.of(feed.block.source, register.path).payload != "text"


class _Reply:
    """Publishes the result of one command."""

    def __init__(self, prefix: str, topic: str, message: MQTTMessage, answer: Answer) -> None:
        self._command = topic
        self._topic = f"{topic}/result"
        self._qos = min(1, message.qos)
        self._answer = answer
        properties = vars(message.properties) if message.properties is not None else {}
        self._correlation: bytes | None = properties.get("CorrelationData")
        wanted = properties.get("ResponseTopic")
        if isinstance(wanted, str) and wanted.startswith(f"{prefix}/{REPLIES}/") and not set("+#").intersection(wanted):
            self._topic = wanted

    def __call__(self, kind: EventKind, reason: str) -> None:
        if kind not in DONE:  # MQTT does not say who sent it; the response topic is the only hint
            asked = "" if self._topic == f"{self._command}/result" else f", for {shorten(self._topic)}"
            log.warning("command on %s%s: %s: %s", shorten(self._command, 400), asked, kind, reason)
        payload = msgspec.json.encode({"outcome": str(kind), "done": kind in DONE, "reason": reason})
        properties = None
        if self._correlation is not None and len(self._correlation) <= MAX_CORRELATION_BYTES:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.CorrelationData = self._correlation
        self._answer(Message(self._topic, payload, self._qos, retain=False), properties)


def _value(payload: bytes, register: Register, *, json: bool) -> Any:
    """Decode a payload: text, or JSON with a value or an object that has one.

    Raises:
        ValueRangeError: The payload is not a value of the register.

    """
    if len(payload) > MAX_TEXT:
        raise ValueRangeError(f"{register.path}: the payload is longer than {MAX_TEXT} bytes")
    try:
        text = payload.decode()
    except UnicodeDecodeError:
        raise ValueRangeError(f"{register.path}: the payload is not UTF-8") from None
    return from_text(_bare(text, register) if json else text, register)


def _bare(text: str, register: Register) -> str:
    """Return the text of a JSON value, or of an object's ``value``.

    Raises:
        ValueRangeError: The text is not such JSON.

    """
    try:
        value = msgspec.json.decode(text)
        if isinstance(value, dict):
            value = value["value"]
    except (msgspec.DecodeError, KeyError, RecursionError):
        raise ValueRangeError(
            f'{register.path}: expected a value as JSON, or an object with one: {{"value": 1}}'
        ) from None
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()
