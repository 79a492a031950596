"""One connection to a broker. Its own thread receives the packets.

The broker keeps no session for the client, and so never delivers messages of an old connection on a new
one. The client sends a PINGREQ at least once in every half of the time-out. The answer shows that the
broker is alive, and that its messages are not delayed.
"""

from __future__ import annotations

import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeVar

from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage, MQTTv5, MQTTv311
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from shmio.config import Address
from shmio.connectors import tcp
from shmio.connectors.mqtt.options import MqttOptions
from shmio.errors import ConnectorError
from shmio.wording import printable

RECEIVE_BYTES: Final = 1 << 15
"""Number of bytes to receive from the socket at once."""
MAX_PACKET_BYTES: Final = (1 << 24) + (1 << 17)
"""Largest packet accepted, in bytes; a larger one ends the connection.

Such a packet has room for the largest payload that ``max_payload_bytes`` allows.
"""
MAX_FILTERS: Final = 8
"""Maximum number of filters in a SUBSCRIBE.

Some brokers (AWS IoT Core) disconnect clients that send more.
"""
MAX_IN_FLIGHT: Final = 20
HEAD_BYTES: Final = 128
"""Maximum size in bytes of a PUBLISH without its topic and payload."""
CLOSE_S: Final = 0.5
_TURN_S: Final = 1.0
_Result = TypeVar("_Result")
# Reason codes: MQTT 5.0, section 2.4. Paho uses the same numbers for MQTT 3.1.1.
_UNSUPPORTED: Final = "Unsupported protocol version"
_LOGIN: Final = frozenset({0x86, 0x87})
_TAKEN_OVER: Final = 0x8E
_NO_SUBSCRIBERS: Final = 0x10

PRIVATE_NAMES: Final = (
    "_create_socket",
    "_handle_pingresp",
    "_handle_publish",
    "_in_packet",
    "_last_mid",
    "_reset_sockets",
    "_send_pingreq",
    "_sock_recv",
)
"""The private names of paho's client that this module uses or replaces."""

log = logging.getLogger("shmio.source.mqtt")


class Deliver(Protocol):
    """Function that receives the messages of a connection."""

    def __call__(self, topic: str, payload: bytes, *, retained: bool) -> None:
        """Receive a message. ``retained`` is true if the broker had stored the message."""


class UnsupportedVersionError(ConnectorError):
    """The broker does not support this version of MQTT."""


class _Client(Client):
    """A paho client that limits the size of packets and reports the answers to its pings."""

    def __init__(self, opened: socket.socket, client_id: str, version: MQTTProtocolVersion, after: int) -> None:
        super().__init__(
            CallbackAPIVersion.VERSION2,
            client_id,
            clean_session=None if version == MQTTv5 else True,
            protocol=version,
            reconnect_on_failure=False,
        )
        self._opened = opened
        self.tls_error: ssl.SSLError | None = None
        self.violation = ""
        """How the broker broke the protocol, which ends the connection; empty if it did not."""
        self.on_pong: Callable[[], None] = lambda: None
        self.pings = self.pongs = 0
        """Numbers of PINGREQs that were sent and answered. Paho also sends some by itself."""
        self.pinged_ns = 0
        """When the client began to wait for the next answer to a PINGREQ, in ns of CLOCK_MONOTONIC.

        If all were answered, when it began to wait for the last answer.
        """
        self._pinging = threading.Lock()
        self._last_mid = after
        self._received, self._taken = b"", 0
        """What was received from the socket at once, and how many of these bytes paho has taken."""

    @property
    def last_number(self) -> int:
        """The packet identifier that was used last."""
        return self._last_mid

    def ping(self) -> int:
        """Send a PINGREQ at once, without waiting for paho's keep-alive time; return its number."""
        self._send_pingreq()
        return self.pings

    def _send_pingreq(self) -> MQTTErrorCode:
        with self._pinging:
            if self.pings == self.pongs:
                self.pinged_ns = time.monotonic_ns()
            self.pings += 1
            return super()._send_pingreq()

    def _create_socket(self) -> Any:
        return self._opened

    def _sock_recv(self, bufsize: int) -> bytes:
        if bufsize > MAX_PACKET_BYTES:
            self.violation = f"it sent a packet of {bufsize} bytes, but at most {MAX_PACKET_BYTES} are accepted"
            raise ConnectionAbortedError(self.violation)
        if self._taken == len(self._received):  # paho asks for a byte or two at a time, each with a system call
            try:
                self._received = super()._sock_recv(max(bufsize, RECEIVE_BYTES))
            except ssl.SSLError as error:  # with TLS 1.3 a broker rejects our certificate only after the handshake
                self.tls_error = error
                raise
            self._taken = 0
        taken = self._received[self._taken : self._taken + bufsize]
        self._taken += len(taken)
        return taken

    def close_sockets(self) -> None:
        """Close all sockets now, because an error's traceback may delay that this object is freed."""
        self._reset_sockets()

    def turn(self, timeout_s: float) -> bool:
        """Wait for the socket, and handle all packets that are received at once.

        Return whether the connection still exists.
        """
        code = self.loop(timeout_s)
        while code == MQTTErrorCode.MQTT_ERR_SUCCESS and self._taken < len(self._received):
            code = self.loop_read()
        return code == MQTTErrorCode.MQTT_ERR_SUCCESS

    def _handle_publish(self) -> MQTTErrorCode:
        if self._in_packet["command"] & 0x06 == 0x04:  # paho would store such messages without a limit
            self.violation = "it sent a message with QoS 2, which shmio did not request"
            return MQTTErrorCode.MQTT_ERR_PROTOCOL
        return super()._handle_publish()

    def _handle_pingresp(self) -> MQTTErrorCode:
        code = super()._handle_pingresp()
        with self._pinging:
            self.pongs = min(self.pongs + 1, self.pings)
            if self.pongs < self.pings:
                self.pinged_ns = time.monotonic_ns()
        self.on_pong()
        return code


@dataclass(frozen=True)
class Publication:
    """A message to publish."""

    topic: str
    payload: bytes
    qos: int
    retain: bool


class Link:
    """A connection to a broker. Create the object, then call :meth:`open`."""

    def __init__(
        self,
        options: MqttOptions,
        client_id: str,
        password: str | None,
        context: ssl.SSLContext | None,
        deliver: Deliver,
        wake: Callable[[], None],
        last_number: int = 0,
    ) -> None:
        """Prepare the connection.

        Args:
            options: The source's keys.
            client_id: The client's id.
            password: The password of the user; None if there is none.
            context: The TLS context; None for plain text.
            deliver: Called in the receiving thread with each message.
            wake: Called in the receiving thread when the connection is lost.
            last_number: The last packet identifier of the previous connection. Identifiers continue
                after it, so that a late acknowledgement of that connection fits no message of this
                one.

        """
        self._options, self._client_id, self._password, self._context = options, client_id, password, context
        self._deliver, self._wake = deliver, wake
        self._condition = threading.Condition()
        self._client: _Client | None = None
        self._thread: threading.Thread | None = None
        self._delivering = threading.Lock()
        """Held while a message is delivered."""
        self._closing = False
        self._failure = ""
        self._connack: ReasonCode | None = None
        self._subacks: dict[int, Sequence[ReasonCode]] = {}
        self._acks: dict[int, ReasonCode] = {}
        self._in_flight: set[int] = set()
        """The packet identifiers of the present writes' messages, whether acknowledged or not."""
        self._limits: dict[str, Any] = {}
        self.last_number = last_number
        self.version: MQTTProtocolVersion = MQTTv5

    @property
    def peer(self) -> Address:
        """Host and port of the broker."""
        return self._options.address

    # -- opening -------------------------------------------------------------------------------------------------------

    def open(self, version: MQTTProtocolVersion, filters: Iterable[str], until_s: float) -> list[str]:
        """Connect and subscribe.

        Args:
            version: The version of MQTT.
            filters: The topic filters to subscribe to.
            until_s: Time at which to give up, in s of CLOCK_MONOTONIC.

        Returns:
            The filters that the broker refuses.

        Raises:
            UnsupportedVersionError: The broker does not support the version.
            ConnectorError: The broker cannot be reached, or refuses the client.

        """
        self.version = version
        opened = self._connected_socket(until_s)
        client = self._client = _Client(opened, self._client_id, version, self.last_number)
        client.on_connect, client.on_disconnect = self._on_connect, self._on_disconnect
        client.on_subscribe, client.on_publish = self._on_subscribe, self._on_publish
        client.on_message, client.on_pong = self._on_message, self._on_pong
        client.on_socket_register_write = lambda *_: None  # only the receiving thread writes, so that packets never mix
        client.max_inflight_messages_set(0)  # this object counts the messages in flight
        if self._options.username is not None:
            client.username_pw_set(self._options.username, self._password)
        given: dict[str, Any] = {"clean_start": True} if version == MQTTv5 else {}
        try:
            client.connect(self.peer.host, self.peer.port, self._options.keep_alive_s, **given)
        except (OSError, ValueError) as error:
            opened.close()
            raise ConnectorError(f"cannot connect to {self.peer}: {error}") from None
        self._thread = threading.Thread(target=self._run, args=(client,), name="mqtt", daemon=True)
        self._thread.start()
        self._wait(lambda: self._connack is not None, self._soon(until_s), "to CONNECT")
        assert self._connack is not None  # noqa: S101 - for the type checker
        if self._connack.is_failure:
            if str(self._connack) == _UNSUPPORTED:
                raise UnsupportedVersionError(f"{self.peer} does not support this version of MQTT; set version")
            raise ConnectorError(f"{self.peer} refuses the connection: {self._refusal(self._connack)}")
        if self._options.retain and not self._limits.get("RetainAvailable", 1):
            raise ConnectorError(f"{self.peer} does not retain messages; remove retain = true")
        return self.subscribe(list(filters), until_s)

    def _connected_socket(self, until_s: float) -> socket.socket:
        peer = self.peer
        try:
            places = tcp.look_up(peer.host, peer.port, max(0.001, self._soon(until_s) - time.monotonic()))
            opened = tcp.connect(places, max(0.001, self._soon(until_s) - time.monotonic()))
        except TimeoutError:
            raise ConnectorError(f"no answer within {self._options.timeout} ms from {peer}") from None
        except ConnectionRefusedError:
            raise tcp.refused(peer) from None
        except OSError as error:
            raise ConnectorError(f"cannot connect to {peer}: {error.strerror or error}") from None
        if self._context is None:
            return opened
        try:
            opened.settimeout(max(0.001, self._soon(until_s) - time.monotonic()))
            return self._context.wrap_socket(opened, server_hostname=peer.host)
        except TimeoutError:
            opened.close()
            raise ConnectorError(
                f"no answer within {self._options.timeout} ms from {peer} to the TLS handshake"
            ) from None
        except OSError as error:
            opened.close()
            raise ConnectorError(f"{peer}: {_tls(error)}") from None

    def _soon(self, until_s: float) -> float:
        """Return when to stop waiting for a single answer, s of CLOCK_MONOTONIC."""
        return min(until_s, time.monotonic() + self._options.timeout / 1000)

    def subscribe(self, filters: Sequence[str], until_s: float) -> list[str]:
        """Subscribe to topic filters, and wait for the answers, at most until ``until_s``.

        Returns:
            The filters that the broker refuses.

        Raises:
            ConnectorError: The connection is lost, or there is no answer in time.

        """
        client = self._connected()
        asked: dict[int, Sequence[str]] = {}
        for at in range(0, len(filters), MAX_FILTERS):
            part = filters[at : at + MAX_FILTERS]
            qos = self._options.qos
            if self.version == MQTTv5:
                _, number = client.subscribe([(one, SubscribeOptions(qos)) for one in part])
            else:
                _, number = client.subscribe([(one, qos) for one in part])
            if number is None:
                raise ConnectorError(self._failure or f"the connection to {self.peer} was lost")
            asked[number] = part
        self._wait(lambda: asked.keys() <= self._subacks.keys(), self._soon(until_s), "to SUBSCRIBE")
        refused: list[str] = []
        for number, part in asked.items():
            codes = self._subacks.pop(number)
            if len(codes) != len(part):
                raise ConnectorError(f"{self.peer} broke the protocol: it answered {len(codes)} of {len(part)} filters")
            refused += [one for one, code in zip(part, codes, strict=True) if code.is_failure]
        return refused

    def unsubscribe(self, filters: Sequence[str]) -> None:
        """End subscriptions, without waiting for the answers.

        Raises:
            ConnectorError: The connection is lost.

        """
        client = self._connected()
        for at in range(0, len(filters), MAX_FILTERS):
            client.unsubscribe([*filters[at : at + MAX_FILTERS]])

    def _connected(self) -> _Client:
        """Return the open client. Raise ConnectorError if the connection is lost."""
        client = self._client
        if client is None or self._failure:
            raise ConnectorError(self._failure or f"not connected to {self.peer}")
        return client

    def hand_over(self, deliver: Deliver, wake: Callable[[], None], inherit: Callable[[], _Result]) -> _Result:
        """From now on, deliver messages to another object.

        Args:
            deliver: As for the constructor.
            wake: As for the constructor.
            inherit: Called between the last message to the old object and the first one to the new
                object.

        Returns:
            The result of ``inherit``.

        """
        with self._delivering:
            found = inherit()
            self._deliver, self._wake = deliver, wake
            return found

    def close(self) -> None:
        """Close the connection. You may call this more than once."""
        self._closing = True
        client, thread = self._client, self._thread
        if client is None:
            return
        self.last_number = client.last_number
        if thread is not None and thread.is_alive() and not self._failure:
            client.disconnect()
            thread.join(CLOSE_S)
        _close_socket(client)
        if thread is not None:
            thread.join(CLOSE_S)
        client.close_sockets()
        # Break the reference cycle with the client, so that it is freed soon.
        client.on_connect = client.on_disconnect = client.on_subscribe = client.on_publish = client.on_message = None
        client.on_pong = lambda: None
        self._client = None

    # -- the connection as it is ---------------------------------------------------------------------------------------

    def check(self) -> None:
        """Check the connection, and send a ping if one is due.

        Raises:
            ConnectorError: The connection is lost, or the broker has not answered a ping in time.

        """
        client = self._connected()
        silent_ns, timeout_ns = time.monotonic_ns() - client.pinged_ns, self._options.timeout * 1_000_000
        if client.pongs < client.pings:
            if silent_ns > timeout_ns:
                raise ConnectorError(f"no answer within {self._options.timeout} ms from {self.peer}")
        elif silent_ns > timeout_ns // 2:
            client.ping()

    def ping(self) -> int:
        """Send a PINGREQ; return its number, for :meth:`answered`."""
        return self._client.ping() if self._client is not None else 0

    def answered(self, number: int) -> bool:
        """Return whether the broker has answered a PINGREQ; also return True if the connection is lost."""
        return self._client is None or self._client.pongs >= number or bool(self._failure)

    # -- publishing ----------------------------------------------------------------------------------------------------

    def fits(self, publication: Publication) -> bool:
        """Return whether the message is small enough for the broker."""
        size = HEAD_BYTES + len(publication.topic.encode()) + len(publication.payload)
        return bool(size <= self._limits.get("MaximumPacketSize", size))

    def await_room(self, until_s: float) -> bool:
        """Wait until so few messages are unacknowledged that another one may be sent.

        Returns:
            Whether another message may be sent by ``until_s``, a time of CLOCK_MONOTONIC.

        Raises:
            ConnectorError: The connection is lost.

        """
        most = min(MAX_IN_FLIGHT, self._limits.get("ReceiveMaximum", MAX_IN_FLIGHT))
        return self._seen(lambda: len(self._in_flight - self._acks.keys()) < most, until_s)

    def publish(self, publication: Publication) -> int | None:
        """Publish a message, without waiting for its acknowledgement.

        Returns:
            The message's number, for :meth:`outcome`; None if the message has QoS 0.

        Raises:
            ConnectorError: The connection is lost, and nothing was sent.

        """
        client = self._connected()
        properties = None
        qos = min(publication.qos, self._limits.get("MaximumQoS", 1))
        if self.version == MQTTv5 and not publication.retain:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.MessageExpiryInterval = max(1, self._options.timeout // 1000)  # the broker drops late commands
        info = client.publish(publication.topic, publication.payload, qos, publication.retain, properties)
        if info.rc == MQTTErrorCode.MQTT_ERR_NO_CONN:
            raise ConnectorError(self._failure or f"the connection to {self.peer} was lost")
        if not qos:
            return None
        self._in_flight.add(info.mid)
        return info.mid

    def wait_acknowledged(self, numbers: Iterable[int], until_s: float) -> bool:
        """Wait until the broker has acknowledged these messages; return False if it has not by ``until_s``.

        Raises:
            ConnectorError: The connection is lost.

        """
        wanted = set(numbers)
        return self._seen(lambda: wanted <= self._acks.keys(), until_s)

    def outcome(self, number: int, topic: str, *, retain: bool) -> str | None:
        """Return "" if the broker has accepted a message, or why not; None if the broker has not answered yet."""
        code = self._acks.get(number)
        if code is None:
            return None
        if code.is_failure:
            return f"the broker refuses the message: {code}"
        if code.value == _NO_SUBSCRIBERS and not retain:
            return f"nobody subscribes to {topic}: the broker dropped the message"
        return ""

    def forget(self) -> None:
        """Forget the messages of the last writes, because new messages will have the same numbers."""
        with self._condition:
            self._in_flight.clear()
            self._acks.clear()

    def wait_answered(self, number: int, until_s: float) -> bool:
        """Wait until the broker has answered a PINGREQ, and so has read all messages before it.

        Returns:
            False if there is no answer by ``until_s``, a time of CLOCK_MONOTONIC.

        Raises:
            ConnectorError: The connection is lost.

        """
        return self._seen(lambda: self._client is not None and self._client.pongs >= number, until_s)

    def _seen(self, condition: Callable[[], bool], until_s: float) -> bool:
        """Wait until ``condition`` holds, at most until ``until_s``; return whether it holds.

        Raises:
            ConnectorError: The connection was lost while waiting.

        """
        with self._condition:
            self._condition.wait_for(lambda: condition() or self._failure, max(0.0, until_s - time.monotonic()))
            if condition():
                return True
        if self._failure:
            raise ConnectorError(self._failure)
        return False

    def _wait(self, condition: Callable[[], bool], until_s: float, to_what: str) -> None:
        if not self._seen(condition, until_s):
            raise ConnectorError(f"no answer within {self._options.timeout} ms from {self.peer} {to_what}")

    # -- in the thread -------------------------------------------------------------------------------------------------

    def _run(self, client: _Client) -> None:
        why = ""
        try:
            while not self._closing and client.turn(_TURN_S):
                pass
        except Exception as error:  # noqa: BLE001  paho raises errors of all kinds for wrong packets
            why = (
                f"{self.peer} sent a packet that cannot be read: {type(error).__name__}: {printable(str(error))[:200]}"
            )
        _close_socket(client)
        self._fail(why or self._why(client))

    def _why(self, client: _Client) -> str:
        if client.violation:
            return f"{self.peer} broke the protocol: {client.violation}"
        if client.tls_error is not None:
            return f"{self.peer}: {_tls(client.tls_error)}"
        if self._connack is None:
            missing = "TLS there (mqtts://)" if self._context is None else "a client certificate (certificate, key)"
            older = ", or MQTT 3.1.1 (version)" if self.version == MQTTv5 else ""
            return f"{self.peer} closed the connection before it accepted the login: it may expect {missing}{older}"
        hint = f"; does another client connect as {self._client_id} (client_id)?" if self._options.client_id else ""
        return f"the connection to {self.peer} was lost{hint}"

    def _fail(self, why: str) -> None:
        with self._condition:
            self._failure = self._failure or why
            self._condition.notify_all()
        self._wake()

    def _on_connect(
        self, _client: Client, _data: Any, _flags: ConnectFlags, code: ReasonCode, properties: Properties | None
    ) -> None:
        self._limits = dict(vars(properties)) if properties is not None else {}
        with self._condition:
            self._connack = code
            self._condition.notify_all()

    def _on_disconnect(
        self, _client: Client, _data: Any, flags: DisconnectFlags, code: ReasonCode, _properties: Properties | None
    ) -> None:
        if flags.is_disconnect_packet_from_server:
            self._fail(f"{self.peer} ended the connection: {self._refusal(code)}")

    def _on_subscribe(
        self, _client: Client, _data: Any, number: int, codes: Sequence[ReasonCode], _properties: Properties | None
    ) -> None:
        with self._condition:
            self._subacks[number] = codes
            self._condition.notify_all()

    def _on_publish(
        self, _client: Client, _data: Any, number: int, code: ReasonCode, _properties: Properties | None
    ) -> None:
        with self._condition:
            self._acks[number] = code
            self._condition.notify_all()

    def _on_message(self, _client: Client, _data: Any, message: MQTTMessage) -> None:
        try:
            topic = message.topic
        except UnicodeDecodeError:  # no register has such a topic
            return
        if self._closing:
            return
        try:
            with self._delivering:
                self._deliver(topic, bytes(message.payload), retained=message.retain)
        except Exception:
            log.exception("a message on %s could not be handled", printable(topic))
            self._fail(f"a message on {printable(topic)[:200]} could not be handled; see the log")
            raise

    def _on_pong(self) -> None:
        with self._condition:
            self._condition.notify_all()
        self._wake()

    def _refusal(self, code: ReasonCode) -> str:
        if code.value in _LOGIN:
            return f"{code}: check username, password_file, and the accounts of the broker"
        if code.value == _TAKEN_OVER:
            return f"another client has connected as {self._client_id}; give one of them another client_id"
        return printable(str(code))


def version_of(name: str) -> MQTTProtocolVersion:
    """Return paho's constant for a version of MQTT."""
    return MQTTv311 if name == "3.1.1" else MQTTv5


def _close_socket(client: Client) -> None:
    made = client.socket()
    if made is not None:
        with suppress(OSError):
            made.close()


def _tls(error: OSError) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted ({error.verify_message}); check ca, and the host's name in url"
    if isinstance(error, ssl.SSLError):
        if "_ALERT_" in (error.reason or ""):
            return f"it refuses TLS with shmio ({error.reason}); check certificate and key, which it may require"
        return f"the TLS handshake failed ({error.reason or 'it ended the connection'}); check the port of url"
    return f"it ended the TLS handshake ({error.strerror or error}); check the port of url"
