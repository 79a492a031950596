"""Addresses that another program listens on already, found before anything starts."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from shmio.config import Address
from shmio.errors import EndpointError, ShmioError
from shmio.segment import instances
from shmio.supervisor.plan import Plan
from shmio.supervisor.status import read_status

# proc(5), /proc/net/tcp: addresses are 32-bit words in hexadecimal, each in the host's byte order.
_MAPPED: Final = "0000000000000000FFFF0000"
_ANY: Final = frozenset({"0" * 8, "0" * 32})
_LISTEN: Final = "0A"


def check_ports(plan: Plan) -> None:
    """EndpointError when an address of the plan is taken, naming who has it if that is a process of an instance.

    Whatever else may be wrong with an address is for its process to find.
    """
    for job in plan.jobs:
        listen = job.config.get("listen", ())
        for text in (listen,) if isinstance(listen, str) else listen:
            address = Address.parse(text)
            if in_use(address):
                raise EndpointError(f"{job.name}: cannot listen on {address}: {_holder(address)}")


def in_use(address: Address) -> bool:
    """Whether somebody listens there; of a name with several addresses, on all of them."""
    with suppress(OSError):
        places = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)
        return address.port != 0 and all(_taken(family, place) for family, _, _, _, place in places)
    return False


def _taken(family: int, place: object) -> bool:
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections that are over do not count
        try:
            probe.bind(place)  # type: ignore[arg-type]
        except OSError as error:
            return error.errno == errno.EADDRINUSE
    return False


def _holder(address: Address) -> str:
    """Who listens there, and what to do about it."""
    links = {f"socket:[{inode}]" for inode in _listening(address)}
    for instance in instances():
        with suppress(ShmioError):
            for process in read_status(instance).processes:
                if process.pid and links.intersection(_open_files(process.pid)):
                    return (
                        f"process {process.name} of instance {instance}, pid {process.pid}, listens there; choose "
                        f"another port, or stop that instance: shmio-supervisor down --instance {instance}"
                    )
    return f"another program listens there; choose another port, or see which: ss -ltnp sport = :{address.port}"


def _listening(address: Address) -> Iterator[str]:
    """The inodes of the sockets that listen there."""
    wanted = {
        _words(socket.inet_pton(family, str(place[0]).partition("%")[0]))
        for family, _, _, _, place in socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)
    }
    for table in ("tcp", "tcp6"):
        with suppress(OSError):
            for line in Path("/proc/net", table).read_text().splitlines()[1:]:
                fields = line.split()
                host, _, port = fields[1].partition(":")
                if fields[3] == _LISTEN and int(port, 16) == address.port:
                    hosts = {host.removeprefix(_MAPPED)}
                    if hosts & wanted or hosts & _ANY or wanted & _ANY:
                        yield fields[9]


def _words(packed: bytes) -> str:
    return "".join(packed[at : at + 4][::-1].hex() for at in range(0, len(packed), 4)).upper()


def _open_files(pid: int) -> Iterator[str]:
    """What a process's descriptors lead to, as far as this user may know it."""
    with suppress(OSError):
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                yield os.readlink(entry)  # noqa: PTH115 - no path: socket:[4711]
