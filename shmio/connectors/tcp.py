"""Opens TCP connections to devices."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any

from shmio.errors import ConnectorError

Place = tuple[socket.AddressFamily, socket.SocketKind, int, str, Any]


def refused(peer: object) -> ConnectorError:
    """Return the error for a device that refuses connections, with the remedy."""
    return ConnectorError(
        f"connection refused by {peer}: no program listens there; check the address, and that the device runs"
    )


def unresolved(host: str, error: socket.gaierror) -> ConnectorError:
    """Return the error for a host name without an address, with the remedy."""
    return ConnectorError(
        f"host name {host!r} cannot be resolved: {error.strerror}; correct the name, or give the address"
    )


def look_up(host: str, port: int, timeout_s: float) -> Sequence[Place]:
    """Return the addresses of a host, as ``socket.getaddrinfo`` does.

    The look-up runs in a thread of its own, which this function abandons after ``timeout_s``,
    because the system may wait half a minute for a name server.

    Raises:
        OSError: The host has no address, or no name server has answered within ``timeout_s``.

    """
    try:
        return socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST)
    except socket.gaierror:
        pass  # the host is a name
    found: Future[Sequence[Place]] = Future()

    def ask() -> None:
        try:
            found.set_result(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM))
        except Exception as error:  # noqa: BLE001  the caller raises it
            found.set_exception(error)

    threading.Thread(target=ask, name="look-up", daemon=True).start()
    try:
        return found.result(timeout_s)
    except FutureTimeoutError:
        raise socket.gaierror(socket.EAI_AGAIN, "no name server has answered in time") from None


def connect(places: Sequence[Place], timeout_s: float) -> socket.socket:
    """Connect to the first address that answers. ``timeout_s`` limits all attempts together.

    Raises:
        OSError: No address answers; this is the error of the last address.

    """
    deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
    for attempt, (family, kind, protocol, _, address) in enumerate(places, 1):
        opened = socket.socket(family, kind, protocol)
        try:
            # Each address gets an equal share of the time left, so that a silent one leaves time for the next.
            left_s = (deadline_ns - time.monotonic_ns()) / 1e9
            opened.settimeout(max(0.001, left_s / (len(places) - attempt + 1)))
            opened.connect(address)
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except BaseException as error:
            opened.close()
            if attempt == len(places) or not isinstance(error, OSError):
                raise
        else:
            return opened
    raise OSError("the host has no address")
