"""A paho client that sends messages in batches, and reads their acknowledgements in batches.

Paho makes, writes and acknowledges each message alone, and a large cell publishes 100,000 values when
it starts. So :class:`BrokerClient` makes the PUBLISH packets itself, joins them, and reads the PUBACK
packets itself. All else is left to paho.
"""

from __future__ import annotations

import ssl
import struct
import time
from collections.abc import Callable, Container
from typing import Final

from paho.mqtt.client import Client, MQTTv5
from paho.mqtt.enums import MessageType, MQTTErrorCode
from paho.mqtt.properties import Properties

PRIVATE_NAMES: Final = (
    "_in_packet",
    "_last_bytes_received",
    "_mid_generate",
    "_out_packet",
    "_pack_remaining_length",
    "_packet_queue",
    "_packet_read",
    "_protocol",
    "_raise_for_invalid_topic",
    "_sock_recv",
)
"""The private names of paho's client that this module uses or replaces."""
JOINED_BYTES: Final = 32_768
"""Size in bytes from which joined packets get no further packet."""
READ_BYTES: Final = 16_384
_PUBLISH: Final = 0x30
_RETAIN: Final = 0x01
_PUBACK: Final = 0x40
_UINT16: Final = struct.Struct("!H")


class BrokerClient(Client):
    """A paho client that sends messages and reads acknowledgements in batches. One thread may use it.

    Send messages with :meth:`queue_message`, not with ``publish``.
    """

    tls_error: ssl.SSLError | None = None
    """The TLS error that ended the established connection; None if there was none."""
    on_acknowledged: Callable[[int, int], object] | None = None
    """Called with the packet identifier and the reason code of each PUBACK (MQTT 5.0, section 3.4)."""
    _unread = bytearray()
    """The bytes that were read from the socket, and are not handled yet."""
    _incomplete = False
    """True if these bytes end within a PUBACK, and its rest has not arrived."""
    _joined = bytearray()
    """The last packets that :meth:`queue_message` has joined."""

    @property
    def unread(self) -> bool:
        """True if bytes were read from the socket that can be handled now. The selector does not see them."""
        return bool(self._unread) and not self._incomplete

    def queue_message(
        self,
        topic: str,
        payload: bytes,
        qos: int,
        properties: Properties | None,
        *,
        retain: bool,
        unacknowledged: Container[int],
    ) -> int:
        """Queue a message, which ``loop_write`` sends.

        Args:
            topic: The topic.
            payload: The payload.
            qos: 0 or 1.
            properties: The properties, which only MQTT 5 has.
            retain: Whether the broker keeps the message.
            unacknowledged: The packet identifiers that are in use.

        Returns:
            The packet identifier that the acknowledgement will have; 0 with QoS 0.

        Raises:
            ValueError: The topic has wildcards, or is too long.

        """
        name, identifier = topic.encode(), 0
        self._raise_for_invalid_topic(name)
        head = _UINT16.pack(len(name)) + name
        if qos:
            while (identifier := self._mid_generate()) in unacknowledged:
                pass
            head += _UINT16.pack(identifier)
        if self._protocol == MQTTv5:
            head += b"\0" if properties is None else properties.pack()  # type: ignore[no-untyped-call]
        packet = bytearray((_PUBLISH | qos << 1 | (_RETAIN if retain else 0),))
        self._pack_remaining_length(packet, len(head) + len(payload))
        packet += head
        packet += payload
        last = self._out_packet[-1] if self._out_packet else None
        if last and last["packet"] is self._joined and not last["pos"] and len(self._joined) < JOINED_BYTES:
            self._joined += packet
            last["to_process"] = len(self._joined)
        else:
            self._joined = packet
            self._packet_queue(MessageType.PUBLISH, packet, identifier, 1)  # with QoS 0, paho expects one message
        return identifier

    def _sock_recv(self, bufsize: int) -> bytes:
        """Return bytes for paho, which asks for most of them one by one."""
        if not self._unread:
            if bufsize >= READ_BYTES:
                return self._read_socket(bufsize)
            self._fill()
        data = bytes(self._unread[:bufsize])
        del self._unread[:bufsize]
        return data

    def _read_socket(self, most: int) -> bytes:
        try:
            return super()._sock_recv(most)
        except ssl.SSLError as error:  # with TLS 1.3 a broker rejects our certificate only after the handshake
            self.tls_error = error
            raise

    def _fill(self) -> bool:
        """Read from the socket. Return False if the broker has closed the connection."""
        data = self._read_socket(READ_BYTES)
        self._unread = bytearray(data) if not self._unread else self._unread + data
        self._last_bytes_received = time.monotonic()  # else paho would see no life in acknowledgements
        return bool(data)

    def _packet_read(self) -> MQTTErrorCode:
        """Take the acknowledgements that come first, then let paho read a packet."""
        if not self._in_packet["command"]:  # else paho has read a part of a packet
            try:
                open_ = bool(self._unread) or self._fill()
                while open_ and self._take_acknowledgements():
                    open_ = self._fill()
            except BlockingIOError:
                self._incomplete = True
                return MQTTErrorCode.MQTT_ERR_AGAIN
            except OSError:
                open_ = False
            self._incomplete = False
            if not open_:
                return MQTTErrorCode.MQTT_ERR_CONN_LOST
            if not self._unread:
                return MQTTErrorCode.MQTT_ERR_AGAIN
        return super()._packet_read()

    def _take_acknowledgements(self) -> bool:
        """Take the PUBACKs at the beginning of the unread bytes.

        Returns:
            Whether more bytes are needed, because these end within a PUBACK.

        """
        unread, at = self._unread, 0
        try:
            while at < len(unread) and unread[at] == _PUBACK:
                length, body = unread[at + 1], at + 2
                if length >= 0x80:  # the reason is a text, and takes 128 bytes or more
                    length, body = (length & 0x7F) + (unread[at + 2] << 7), at + 3
                    if unread[at + 2] >= 0x80:
                        break
                if length < 2:  # paho reports it
                    break
                if body + length > len(unread):
                    return True
                (identifier,) = _UINT16.unpack_from(unread, body)
                code = unread[body + 2] if length > 2 else 0
                at = body + length
                if self.on_acknowledged is not None:
                    self.on_acknowledged(identifier, code)
        except IndexError:
            return True
        finally:
            del unread[:at]
        return False
