"""The connector ``mqtt``: connects to a broker, makes images of the newest messages, and publishes writes."""

from __future__ import annotations

import secrets
import ssl
import time
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final

from paho.mqtt.client import MQTTv5, MQTTv311

from shmio.config.credentials import read_password
from shmio.config.model import MqttTls
from shmio.config.tls import client_context
from shmio.connectors.base import Connector, Lost, UnconfirmedError, WriteLostError
from shmio.connectors.browsing import Browsed, Wanted
from shmio.connectors.mqtt.browse import Listener
from shmio.connectors.mqtt.commands import Command, plan
from shmio.connectors.mqtt.link import PRIVATE_NAMES, Link, Publication, UnsupportedVersionError, version_of
from shmio.connectors.mqtt.options import MqttOptions
from shmio.connectors.mqtt.store import Store
from shmio.connectors.request_count import CycleRequests
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.model import Layout
from shmio.layout.values.write import Write
from shmio.libraries import check_paho
from shmio.wording import counted

TIMEOUTS: Final = 4
"""Maximum time for connecting, as a multiple of the option ``timeout``."""
FIRST_S: Final = 0.1
"""Maximum time in s for which a new connection waits for retained messages."""
ECHO_S: Final = 0.2
"""Maximum time in s for which an acknowledged write waits for the first message of its topic.

A broker may let a client publish on a topic and subscribe to it, but send it no messages of that topic.
"""


@dataclass
class _Sending:
    """The messages of a cycle's writes."""

    outcomes: list[str | Lost]
    commands: list[Command]
    until_s: float
    """When to stop waiting for acknowledgements, s of CLOCK_MONOTONIC."""
    left: deque[Command]
    sent: list[Command] = field(default_factory=list)
    ping: int = 0
    """Number of the PINGREQ that was sent after the messages with QoS 0; 0 if none was sent."""
    acknowledged_s: float = 0.0
    """When the last acknowledgement came, s of CLOCK_MONOTONIC; 0 before that."""


class MqttConnector(Connector):
    """Reads the topics of a layout's registers at a broker, and publishes commands."""

    Options = MqttOptions
    can_write = True
    register_quality = True
    register_options = frozenset(
        {"max_age_ms", "will", "time", "texts", "templates", "rebirth", "max_payload_bytes", "write_qos"}
    )
    path_options: ClassVar[tuple[str, ...]] = ("ca", "certificate", "key", "password_file")

    def __init__(self, options: MqttOptions, layout: Layout) -> None:
        self._options = options
        self._store = Store(layout, options)
        self._client_id = options.client_id or f"shmio-{secrets.token_hex(6)}"
        self._version = version_of(options.version)
        self._link: Link | None = None
        self._last_number = 0
        self._sending = _Sending([], [], 0.0, deque())
        check_paho(PRIVATE_NAMES)
        _secrets(options)  # here, a wrong file is a ConfigError; when connecting, it is a ConnectorError

    @classmethod
    def browse(cls, options: MqttOptions, wanted: Wanted) -> Browsed:
        """List the topics on which messages arrive within the time-out, and the values in them."""
        listener = Listener(options, wanted)
        client_id = options.client_id or f"shmio-browse-{secrets.token_hex(6)}"
        until_s = time.monotonic() + (TIMEOUTS - 1) * options.timeout / 1000
        versions = ["5", "3.1.1"] if options.version == "auto" else [options.version]
        for version in versions:
            link = Link(options, client_id, *_secrets(options), listener.take, lambda: None)
            try:
                if link.open(version_of(version), ["#"], until_s):
                    raise ConnectorError(f"{options.address} refuses a subscription to all topics")
                listener.wait(time.monotonic() + options.timeout / 1000)
                break
            except UnsupportedVersionError:
                if version == versions[-1]:
                    raise
            finally:
                link.close()
        return listener.found()

    @property
    def timeout_s(self) -> float:
        """The longest time that any method may block, in s."""
        return TIMEOUTS * self._options.timeout / 1000

    def describe(self) -> str:
        """Return, for the log, the broker's address and how the connection reaches it."""
        version = "5" if self._version == MQTTv5 else "3.1.1"
        secured = "TLS" if self._options.tls else "plain text"
        return f"to {self._options.address} as {self._client_id}, MQTT {version}, {secured}, {self._store.describe()}"

    def cycle_requests(self) -> CycleRequests:
        """Return a description with the number of subscriptions. A cycle sends no requests."""
        return CycleRequests(counted(len(self._store.filters), "subscription"), note="the broker sends their messages")

    def connect(self) -> None:
        """Connect to the broker, subscribe, and wait a short time for retained messages.

        Raises:
            ConnectorError: The broker cannot be reached, or refuses the client.

        """
        self.close()
        self._store.reset()
        until_s = time.monotonic() + (TIMEOUTS - 1) * self._options.timeout / 1000
        try:
            refused = self._open(until_s)
        except UnsupportedVersionError:
            if self._options.version != "auto" or self._version == MQTTv311:
                self.close()
                raise
            self.close()
            self._version = MQTTv311
            refused = self._open(until_s)
        for topic in refused:
            self._store.refuse(topic)
        link = self._link
        assert link is not None  # noqa: S101 - for the type checker
        self._ask(link)
        number = link.ping()  # the broker sends retained messages before the answer
        self._store.wait(
            lambda: self._store.complete or (not self._store.host and link.answered(number)),
            min(time.monotonic() + FIRST_S, until_s),
        )
        link.check()

    def take_over(self, other: MqttConnector) -> bool:
        """Take over the connection of ``other``, and the newest messages of the topics that both connectors have."""
        link, store = other._link, self._store
        if link is None:
            return False
        self._link, other._link = link, None
        self._client_id, self._version = other._client_id, other._version
        link.check()
        until_s = time.monotonic() + (TIMEOUTS - 1) * self._options.timeout / 1000
        fresh = link.hand_over(store.take, store.wake, lambda: store.inherit(other._store))
        wanted = {*store.filters}
        link.unsubscribe([one for one in other._store.filters if one not in wanted])
        for topic in link.subscribe(fresh, until_s):
            store.refuse(topic)
        return True

    def _ask(self, link: Link) -> None:
        """Ask Sparkplug nodes for their births, if some are due."""
        if self._options.rebirth:
            for topic, payload in self._store.requests(time.monotonic_ns()):
                link.publish(Publication(topic, payload, 0, retain=False))

    def _open(self, until_s: float) -> list[str]:
        store = self._store
        try:
            password, context = _secrets(self._options)
        except ConfigError as error:
            raise ConnectorError(str(error)) from None
        link = self._link = Link(
            self._options, self._client_id, password, context, store.take, store.wake, self._last_number
        )
        try:
            return link.open(self._version, store.filters, until_s)
        except UnsupportedVersionError:
            raise
        except ConnectorError:
            self.close()
            raise

    def read(self) -> bytes:
        """Return the image of the newest messages, after checking that the broker still answers.

        Raises:
            ConnectorError: The connection is lost, or the broker has not answered a ping in time.

        """
        link = self._link
        if link is None:
            raise ConnectorError(f"not connected to {self._options.address}")
        link.check()
        self._ask(link)
        return self._store.image(time.monotonic_ns())

    def close(self) -> None:
        """Close the connection. You may call this at any time and more than once."""
        if self._link is not None:
            self._link.close()
            self._last_number = self._link.last_number
            self._link = None

    # -- writing -------------------------------------------------------------------------------------------------------

    def send(self, writes: Sequence[Write]) -> None:
        """Publish the written values: first as many messages as may be unacknowledged at a time.

        :meth:`confirm` publishes the others.

        Raises:
            WriteLostError: The connection is lost.

        """
        link = self._link
        if link is None:
            raise WriteLostError(f"not connected to {self._options.address}", [Lost.UNSENT] * len(writes))
        until_s = time.monotonic() + self._options.timeout / 1000
        commands, refusals = plan(self._store, self._options, writes)
        self._sending = _Sending([*refusals], commands, until_s, deque(commands))
        link.forget()
        try:
            link.check()
            self._publish(link, self._sending)
        except ConnectorError as error:
            raise self._lost(error) from None

    def confirm(self, until_ns: int) -> list[str] | None:
        """Wait until the broker has acknowledged all messages, and has sent back those that this source reads.

        So no image that is requested later shows an older value.

        Raises:
            UnconfirmedError: The broker did not send all of them back in time, and images show older
                values.
            WriteLostError: The connection is lost, or the broker did not acknowledge all messages
                in time.

        """
        link, sending = self._link, self._sending
        if link is None:
            raise self._lost(ConnectorError(f"not connected to {self._options.address}"))
        until_s = until_ns / 1e9
        if not sending.acknowledged_s:
            try:
                while sending.left and link.await_room(min(until_s, sending.until_s)):
                    self._publish(link, sending)
                if sending.left or not self._acknowledged(link, sending, min(until_s, sending.until_s)):
                    if time.monotonic() < sending.until_s:
                        return None
                    raise ConnectorError(
                        f"no answer within {self._options.timeout} ms from {self._options.address} to PUBLISH"
                    )
            except ConnectorError as error:
                raise self._lost(error) from None
            self._take_outcomes(link, sending)
            self._store.expect_only(one.publication.topic for one in sending.sent if one.outcome == "")
            sending.acknowledged_s = time.monotonic()
        return self._confirm_echoes(link, sending, until_s)

    def _confirm_echoes(self, link: Link, sending: _Sending, until_s: float) -> list[str] | None:
        """Wait until the broker has sent the acknowledged messages back."""
        timeout_s = self._options.timeout / 1000
        if not self._store.await_expected(min(until_s, sending.acknowledged_s + timeout_s)):
            try:
                link.check()
            except ConnectorError as error:
                raise self._lost(error) from None
            outdated = self._store.outdated()
            wait_s = timeout_s if outdated else min(ECHO_S, timeout_s)
            if time.monotonic() < sending.acknowledged_s + wait_s:
                return None
            self._store.expect_nothing()
            if outdated:
                _doubt(sending.sent, outdated)
                _mark(sending.outcomes, sending.commands, sending.sent)
                raise UnconfirmedError(
                    f"{self._options.address} has acknowledged the message on {min(outdated)}, but has not sent it "
                    f"back within {self._options.timeout} ms",
                    sending.outcomes,
                )
        _mark(sending.outcomes, sending.commands, sending.sent)
        return [str(outcome) for outcome in sending.outcomes]

    def _publish(self, link: Link, sending: _Sending) -> None:
        """Publish messages until the maximum number is unacknowledged."""
        while sending.left and link.await_room(0.0):
            command = sending.left[0]
            message = command.publication
            if link.fits(message):
                self._store.expect(message.topic, message.payload, retain=message.retain)
                command.number = link.publish(message)
                self._store.wrote(command.values)
                sending.sent.append(command)  # from here on, the broker may have it
            else:
                command.outcome = "the message is larger than the broker accepts"
            sending.left.popleft()

    def _acknowledged(self, link: Link, sending: _Sending, until_s: float) -> bool:
        """Wait until the broker has received all messages; return whether it has by ``until_s``."""
        numbers = [one.number for one in sending.sent if one.number is not None]
        if not link.wait_acknowledged(numbers, until_s):
            return False
        if len(numbers) < len(sending.sent):
            sending.ping = sending.ping or link.ping()
            if not link.wait_answered(sending.ping, until_s):
                return False
            for one in sending.sent:
                one.outcome = "" if one.number is None else one.outcome
        return True

    def _take_outcomes(self, link: Link, sending: _Sending) -> None:
        """Store the broker's answer to each message with QoS 1."""
        for one in sending.sent:
            if one.number is not None:
                one.outcome = link.outcome(one.number, one.publication.topic, retain=one.publication.retain)

    def _lost(self, error: ConnectorError) -> WriteLostError:
        """Return the error about writes whose messages were not all acknowledged and sent back.

        A message that was not retained, and was not sent back, is not seen on the next connection.
        """
        sending = self._sending
        if self._link is not None:
            self._take_outcomes(self._link, sending)
        _doubt((one for one in sending.sent if not one.publication.retain), self._store.expect_nothing())
        _mark(sending.outcomes, sending.commands, sending.sent)
        return WriteLostError(str(error), sending.outcomes)


def _secrets(options: MqttOptions) -> tuple[str | None, ssl.SSLContext | None]:
    """Read password and certificates again, because their files may have been replaced.

    Raises:
        ConfigError: A file cannot be read, or its content is wrong.

    """
    password = read_password(options.password_file, "password_file") if options.password_file else None
    if not options.tls:
        return password, None
    return password, client_context(MqttTls(ca=options.ca, certificate=options.certificate, key=options.key), "")


def _doubt(commands: Iterable[Command], topics: Collection[str]) -> None:
    """Forget that the broker has accepted the messages on these topics."""
    for one in commands:
        if one.outcome == "" and one.publication.topic in topics:
            one.outcome = None


def _mark(outcomes: list[str | Lost], commands: Sequence[Command], sent: Sequence[Command]) -> None:
    """Store in ``outcomes`` what is known of each write, from all the messages that it needs."""
    begun = {id(command) for command in sent}
    needed: dict[int, list[Command]] = {}
    for command in commands:
        for number in command.writes:
            needed.setdefault(number, []).append(command)
    for number, own in needed.items():
        if outcomes[number]:
            continue
        if refusal := next((command.outcome for command in own if command.outcome), ""):
            outcomes[number] = refusal
        elif any(command.outcome is None for command in own):
            unsent = all(id(command) not in begun for command in own)
            outcomes[number] = Lost.UNSENT if unsent else Lost.UNKNOWN
