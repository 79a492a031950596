"""Which clients are still connected, though no call of theirs is open.

gRPC tells a server of the end of a call, not of a connection; the kernel knows.
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
"""The client's end of a connection."""


def peer_of(text: str) -> Peer | None:
    """The client's end, as gRPC names it (``ipv4:127.0.0.1:5000``, ``ipv6:%5B::1%5D:5000``); None: it is not of TCP."""
    match = _PEER.fullmatch(unquote(text))
    if match is None:
        return None
    try:
        return _plain(ip_address(match[1].strip("[]").partition("%")[0])), int(match[2])
    except ValueError:
        return None


def connected() -> frozenset[Peer]:
    """The other ends of all connections of this host that stand; none where the kernel does not tell."""
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
    """An address as the kernel prints it: words of four bytes, each in the host's order."""
    data = b"".join(words[at : at + 4][::-1] for at in range(0, len(words), 4))
    return _plain(ip_address(data))


def _plain(address: IPv4Address | IPv6Address) -> IPv4Address | IPv6Address:
    """An IPv4 address that is written as one of IPv6 is the same one."""
    return getattr(address, "ipv4_mapped", None) or address
