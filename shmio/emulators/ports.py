"""TCP ports that are reserved before a server listens on them."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from shmio.config.address import Address


@contextmanager
def reserved_port(host: str = "127.0.0.1", port: int = 0) -> Iterator[Address]:
    """Reserve a port for the length of a ``with`` block; 0: a free port.

    The port is bound, but nothing listens. So the kernel refuses connections to it, and does not
    choose it for other programs. A server that binds it with SO_REUSEADDR, as all servers here do,
    gets it.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as keeper:
        keeper.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        keeper.bind((host, port))
        yield Address(host, keeper.getsockname()[1])
