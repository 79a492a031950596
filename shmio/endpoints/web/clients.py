"""Finds out who is connected to the endpoints, from the sockets that proc_net(5) lists.

So the endpoints need not count their clients, and the clients of mosquitto are found, too.
"""

from __future__ import annotations

import ipaddress
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

ENDPOINTS: Final = ("fabric", "grpc", "mqtt", "opcua", "web")
"""Kinds of processes that have clients."""
MAX_CLIENTS: Final = 50
"""Maximum number of clients that are listed for an endpoint, those with the most connections first."""
_ESTABLISHED: Final = "01"
_LISTEN: Final = "0A"
_ACCEPTS: Final = 0x10000  # __SO_ACCEPTCON of a UNIX socket
_CONNECTED: Final = "03"


class _Connection(NamedTuple):
    """A TCP socket; ``local`` and ``remote`` are address and port in hexadecimal digits."""

    local: str
    remote: str
    state: str
    inode: str

    @property
    def port(self) -> str:
        """The local port."""
        return self.local.rpartition(":")[2]


def clients(pids: Mapping[str, tuple[str, int]]) -> list[dict[str, Any]]:
    """Return the clients of an instance's endpoints.

    Args:
        pids: Kind and pid of each process of the instance, by name.

    Returns:
        For each endpoint that is listening: its name, its number of connections, and its clients
        with their numbers of connections. A client is an address, ``UNIX socket``, or the name of a
        process of the instance.

    """
    owners = {inode: name for name, (_, pid) in pids.items() for inode in _sockets(pid)}
    connections = list(_tcp())
    unix = list(_unix())
    inside = {one.local: owners[one.inode] for one in connections if one.inode in owners}
    found = []
    for name, (kind, _) in pids.items():
        if kind not in ENDPOINTS:
            continue
        ports = {one.port for one in connections if one.state == _LISTEN and owners.get(one.inode) == name}
        paths = {path for path, inode, listens in unix if listens and owners.get(inode) == name}
        if not ports and not paths:
            continue
        counts = Counter(
            inside.get(one.remote) or _host(one.remote)
            for one in connections
            if one.state == _ESTABLISHED and one.port in ports and owners.get(one.inode) == name
        )
        if local := sum(path in paths and not listens for path, _, listens in unix):
            counts["UNIX socket"] = local
        listed = [{"client": client, "connections": count} for client, count in counts.most_common(MAX_CLIENTS)]
        found.append({"endpoint": name, "connections": counts.total(), "clients": listed})
    return found


def _sockets(pid: int) -> Iterator[str]:
    """Yield the inodes of the sockets of a process and of its children, such as mosquitto."""
    for one in (pid, *_children(pid)):
        with suppress(OSError), os.scandir(f"/proc/{one}/fd") as files:
            for file in files:
                with suppress(OSError):
                    link = str(Path(file.path).readlink())
                    if link.startswith("socket:["):
                        yield link[8:-1]


def _children(pid: int) -> list[int]:
    with suppress(OSError, ValueError):
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []


def _lines(table: str) -> Iterable[list[str]]:
    with suppress(OSError):
        return [line.split() for line in Path("/proc/net", table).read_text(errors="replace").splitlines()[1:]]
    return ()


def _tcp() -> Iterator[_Connection]:
    for table in ("tcp", "tcp6"):
        for fields in _lines(table):
            yield _Connection(fields[1], fields[2], fields[3], fields[9])


def _unix() -> Iterator[tuple[str, str, bool]]:
    """Yield path and inode of each UNIX socket that listens or was accepted, and whether it listens."""
    for fields in _lines("unix"):
        if len(fields) > 7 and (listens := bool(int(fields[3], 16) & _ACCEPTS)) | (fields[5] == _CONNECTED):
            yield fields[7], fields[6], listens


def _host(end: str) -> str:
    packed = bytes.fromhex(end.partition(":")[0])
    address = ipaddress.ip_address(b"".join(packed[at : at + 4][::-1] for at in range(0, len(packed), 4)))
    mapped = getattr(address, "ipv4_mapped", None)
    return str(mapped or address)
