"""Lists the connected clients, including those without an open call.

gRPC reports the end of a call to the server, but not the end of a connection. So this module reads
the kernel's tables of connections.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from typing import Final
from urllib.parse import unquote

_ESTABLISHED: Final = "01"
_TABLES: Final = (Path("/proc/self/net/tcp"), Path("/proc/self/net/tcp6"))
_PEER: Final = re.compile(r"ipv[46]:(.+):([0-9]{1,5})")

Peer = tuple[IPv4Address | IPv6Address, int]
"""Address and port of a connection's remote end."""


def peer_of(text: str) -> Peer | None:
    """Parse the name that gRPC gives a client, such as ``ipv4:127.0.0.1:5000`` or ``ipv6:%5B::1%5D:5000``.

    Returns:
        The client's address and port; None if the connection is not TCP.

    """
    match = _PEER.fullmatch(unquote(text))
    if match is None:
        return None
    try:
        return _plain(ip_address(match[1].strip("[]").partition("%")[0])), int(match[2])
    except ValueError:
        return None


def connected() -> frozenset[Peer]:
    """Return the remote address and port of each established TCP connection, from the kernel's tables."""
    return frozenset(peer for table in _TABLES for peer in _read(table))


def _read(table: Path) -> Iterator[Peer]:
    try:
        lines = table.read_text(encoding="ascii").splitlines()[1:]
    except OSError:  # a host without IPv6
        return
    for line in lines:
        _, _, remote, state, *_ = line.split()
        if state == _ESTABLISHED:
            address, _, port = remote.partition(":")
            yield _address(bytes.fromhex(address)), int(port, 16)


def _address(words: bytes) -> IPv4Address | IPv6Address:
    """Parse an address of the kernel's tables: words of four bytes in the host's byte order."""
    data = b"".join(words[at : at + 4][::-1] for at in range(0, len(words), 4))
    return _plain(ip_address(data))


def _plain(address: IPv4Address | IPv6Address) -> IPv4Address | IPv6Address:
    """Return the IPv4 address of an IPv4-mapped IPv6 address, and any other address unchanged."""
    return getattr(address, "ipv4_mapped", None) or address
