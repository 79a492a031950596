"""Receives commands on ``/in`` topics, sends them to their sources, and publishes their results."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import msgspec
from paho.mqtt.client import MQTTMessage
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from shmio.audit.trail import Actor, Attempt, acting
from shmio.endpoints.commands_in_flight import MAX_OPEN, CommandCost, InFlightTable
from shmio.endpoints.mqtt.topics import Message, TopicRules
from shmio.errors import CommandError, PathError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import look_up, parse_topic, shorten
from shmio.layout.values.text import MAX_TEXT, from_text
from shmio.layout.values.write import sizes
from shmio.local.writer import REPLACED, RETIRED, SourceWriter
from shmio.segment import DONE, Block, EventKind
from shmio.segment.commands import End, worst
from shmio.wording import unknown

REPLIES: Final = "shmio/results"
"""Clients may choose a response topic for results only below this topic, which follows the prefix.

If clients could choose any topic, they could make the bridge write values or publish false values.
"""
OUTPUTS: Final = ("/out", "/frames")
RETAINED: Final = "a retained command is not carried out; publish commands without the retain flag"
MAX_SHOWN: Final = 400
"""Maximum number of bytes of a payload that are passed to the audit log, which may shorten them further."""
MAX_CORRELATION_BYTES: Final = 1024
MAX_TOPIC_BYTES: Final = 65535 - len("/result")
"""Maximum length of a command's topic, in bytes.

A topic has at most 65535 bytes (MQTT 5.0, section 1.5.4), and the topic of the result is longer.
"""

Done = Callable[[EventKind, str], None]
"""Function that is called once for each command, with its outcome and the reason."""
Answer = Callable[[Message, Properties | None], None]

log = logging.getLogger("shmio.mqtt")


class CommandClient:
    """Sends commands to one source. Use it only in the bridge's thread."""

    def __init__(self, block: Block, writer: int) -> None:
        """Prepare to send commands. For a large layout this takes seconds.

        Args:
            block: The block of the source.
            writer: Number of this process's command queue.

        """
        self.block = block
        self.depths = _depths(block.layout)
        """The depths (numbers of segments) of the paths of this source's registers and elements, in ascending order."""
        self._source_writer = SourceWriter(block, writer)
        self._source_writer.prepare()
        self._pending = InFlightTable(writer)
        self._events = block.events.cursor()

    def check(self, register: Register) -> None:
        """Check that a register is writable.

        Raises:
            CommandError: The register is not writable.

        """
        self._source_writer.check(register)

    def send(self, register: Register, value: object, done: Done, attempt: Attempt) -> None:
        """Send a value for a register, an array or an element.

        Args:
            register: The register, array or element.
            value: The value.
            done: Called once, with the outcome.
            attempt: The command's entry in the audit log.

        Raises:
            CommandError: The command was not sent.
            ValueRangeError: The value does not fit. The command was not sent.

        """
        cost = CommandCost.of(sizes(register))
        if self._pending and self._pending.open_events + cost.events > MAX_OPEN:
            raise CommandError(f"{self.block.source}: too many commands are in flight; wait for their results")
        if self.block.retired:
            raise CommandError(RETIRED)
        ticket = self._source_writer.submit({register.path: value})
        self._pending.add(ticket, cost, partial(_report, done), attempt=attempt)

    def poll(self) -> None:
        """Read new events, and complete the commands whose outcome is known or overdue."""
        while (event := self._events.poll()) is not None:
            self._pending.on_event(event)
        if self._events.take_missed():
            self._pending.shorten_timeouts()
        self._pending.expire()
        if self._events.ended:
            self._pending.end(REPLACED)


def _report(done: Done, ends: Sequence[End]) -> None:
    kind, reason = worst(ends)
    done(kind, "" if kind in DONE else reason)


def _depths(layout: Layout) -> Sequence[int]:
    kinds = {(register.path.count("/") + 1, len(register.dims)) for register in layout.registers}
    return sorted({depth for names, indices in kinds for depth in (names, names + indices)})


def command_filters(prefix: str, clients: Iterable[CommandClient]) -> list[str]:
    """Return the topic filters for the commands to these sources. They match no topic that the bridge publishes.

    There is a filter for each depth of a path in each source.
    """
    return [f"{prefix}/{one.block.source}/{'+/' * depth}in" for one in clients for depth in one.depths]


def output_filters(prefix: str, clients: Iterable[CommandClient]) -> list[str]:
    """Return topic filters that match the values of these sources, including those that earlier bridges published."""
    found = []
    for one in clients:
        base = f"{prefix}/{one.block.source}"
        found += [*(f"{base}/{'+/' * depth}out" for depth in range(max(one.depths) + 1)), f"{base}/frames"]
    return found


def result_filters(prefix: str, clients: Iterable[CommandClient]) -> list[str]:
    """Return the topic filters for the results of commands to these sources."""
    return [f"{one}/result" for one in command_filters(prefix, clients)] + [f"{prefix}/{REPLIES}/#"]


class CommandReceiver:
    """Receives commands, and sends them to their sources. Use it only in the bridge's thread."""

    def __init__(
        self,
        prefix: str,
        rules: TopicRules,
        clients: Mapping[str, CommandClient],
        answer: Answer,
        broker: Callable[[], str],
    ) -> None:
        """Create the receiver.

        Args:
            prefix: Prefix of all topics.
            rules: The configuration's rules for topics.
            clients: The command client of each current source, by the source's name.
            answer: Called with the message of each result.
            broker: Returns the name of the present broker.

        """
        self.received = 0
        self.refused = 0
        """Number of commands that were not sent to a source, such as retained ones."""
        self._prefix, self._rules, self._clients, self._answer = prefix, rules, clients, answer
        self._broker = broker

    def take(self, message: MQTTMessage) -> None:
        """Handle a message. If its topic is that of a command, send its value to the source."""
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
        reply = _Reply(self._prefix, topic, message, self._answer)
        path = topic.removeprefix(f"{self._prefix}/")
        payload = bytes(message.payload)
        with acting(Actor("anonymous", "", f"broker {self._broker()}{reply.asked}"), "mqtt"):
            attempt = Attempt("write", {path.removesuffix("/in"): payload[:MAX_SHOWN].decode(errors="replace")})
        if message.retain:  # its age is unknown: the broker may have stored it before we connected
            self.refused += 1
            attempt.end("refused", RETAINED)
            reply(EventKind.REJECTED, RETAINED)
            return
        try:
            with attempt, attempt.acting():
                client, register = self._find(path)
                client.check(register)  # before decoding, because no value would be accepted
                json = self._rules.of(client.block.source, register.path).payload != "text"
                client.send(register, _value(payload, register, json=json), reply, attempt)
        except (CommandError, PathError, ValueRangeError) as error:
            self.refused += 1
            reply(EventKind.REJECTED, str(error))

    def _find(self, text: str) -> tuple[CommandClient, Register]:
        topic = parse_topic(text, self._clients, None)
        client = self._clients.get(topic.source)
        if client is None:
            raise PathError(unknown("source", topic.source, self._clients))
        return client, look_up(client.block.layout, topic)


class _Reply:
    """Publishes the result of one command."""

    def __init__(self, prefix: str, topic: str, message: MQTTMessage, answer: Answer) -> None:
        self._command = topic
        self._topic = f"{topic}/result"
        self._qos = min(1, message.qos)
        self._answer = answer
        self.asked = ""
        """Text with the response topic, the only hint at who sent the command; empty if there is none."""
        properties = vars(message.properties) if message.properties is not None else {}
        self._correlation: bytes | None = properties.get("CorrelationData")
        wanted = properties.get("ResponseTopic")
        if isinstance(wanted, str) and wanted.startswith(f"{prefix}/{REPLIES}/") and not set("+#").intersection(wanted):
            self._topic = wanted
            self.asked = f" (response topic {shorten(wanted)})"

    def __call__(self, kind: EventKind, reason: str) -> None:
        if kind not in DONE:
            log.warning(
                "the command on %s%s was not carried out: %s: %s", shorten(self._command, 400), self.asked, kind, reason
            )
        payload = msgspec.json.encode({"outcome": str(kind), "done": kind in DONE, "reason": reason})
        properties = None
        if self._correlation is not None and len(self._correlation) <= MAX_CORRELATION_BYTES:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.CorrelationData = self._correlation
        self._answer(Message(self._topic, payload, self._qos, retain=False), properties)


def _value(payload: bytes, register: Register, *, json: bool) -> Any:
    """Decode a payload: a plain text, or with ``json`` a JSON value or an object with ``value``.

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
    """Return a JSON value as text. If it is an object, return its member ``value`` as text.

    Raises:
        ValueRangeError: The text is not JSON, or has no such value.

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
