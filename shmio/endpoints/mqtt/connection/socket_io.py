"""Reads and writes the socket of a connection without blocking.

It reads a few packets at a time, and writes in batches.
"""

from __future__ import annotations

import os
import selectors
import socket
import ssl
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from paho.mqtt.enums import MQTTErrorCode

from shmio.endpoints.mqtt.connection.attempt import close_socket
from shmio.endpoints.mqtt.connection.broker_client import BrokerClient

BATCH: Final = 32
"""Maximum number of messages in a batch.

The messages of a batch share TCP segments. The first message waits until the last one has been
made.
"""
PACKETS: Final = 4
"""Number of packets after which reading stops, so that the bridge can do other work.

Acknowledgements do not count, because they take hardly any time.
"""


class SocketIo:
    """Reads and writes the socket of a client. Use it only in the bridge's thread.

    It registers the socket with ``selector``. Call the ``data`` of the selector's key when the
    socket is ready.
    """

    def __init__(
        self,
        client: BrokerClient,
        made: socket.socket,
        selector: selectors.BaseSelector,
        on_failure: Callable[[str], object],
    ) -> None:
        """Register the socket.

        Args:
            client: The paho client.
            made: The client's socket.
            selector: This object registers the socket here.
            on_failure: Called with the reason when reading or writing fails.

        """
        self._client, self._selector, self._on_failure = client, selector, on_failure
        self._socket: socket.socket | None = made
        self.writing = False
        """True while data waits for room in the socket."""
        self._packets = 0
        """Number of received packets for which one of the client's callbacks was called."""
        client.on_socket_register_write = lambda *_: None  # from now on this object writes, not paho
        _set(made, socket.TCP_NODELAY, 1)  # a batch does not wait for TCP's acknowledgement of the previous batch
        self._unseen = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        """Wakes the selector for data that the client or TLS has buffered, which it does not see."""
        self._more = False
        """True while such data wait for the next turn of the selector."""
        selector.register(made, selectors.EVENT_READ, self._serve)
        selector.register(self._unseen, selectors.EVENT_READ, self._serve_unseen)
        self._note_unseen()

    def counting(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Return a callback that calls ``callback``, and counts its calls."""

        def counted(*arguments: object) -> None:
            self._packets += 1
            callback(*arguments)

        return counted

    def run_once(self) -> float:
        """Write queued messages. Return the time in s after which to call this method again."""
        self.push()
        return 1.0

    def push(self) -> None:
        """Write the messages that the client has queued to the socket."""
        if self._socket is not None and not self.writing and self._client.want_write():
            self._serve(0)

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            for file in (self._socket, self._unseen):
                with suppress(KeyError, ValueError):
                    self._selector.unregister(file)
            os.close(self._unseen)
            self._socket = None
        close_socket(self._client)

    def _serve(self, events: int) -> None:
        """Read and write the socket, as far as this does not block."""
        reads = events & selectors.EVENT_READ and not self._more  # else it would read twice in one turn
        code = self._read() if reads else MQTTErrorCode.MQTT_ERR_SUCCESS
        if not code and self._socket is not None and (events & selectors.EVENT_WRITE or not self.writing):
            code = self._write(self._socket)
        if code and self._socket is not None:
            self._on_failure(str(MQTTErrorCode(code).name).removeprefix("MQTT_ERR_").replace("_", " ").lower())
        if self._socket is not None and self.writing != self._client.want_write():
            self.writing = not self.writing  # to be woken when the socket has room for the rest
            events = selectors.EVENT_READ | (selectors.EVENT_WRITE if self.writing else 0)
            self._selector.modify(self._socket, events, self._serve)
        if self._socket is not None:
            self._note_unseen()

    def _read(self) -> MQTTErrorCode:
        """Read a few packets."""
        before, most = -1, self._packets + PACKETS
        code = MQTTErrorCode.MQTT_ERR_SUCCESS
        while not code and before < self._packets < most and self._socket is not None:
            before = self._packets
            code = self._client.loop_read()
        return code

    def _write(self, made: socket.socket) -> MQTTErrorCode:
        """Write the client's queued messages, as many as the socket accepts.

        Do not use this for a DISCONNECT. Paho closes the socket after it, and corked data may be
        lost.
        """
        _set(made, socket.TCP_CORK, 1)
        code = self._client.loop_write()
        _set(made, socket.TCP_CORK, 0)
        return code

    def _serve_unseen(self, events: int) -> None:
        if self._socket is not None:  # else it was closed in this turn of the selector
            os.eventfd_read(self._unseen)
            self._more = False
            self._serve(events)

    def _note_unseen(self) -> None:
        unseen = self._client.unread or (isinstance(self._socket, ssl.SSLSocket) and self._socket.pending())
        if unseen and not self._more:
            self._more = True
            os.eventfd_write(self._unseen, 1)


def _set(made: socket.socket, option: int, value: int) -> None:
    """Set a TCP option; see tcp(7)."""
    if made.family != socket.AF_UNIX:
        with suppress(OSError):  # the socket may have been closed
            made.setsockopt(socket.IPPROTO_TCP, option, value)
