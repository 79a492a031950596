"""What a connection sends goes out in batches: one segment for many messages, not one for each."""

from __future__ import annotations

import socket
from contextlib import suppress
from typing import Any, Final

from paho.mqtt.client import Client
from paho.mqtt.enums import MQTTErrorCode

BATCH: Final = 32
"""So many messages go at once; the first waits until the last has been made."""


def take_over(client: Client) -> None:
    """Have a client that is connected leave it to :func:`write` when it writes."""
    client.on_socket_register_write = lambda *_: None
    _set(client.socket(), socket.TCP_NODELAY, 1)  # a batch is not to wait until the last one has arrived


def write(client: Client) -> MQTTErrorCode:
    """Write what it has, as much as its connection takes.

    Not for a DISCONNECT, with which paho closes the socket: what is held back then may be lost.
    """
    # Else it would be called, with objects that are made for it, for each message of QoS 0.
    acknowledged, client.on_publish = client.on_publish, None
    made = client.socket()
    _set(made, socket.TCP_CORK, 1)
    code = client.loop_write()
    _set(made, socket.TCP_CORK, 0)
    client.on_publish = acknowledged
    return code


def _set(made: Any, option: int, value: int) -> None:
    """See tcp(7)."""
    if made is not None and made.family != socket.AF_UNIX:
        with suppress(OSError):  # it may have been closed
            made.setsockopt(socket.IPPROTO_TCP, option, value)
