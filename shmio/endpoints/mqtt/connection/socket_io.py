"""The socket of a connection: read and written when it is ready, a little at a time."""

from __future__ import annotations

import selectors
import socket
import ssl
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from paho.mqtt.client import Client
from paho.mqtt.enums import MQTTErrorCode

from shmio.endpoints.mqtt.connection.attempt import close_socket
from shmio.endpoints.mqtt.connection.write_batches import take_over, write

PACKETS: Final = 4
"""So many are read before what else there is to do has its turn; or as many as there are messages of ours that may be
acknowledged, which takes hardly any time."""


class SocketIo:
    """For the bridge's thread: ``selector`` has the socket registered, to have ``data`` called when it is ready."""

    def __init__(
        self,
        client: Client,
        made: socket.socket,
        selector: selectors.BaseSelector,
        on_failure: Callable[[str], object],
    ) -> None:
        """``on_failure``: called with why nothing more can be read or written."""
        self._client, self._selector, self._on_failure = client, selector, on_failure
        self._socket: socket.socket | None = made
        self.writing = False
        """Whether something waits for room in the socket."""
        self._packets = 0
        """Packets that were told of."""
        take_over(client)
        selector.register(made, selectors.EVENT_READ, self._serve)

    def counting(self, callback: Callable[..., None]) -> Callable[..., None]:
        """What the client is to call with each packet that is read."""

        def counted(*told: object) -> None:
            self._packets += 1
            callback(*told)

        return counted

    def turn(self) -> float:
        """Do what the selector does not know of; in how many seconds there may be more."""
        if self._unseen():
            self._serve(selectors.EVENT_READ)
        self.push()
        return 0.0 if self._unseen() else 1.0

    def push(self) -> None:
        """Have go what is ready."""
        if self._socket is not None and not self.writing and self._client.want_write():
            self._serve(0)

    def close(self) -> None:
        """Hang up."""
        if self._socket is not None:
            with suppress(KeyError, ValueError):
                self._selector.unregister(self._socket)
            self._socket = None
        close_socket(self._client)

    def _serve(self, events: int) -> None:
        """The socket is ready."""
        code = self._read() if events & selectors.EVENT_READ else MQTTErrorCode.MQTT_ERR_SUCCESS
        if not code and self._socket is not None and (events & selectors.EVENT_WRITE or not self.writing):
            code = write(self._client)
        if code and self._socket is not None:
            self._on_failure(str(MQTTErrorCode(code).name).removeprefix("MQTT_ERR_").replace("_", " ").lower())
        if self._socket is not None and self.writing != self._client.want_write():
            self.writing = not self.writing  # to hear of room for what did not go out at once
            events = selectors.EVENT_READ | (selectors.EVENT_WRITE if self.writing else 0)
            self._selector.modify(self._socket, events, self._serve)

    def _read(self) -> MQTTErrorCode:
        """Take a few packets: paho by itself takes as many at once as messages of ours wait for acknowledgements."""
        before, most = -1, self._packets + PACKETS
        code = MQTTErrorCode.MQTT_ERR_SUCCESS
        while not code and before < self._packets < most and self._socket is not None:
            before = self._packets
            code = self._client.loop_read()
        return code

    def _unseen(self) -> bool:
        """Whether TLS has read from the socket what was not taken yet: a selector does not see that."""
        return isinstance(self._socket, ssl.SSLSocket) and self._socket.pending() > 0
