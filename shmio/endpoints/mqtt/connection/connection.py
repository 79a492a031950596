"""Connections to the broker. They reconnect with growing waits, and never block.

Commands and their results have a connection of their own. On the connection for values, the
broker's acknowledgements would wait behind all commands. A flood of commands with QoS 0 would then
delay values, because the protocol does not limit their number (MQTT 5.0, section 4.9).
"""

from __future__ import annotations

import logging
import selectors
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage, MQTTv5, MQTTv311
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from shmio.config import Mqtt
from shmio.endpoints.mqtt.connection.attempt import (
    CONNECT_S,
    SLOW,
    ConnectAttempt,
    ended,
    refusal,
)
from shmio.endpoints.mqtt.connection.broker_client import BrokerClient
from shmio.endpoints.mqtt.connection.reconnect import ReconnectPolicy, Target
from shmio.endpoints.mqtt.connection.socket_io import BATCH, SocketIo
from shmio.endpoints.mqtt.topics import Message
from shmio.layout.topic import shorten

STABLE_S: Final = 5.0
"""Time in s after which a connection counts as stable. The loss of a stable connection resets the back-off."""
MAX_REASON_LENGTH: Final = 300
"""Maximum length of the text with the problems of all brokers, in characters."""
SUBSCRIBE_S: Final = CONNECT_S
"""Time limit in s for the broker's SUBACK to the subscription to commands."""
MOST_IN_FLIGHT: Final = 1000
"""Maximum number of unacknowledged messages."""
FEW_IN_FLIGHT: Final = 4
"""Maximum number of unacknowledged messages on connections that receive commands.

The broker may send this many commands in one turn, and each takes time.
"""
HEAD_BYTES: Final = 128
"""Maximum size in bytes of a packet without its topic and its payload."""
OFTEN: Final = 4
OFTEN_S: Final = 60.0
"""If ``OFTEN`` connections are lost within this time in s, the reported problem names a likely cause."""
REFUSED_S: Final = 10.0
"""Time in s for which a refused message stays the current problem if the broker accepts later messages."""
FAILURE: Final = 0x80
"""The least reason code that means a failure (MQTT 5.0, section 2.4)."""
WITH_WILL: Final = "Disconnect with will message"
_WATCHED: Final = 1
"""Identifier of the subscription to the bridge's own topics."""

log = logging.getLogger("shmio.mqtt")


class Limits(NamedTuple):
    """The limits that a broker states in its CONNACK (MQTT 5.0, section 3.2.2.3).

    With MQTT 3.1.1, there are no such limits. ``in_flight`` is the maximum number of unacknowledged
    messages. ``packet_bytes`` is None if packets may have any size.
    """

    in_flight: int = MOST_IN_FLIGHT
    packet_bytes: int | None = None
    qos: int = 1
    retain: bool = True
    identifiers: bool = True
    """True if subscriptions may have an identifier. The broker adds it to the messages of the subscription."""

    @classmethod
    def from_connack(cls, properties: Properties | None, most: int) -> Limits:
        """Read the limits in a CONNACK.

        Args:
            properties: The properties of the CONNACK; None with MQTT 3.1.1.
            most: Maximum number of unacknowledged messages that the bridge wants.

        """
        given = vars(properties) if properties is not None else {}
        return cls(
            min(most, given.get("ReceiveMaximum", most)),
            given.get("MaximumPacketSize"),
            min(1, given.get("MaximumQoS", 1)),
            bool(given.get("RetainAvailable", 1)),
            bool(given.get("SubscriptionIdentifierAvailable", 1)),
        )

    def fit(self, message: Message) -> bool:
        """Return whether a message is small enough for the broker."""
        if self.packet_bytes is None:
            return True
        return HEAD_BYTES + len(message.topic.encode()) + len(message.payload) <= self.packet_bytes


def _subscription(*, retained: bool) -> SubscribeOptions:
    """Return the options to subscribe to other clients' messages, with their retain flags.

    If ``retained`` is True, the broker also sends retained messages.
    """
    before = SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE if retained else SubscribeOptions.RETAIN_DO_NOT_SEND
    return SubscribeOptions(1, noLocal=True, retainAsPublished=True, retainHandling=before)


def _name(code: int) -> str:
    """Return the name of the reason code of a PUBACK."""
    try:
        return str(ReasonCode(PacketTypes.PUBACK, identifier=code))
    except (AssertionError, KeyError):  # the code is not in the standard
        return f"reason code {code:#x}"


class ConnectionProblems:
    """The current problem of a connection. A problem is logged when it becomes current."""

    def __init__(self) -> None:
        self.problem = ""
        """The current problem; empty if there is none."""
        self.refused = 0
        """Number of messages that the broker refused."""
        self._refused_s = 0.0
        self._subscription_problem = ""
        self._lost_s: deque[float] = deque(maxlen=OFTEN)

    def report(self, problem: str) -> None:
        """Set the current problem, and log it if it is new."""
        if problem != self.problem:
            log.warning("%s", problem)
        self.problem = problem

    def connection_lost(self, problem: str, client_id: str) -> str:
        """Count a lost connection.

        Returns:
            The problem; if connections are lost often, with a likely cause.
        """
        self._lost_s.append(time.monotonic())
        if len(self._lost_s) < OFTEN or self._lost_s[-1] - self._lost_s[0] > OFTEN_S:
            return problem
        return f"{problem}, again and again; does another client connect as {client_id} (mqtt.client_id)?"

    def clear(self) -> None:
        """Forget the problem, because the connection is up."""
        self.problem = self._subscription_problem = ""

    def subscription_refused(self, problem: str) -> None:
        """Report that the broker refuses the subscription to commands."""
        self._subscription_problem = problem
        self.report(problem)

    def message_refused(self, problem: str) -> None:
        """Count a refused message, and report it unless there is a problem already."""
        self.refused += 1
        self._refused_s = time.monotonic()
        if not self.problem:  # the first refusal represents those that follow
            self.report(problem)

    def message_accepted(self) -> None:
        """Clear the problem of refused messages, if the last refusal was at least ``REFUSED_S`` ago."""
        if self.problem and time.monotonic() >= self._refused_s + REFUSED_S:
            self.problem = self._subscription_problem


def is_watched(message: MQTTMessage) -> bool:
    """Return whether a message came from another client on one of the bridge's own topics."""
    return _WATCHED in (vars(message.properties) if message.properties else {}).get("SubscriptionIdentifier", ())


class BrokerConnection:
    """A connection to a broker, which reconnects after a loss. Use it only in the bridge's thread.

    It registers its socket with ``selector``. Call the ``data`` of the selector's key when the
    socket is ready.
    """

    def __init__(
        self,
        policy: ReconnectPolicy,
        selector: selectors.BaseSelector,
        wake: Callable[[], object],
        will: Callable[[], Message | None],
        most: int,
    ) -> None:
        """Prepare to connect. :meth:`run_once` connects.

        Args:
            policy: Chooses the broker and the waits.
            selector: The connection registers its socket here.
            wake: Called, from any thread, when :meth:`run_once` must run.
            will: Returns the will for each CONNECT.
            most: Maximum number of unacknowledged messages, in each direction.

        """
        self.up = False
        self.is_ready: Callable[[], bool] = lambda: True
        """Called after CONNACK until it returns True. Only then is the connection ``up``."""
        self.came_up = False
        """True once the connection has come up, until the caller resets it."""
        self.on_lost: Callable[[list[Message]], None] = lambda _: None
        """Called with the unacknowledged messages when the connection is lost."""
        self.problems = ConnectionProblems()
        self.connects = 0
        self.sent_bytes = 0
        """Number of bytes in the topics and payloads that were sent."""
        self.subscribed = False
        """True if the broker has answered the last subscription."""
        self._policy, self._selector, self._wake, self._will, self._most = policy, selector, wake, will, most
        self.on_message: Callable[[MQTTMessage], None] = lambda _: None
        """Called with each message that arrives."""
        self._client: BrokerClient | None = None
        self._socket_io: SocketIo | None = None
        self._target: Target | None = None
        self._problem_of: dict[Target | None, str] = {}
        """The last problem of each broker that was tried since the last connection."""
        self._attempt: ConnectAttempt | None = None
        self._protocol = MQTTv5
        self._deadline_s: float | None = None
        """Deadline for the broker's CONNACK; None if the connection does not wait for it."""
        self._retry_s = self._up_s = self._misc_s = 0.0
        self._new_will: Message | None = None  # not yet sent to any broker
        self._in_flight: dict[int, Message] = {}
        self._limits = Limits()
        self._subscription = 0  # packet identifier of the subscription to commands

    @property
    def problem(self) -> str:
        """Why there is no connection, or what the broker refuses; empty if there is no problem."""
        return self.problems.problem

    @property
    def at(self) -> Target | None:
        """The broker that has accepted the CONNECT; None if none has."""
        return None if self._client is None or self._deadline_s is not None else self._target

    @property
    def mqtt5(self) -> bool:
        """True if the connection is up and uses MQTT 5."""
        return self.up and self._protocol == MQTTv5

    @property
    def room(self) -> int:
        """Number of messages that can be sent now without being queued in memory."""
        if not self.up or self._socket_io is None or self._socket_io.writing:
            return 0
        most = self._limits.in_flight
        room = min(BATCH, most - len(self._in_flight))
        if self._target is not None and self._target.transport == "unix":
            # Else a message would follow each acknowledgement, and the batches would be small. With TCP, the broker
            # may hold acknowledgements back until it has received something.
            return room if room >= min(BATCH, most // 4) else 0
        return room

    @property
    def in_flight(self) -> int:
        """Number of messages that the broker has not acknowledged."""
        return len(self._in_flight)

    # ---- the loop ----------------------------------------------------------------------------------------------------

    def run_once(self) -> float:
        """Do the work that is due. Return the time in s after which to call this method again."""
        now_s = time.monotonic()
        if self._attempt is not None and self._attempt.over:
            self._take(self._attempt)
        if self._attempt is None and self._client is None:
            if now_s < self._retry_s:
                return self._retry_s - now_s
            self._new_will = self._new_will or self._will()
            self._attempt = ConnectAttempt(self._policy, self._protocol, self._new_will, self._most, self._wake)
            self._target = self._attempt.target
        if self._client is None:
            if self._attempt is not None and self._attempt.slow:
                self.problems.report(f"broker {self._target}: {SLOW}")
            return CONNECT_S
        if self._deadline_s is not None:
            if now_s >= self._deadline_s:
                self.drop("it does not answer")
        else:
            if not self.up and self.is_ready():
                self.problems.clear()
                self._problem_of.clear()
                self.up, self.came_up, self._up_s = True, True, now_s
                self.connects += 1
            if now_s >= self._misc_s:
                self._misc_s = now_s + 1.0
                self._client.loop_misc()
        return 1.0 if self._socket_io is None else self._socket_io.run_once()

    def _take(self, attempt: ConnectAttempt) -> None:
        """Handle the end of an attempt."""
        self._attempt = None
        client, made = attempt.client, attempt.socket
        self._new_will = None if attempt.sent else self._new_will
        if client is None or made is None:
            self._fail(attempt.problem)
            return
        self._deadline_s = time.monotonic() + CONNECT_S
        client.on_connect = self._connected
        client.on_disconnect = self._disconnected
        client.on_subscribe = self._subscribed
        self._client, self._socket_io = client, SocketIo(client, made, self._selector, self.drop)
        client.on_acknowledged = self._acknowledged
        client.on_message = self._socket_io.counting(self._received)

    # ---- callbacks of the client -------------------------------------------------------------------------------------

    def _connected(
        self, client: Client, _data: Any, _flags: ConnectFlags, code: ReasonCode, properties: Properties | None
    ) -> None:
        if client is not self._client:
            return
        if code.is_failure:
            if self._protocol == MQTTv5 and str(code) == "Unsupported protocol version":
                self._fall_back()
            else:
                self._fail(f"broker {self._target}: {refusal(code, self._policy)}")
            return
        self._limits = Limits.from_connack(properties, self._most)
        self._deadline_s, self._misc_s = None, time.monotonic() + 1.0
        version = "5" if self._protocol == MQTTv5 else "3.1.1"
        log.info(
            "the bridge is connected to broker %s as %s, by MQTT %s", self._target, self._policy.client_id, version
        )

    def _disconnected(
        self, client: Client, _data: Any, flags: DisconnectFlags, code: ReasonCode, _properties: Properties | None
    ) -> None:
        if self._client is None or client is not self._client:
            return
        tls, by_broker = self._policy.settings.tls is not None, flags.is_disconnect_packet_from_server
        why = ended(self._client.tls_error, up=self.at is not None, tls=tls)
        self.drop(refusal(code, self._policy) if by_broker else why)

    def _acknowledged(self, identifier: int, code: int) -> None:
        message = self._in_flight.pop(identifier, None)
        if message is not None and code >= FAILURE:
            self.problems.message_refused(f"broker {self._target} refuses messages: {_name(code)}: {message.topic}")
        else:
            self.problems.message_accepted()

    def _received(self, client: Client, _data: Any, message: MQTTMessage) -> None:
        if client is self._client:
            self.on_message(message)

    def _subscribed(
        self, client: Client, _data: Any, mid: int, codes: Sequence[ReasonCode], _properties: Properties | None
    ) -> None:
        if client is not self._client or mid != self._subscription:
            return
        self.subscribed = True
        if refused := [code for code in codes if code.is_failure]:
            self.problems.subscription_refused(
                f"broker {self._target} refuses shmio's subscription, so no command can arrive: {refused[0]}"
            )

    # ---- dropping the connection -------------------------------------------------------------------------------------

    def drop(self, problem: str, *, politely: bool = False) -> None:
        """Drop the connection, or the attempt that is waiting for CONNACK.

        Args:
            problem: Why it is dropped.
            politely: Whether to send DISCONNECT, so that the broker does not publish the will. Do
                not set this in a callback of the client.

        """
        problem = f"broker {self._target}: {problem}"
        if politely and self._client is not None:
            self._client.on_disconnect = None
            self._client.disconnect()
            self._client.loop_write()
        if self.up:
            lost = list(self._in_flight.values())
            if time.monotonic() - self._up_s >= STABLE_S:
                self._policy.reset_failures()
            self._fail(self.problems.connection_lost(problem, self._policy.client_id))
            self.on_lost(lost)
        elif self._protocol == MQTTv5 and self._deadline_s is not None:
            self._fall_back()  # some brokers without MQTT 5 do not answer
        else:
            self._fail(problem)

    def _fall_back(self) -> None:
        """Try the same broker again at once, with MQTT 3.1.1."""
        self._close()
        self._protocol = MQTTv311
        self._policy.retry_same()
        self._retry_s = 0.0
        self._wake()

    def _fail(self, problem: str) -> None:
        self._close()
        self._protocol = MQTTv5
        # The status shows the last problem of each broker, because all are tried in turn.
        self._problem_of[self._target] = problem
        self.problems.report(
            shorten("; ".join(self._problem_of[one] for one in sorted(self._problem_of, key=str)), MAX_REASON_LENGTH)
        )
        self._retry_s = time.monotonic() + self._policy.wait_s()

    def _close(self) -> None:
        socket_io, self._socket_io, self._client = self._socket_io, None, None
        self.up, self.came_up, self.subscribed, self._deadline_s = False, False, False, None
        self._in_flight = {}
        if socket_io is not None:
            socket_io.close()

    # ---- sending and subscribing -------------------------------------------------------------------------------------

    def send(self, message: Message, properties: Properties | None = None) -> None:
        """Queue a message for :meth:`push`. Without a connection, drop it."""
        client, limits = self._client, self._limits
        if client is None or not self.up:
            return
        if not limits.fit(message):
            self.problems.message_refused(
                f"broker {self._target} takes at most {limits.packet_bytes} bytes: "
                f"a message for {message.topic} is larger"
            )
            return
        qos, retain = message.qos and limits.qos, message.retain and limits.retain
        identifier = client.queue_message(
            message.topic, message.payload, qos, properties, retain=retain, unacknowledged=self._in_flight
        )
        self.sent_bytes += len(message.topic.encode()) + len(message.payload)
        if qos:
            self._in_flight[identifier] = message
        else:
            self.problems.message_accepted()

    def push(self) -> None:
        """Write queued messages to the socket."""
        if self._socket_io is not None:
            self._socket_io.push()

    def is_unacknowledged(self, message: Message) -> bool:
        """Return whether this very message object was sent and has not been acknowledged."""
        return any(one is message for one in self._in_flight.values())

    def subscribe(self, filters: Sequence[str], *, retained: bool = False) -> None:
        """Subscribe to these topic filters.

        Without ``retained``, MQTT 5 brokers do not send retained messages. MQTT 3.1.1 brokers send
        them with the retain flag, which new messages from bridged brokers may also have.
        """
        client = self._client
        self.subscribed = not filters
        if client is None or not filters:
            return
        new = self._protocol == MQTTv5
        options: Any = _subscription(retained=retained) if new else 1
        _, mid = client.subscribe([(one, options) for one in filters])
        self._subscription = self._subscription if retained or mid is None else mid

    def watch(self, filters: Sequence[str]) -> None:
        """Subscribe to other clients' messages on the bridge's own topics; :func:`is_watched` recognizes them.

        Without MQTT 5, this does nothing.
        """
        if self._client is None or not (filters and self.mqtt5 and self._limits.identifiers):
            return  # we would receive our own messages, and could not tell them from retained ones
        properties = Properties(PacketTypes.SUBSCRIBE)  # type: ignore[no-untyped-call]
        properties.SubscriptionIdentifier = _WATCHED
        options: Any = _subscription(retained=False)
        self._client.subscribe([(one, options) for one in filters], properties=properties)

    def unwatch(self, filters: Sequence[str]) -> None:
        """End the subscription that :meth:`watch` has made."""
        if self._client is not None and filters and self.mqtt5:
            self._client.unsubscribe(list(filters))

    def recall(self, filters: Sequence[str]) -> None:
        """Ask the broker to send the retained messages that match these filters, once."""
        self.subscribe(filters, retained=True)
        if self._client is not None and filters:
            self._client.unsubscribe(list(filters))

    def open(self) -> None:
        """Allow connections again, after :meth:`close`."""
        self._protocol, self._retry_s = MQTTv5, 0.0
        self.problems.clear()
        self._problem_of.clear()

    def close(self, *, will: bool = False) -> None:
        """Disconnect. Messages that have been written to the socket will still arrive.

        Args:
            will: Whether the broker is to publish the will. This needs MQTT 5.

        """
        if self._client is not None:
            self._client.on_disconnect = None
            if self.up:
                reason = ReasonCode(PacketTypes.DISCONNECT, WITH_WILL) if will and self.mqtt5 else None
                self._client.disconnect(reason)
                self._client.loop_write()
        self._close()
        self._retry_s = float("inf")
        if self._attempt is not None:
            self._attempt.abandon()
            self._attempt = None


class CommandConnection:
    """The connection for commands and their results. Use it only in the bridge's thread."""

    def __init__(
        self,
        settings: Mqtt,
        client_id: str,
        selector: selectors.BaseSelector,
        wake: Callable[[], object],
        filters: Callable[[], Sequence[str]],
        answers: Callable[[], Sequence[str]],
    ) -> None:
        """Create the connection. :meth:`run_once` connects.

        Args:
            settings: The configuration's ``[mqtt]`` section.
            client_id: The client id of this connection.
            selector: The connection registers its socket here.
            wake: Called, from any thread, when :meth:`run_once` must run.
            filters: Returns the topic filters to subscribe to for commands.
            answers: Returns the topic filters to subscribe to for the results of commands.

        """
        self._policy = ReconnectPolicy(settings, client_id, ())
        self.connection = BrokerConnection(self._policy, selector, wake, lambda: None, FEW_IN_FLIGHT)
        self.connection.close()
        self._filters, self._answers = filters, answers
        self._at: Target | None = None
        self._deadline_s = 0.0
        """Deadline for the broker's SUBACK."""

    @property
    def ready(self) -> bool:
        """True if commands can arrive, or if it is known why they cannot."""
        return self.connection.subscribed or bool(self.connection.problem)

    @property
    def problem(self) -> str:
        """Why no commands arrive or no results are sent; empty if there is no problem."""
        return f"commands: {self.connection.problem}" if self.connection.problem else ""

    def run_once(self, at: Target | None) -> float:
        """Connect to the broker that receives the values, and do the work that is due.

        Args:
            at: The broker that receives the values; None if there is no connection for values.

        Returns:
            The time in s after which to call this method again.

        """
        if at is not self._at:
            self._at = at
            self.connection.close()
            if at is not None:
                self._policy.use_only(at)
                self.connection.open()
        rest_s = self.connection.run_once()
        if self.connection.came_up:
            self.connection.came_up = False
            self.subscribe()
        if not self.connection.up or self.connection.subscribed:
            return rest_s
        left_s = self._deadline_s - time.monotonic()
        if left_s <= 0:  # the connection for values waits for this one
            self.connection.drop("it does not answer to SUBSCRIBE")
        return max(0.0, min(rest_s, left_s))

    def subscribe(self) -> None:
        """Subscribe to the commands for all present sources."""
        if self.connection.up:
            self.connection.subscribe(self._filters())
            self.watch()
            self.connection.push()
            self._deadline_s = time.monotonic() + SUBSCRIBE_S

    def watch(self) -> None:
        """Subscribe to other clients' messages on the topics of results."""
        self.connection.watch(self._answers())

    def unwatch(self) -> None:
        """End the subscription that :meth:`watch` has made."""
        self.connection.unwatch(self._answers())
