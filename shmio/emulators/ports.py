"""TCP ports that are reserved before a server listens on them."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from shmio.config.address import Address


@contextmanager
def reserved_port(host: str = "127.0.0.1", port: int = 0) -> Iterator[Address]:
    """Reserve a port for the duration of a ``with`` block. Port 0 selects a free port.

    The port is bound, but nothing listens on it. So the kernel refuses connections, and gives the
    port to no other program. A server can still listen on it if it sets SO_REUSEADDR, as all servers
    here do.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as keeper:
        keeper.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        keeper.bind((host, port))
        yield Address(host, keeper.getsockname()[1])
