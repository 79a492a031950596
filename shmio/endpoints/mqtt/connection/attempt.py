"""Makes one attempt to connect, and finds out why an attempt has failed.

Each attempt runs in its own thread, because files, DNS, TCP and TLS may block.
"""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, cast

from paho.mqtt.client import Client, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from shmio.config.credentials import read_password
from shmio.config.tls import client_context
from shmio.endpoints.mqtt.broker.directory import BRIDGE, secret_id, secret_of
from shmio.endpoints.mqtt.connection.broker_client import BrokerClient
from shmio.endpoints.mqtt.connection.reconnect import ReconnectPolicy, Target
from shmio.endpoints.mqtt.topics import Message
from shmio.errors import ConfigError

CONNECT_S: Final = 4.0
"""Time limit in s for each step: the TCP connection, the TLS handshake, and CONNACK."""
SLOW_S: Final = 15.0
SLOW: Final = "no answer yet: the broker, the name server, or the file system of mqtt.tls or mqtt.password_file is slow"
MAX_PACKET_BYTES: Final = 1 << 21
"""Maximum packet size that the bridge accepts, in bytes. Only brokers with MQTT 5 are told this number."""
# Reason codes: MQTT 5.0, section 2.4. Paho uses the same numbers for MQTT 3.1.1.
_WHO: Final = frozenset({0x86, 0x87})
_BUSY: Final = frozenset({0x88, 0x89, 0x97, 0x9F})
_TAKEN_OVER: Final = 0x8E


class ConnectAttempt:
    """An attempt to connect to the next broker, in a thread that starts at once."""

    def __init__(
        self,
        policy: ReconnectPolicy,
        protocol: MQTTProtocolVersion,
        will: Message | None,
        most: int,
        wake: Callable[[], object],
    ) -> None:
        """Start the attempt.

        Args:
            policy: Chooses the broker.
            protocol: The version of MQTT.
            will: The will of the connection; None for no will.
            most: Maximum number of messages that the broker may send without acknowledgement. Only
                brokers with MQTT 5 are told this number.
            wake: Called by the thread when the attempt ends, unless the attempt was abandoned.

        """
        self.target = policy.next()
        self._begun_s = time.monotonic()
        self.over = False
        """True when the attempt has ended.

        Then ``client``, ``socket`` and ``problem`` are final.
        """
        self.client: BrokerClient | None = None
        self.socket: socket.socket | None = None
        """The connected socket, from which nothing has been read yet."""
        self.sent = False
        """True if a broker may have received a CONNECT with the bridge's client id and this will."""
        self.problem = ""
        """Why the attempt has failed; empty if it has not."""
        self._policy, self._protocol, self._will, self._most, self._wake = policy, protocol, will, most, wake
        self._lock = threading.Lock()
        self._abandoned = False
        threading.Thread(target=self._run, name="connect", daemon=True).start()

    @property
    def slow(self) -> bool:
        """True if the attempt is taking unusually long."""
        return time.monotonic() >= self._begun_s + SLOW_S

    def abandon(self) -> None:
        """Abandon the attempt: close its connection, and do not call ``wake``."""
        with self._lock:
            self._abandoned = True
        if self.over:
            self._close()

    def _run(self) -> None:
        try:
            self._connect()
        except ConfigError as error:
            self.problem = str(error)
        except (OSError, ValueError) as error:  # ValueError: a host name with an empty part
            tls = self._policy.settings.tls is not None
            self.problem = f"broker {self.target}: {_why(error, self.target, tls=tls)}"
        if self.problem:
            self._close()
        with self._lock:
            if not self._abandoned:
                self.over = True
                self._wake()
                return
        self._close()

    def _connect(self) -> None:
        """Connect to the broker.

        Raises:
            ConfigError: A password or TLS file cannot be used.

        """
        settings, target, new = self._policy.settings, self.target, self._protocol == MQTTv5
        own = secret_of(target.host) if target.transport == "unix" else None
        client_id = self._policy.client_id
        # Each attempt has a new client, so that no state is left from the attempt before.
        client = self.client = BrokerClient(
            CallbackAPIVersion.VERSION2,
            client_id if own is None else secret_id(client_id, own),
            clean_session=None if new else not settings.session_expiry_s,
            protocol=self._protocol,
            transport=target.transport,
            reconnect_on_failure=False,
        )
        client.connect_timeout = CONNECT_S
        client.max_inflight_messages_set(0)  # BrokerConnection limits the messages in flight
        if self._will is not None:
            client.will_set(self._will.topic, self._will.payload, self._will.qos, self._will.retain)
        if own is not None:
            client.username_pw_set(BRIDGE, own)
        else:
            if settings.username is not None:
                password = read_password(settings.password_file) if settings.password_file else None
                client.username_pw_set(settings.username, password)
            if settings.tls is not None:
                client.tls_set_context(client_context(settings.tls))
        options: dict[str, Any] = {}
        if new:
            properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
            properties.SessionExpiryInterval = settings.session_expiry_s
            properties.MaximumPacketSize = MAX_PACKET_BYTES
            properties.ReceiveMaximum = self._most
            options = {"properties": properties, "clean_start": not settings.session_expiry_s}
        client.connect(target.host, target.port, settings.keep_alive_s, **options)
        self.sent = True
        self.socket = cast("socket.socket | None", client.socket())
        if self.socket is None:
            self.problem = f"broker {target}: {ended(client.tls_error, up=False, tls=settings.tls is not None)}"

    def _close(self) -> None:
        if self.client is not None:
            close_socket(self.client)


def close_socket(client: Client) -> None:
    """Close the socket of a client, whatever state the client is in."""
    client.on_disconnect = None
    made = client.socket()
    if made is not None:
        with suppress(OSError):
            made.close()


def refusal(code: ReasonCode, policy: ReconnectPolicy) -> str:
    """Return a text that explains the reason code with which a broker refuses a connection."""
    if code.value in _WHO:
        return (
            f"it refuses shmio's login ({code}); check mqtt.username, mqtt.password_file and the broker's own accounts"
        )
    if code.value in _BUSY:
        return f"it accepts no more connections at present ({code})"
    if code.value == _TAKEN_OVER:
        return f"another client has connected as {policy.client_id}; give one of them another mqtt.client_id"
    return f"it refuses the connection: {code}"


def ended(error: ssl.SSLError | None, *, up: bool, tls: bool) -> str:
    """Return a text that explains why a connection has ended.

    Args:
        error: The TLS error; None if there was none.
        up: Whether the broker had accepted the CONNECT.
        tls: Whether TLS is in use.

    """
    if error is not None:
        return _tls(error)
    lost = "the connection was lost"
    missing = "needs a client certificate (mqtt.tls.certificate and key)" if tls else "expects TLS there (mqtt.tls)"
    return lost if up else f"{lost} before the login: the broker is full, or {missing}, or this is not a broker"


def _why(error: Exception, target: Target, *, tls: bool) -> str:
    """Describe why no connection could be made. ``tls`` is True if TLS is in use."""
    if isinstance(error, ssl.SSLError):
        return _tls(error)
    if isinstance(error, socket.gaierror):
        return f"unknown host name ({error.strerror})"
    if isinstance(error, TimeoutError):
        return "it does not answer"
    if isinstance(error, ConnectionRefusedError | FileNotFoundError):
        if target.transport == "unix":
            return "it does not run at present; shmio-supervisor logs broker says why"
        return "nothing listens there"
    if isinstance(error, ConnectionError):
        return "it closed the connection" + (
            ", perhaps because that port has no TLS; check mqtt.tls, and the port" if tls else ""
        )
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _tls(error: ssl.SSLError) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted ({error.verify_message}); check mqtt.tls.ca, and the host's name"
    if "_ALERT_" in (error.reason or ""):
        return f"it refuses TLS with shmio ({error.reason}); check mqtt.tls.certificate and key, which it may require"
    return (
        f"the TLS handshake failed ({error.reason or 'the broker ended the connection'}); check mqtt.tls, and the port"
    )
