"""Writes messages in batches: one TCP segment for many, not one for each."""

from __future__ import annotations

import socket
from contextlib import suppress
from typing import Any, Final

from paho.mqtt.client import Client
from paho.mqtt.enums import MQTTErrorCode

BATCH: Final = 32
"""Messages in a batch; the first is not sent before the last is made."""


def take_over(client: Client) -> None:
    """Take over writing from a connected client: only :func:`write` writes from now on."""
    client.on_socket_register_write = lambda *_: None
    _set(client.socket(), socket.TCP_NODELAY, 1)  # a batch does not wait for the acknowledgement of the one before


def write(client: Client) -> MQTTErrorCode:
    """Write the client's queued messages, as many as its socket takes.

    Do not use it for a DISCONNECT, after which paho closes the socket: corked data may be lost.
    """
    # Else paho would call it for each message of QoS 0, which is slow.
    acknowledged, client.on_publish = client.on_publish, None
    made = client.socket()
    _set(made, socket.TCP_CORK, 1)
    code = client.loop_write()
    _set(made, socket.TCP_CORK, 0)
    client.on_publish = acknowledged
    return code


def _set(made: Any, option: int, value: int) -> None:
    """Set a TCP option; see tcp(7)."""
    if made is not None and made.family != socket.AF_UNIX:
        with suppress(OSError):  # it may have been closed
            made.setsockopt(socket.IPPROTO_TCP, option, value)
