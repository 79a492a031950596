"""Peers that do not speak the protocol, or speak it to do harm."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from shmio.config import Address

PATIENCE_S = 20.0
Behaviour = Callable[[socket.socket], None]


@contextmanager
def peer(behave: Behaviour) -> Iterator[Address]:
    """Listen, and treat each client as ``behave`` does."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            while True:
                try:
                    client, _ = listener.accept()
                except OSError:
                    return
                with client, suppress(OSError):
                    client.settimeout(PATIENCE_S)
                    behave(client)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield Address("127.0.0.1", listener.getsockname()[1])
        finally:
            listener.shutdown(socket.SHUT_RDWR)
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


def silence(client: socket.socket) -> None:
    """Receive, and never answer."""
    while client.recv(65536):
        pass


def closes(client: socket.socket) -> None:
    """Close the connection at once."""


def sends(data: bytes) -> Behaviour:
    """Answer the client's first bytes with ``data``, and then never again."""

    def behave(client: socket.socket) -> None:
        client.recv(65536)
        client.sendall(data)
        silence(client)

    return behave


def endless(data: bytes, first: bytes = b"") -> Behaviour:
    """Answer the client's first bytes with ``first``, and then send ``data`` without end."""

    def behave(client: socket.socket) -> None:
        client.recv(65536)
        client.sendall(first)
        while True:
            client.sendall(data)

    return behave


def trickle(data: bytes, pause_s: float = 0.05) -> Behaviour:
    """Answer the client's first bytes with ``data`` again and again, a byte at a time."""

    def behave(client: socket.socket) -> None:
        never = threading.Event()
        client.recv(65536)
        while True:
            for byte in data:
                client.sendall(bytes([byte]))
                never.wait(pause_s)

    return behave
