"""Checks before the start that the addresses to listen on belong to this host and are free."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, Final

from shmio.config import Address, Config, UnixAddress, parse_address
from shmio.config.unix_socket import obstacle
from shmio.errors import ConfigError, EndpointError, ShmioError
from shmio.local.status import read_status
from shmio.plan.processes import Plan
from shmio.segment import instances

# proc(5), /proc/net/tcp: addresses are 32-bit words in hexadecimal, each in the host's byte order.
_MAPPED: Final = "0000000000000000FFFF0000"
_ANY_IPV4: Final = "0" * 8
_ANY: Final = "0" * 32
_LISTEN: Final = "0A"


def check_listening(config: Config, catching: Callable[[], AbstractContextManager[None]]) -> None:
    """Check that host names can be resolved, and that no two addresses have the same port.

    Addresses with port 0 never conflict, because port 0 stands for any free port. Malformed addresses are skipped,
    because they are reported before. ``catching`` returns a context manager that collects a ConfigError.
    """
    listening = [(f"emulator[{i}].listen", emulator.listen) for i, emulator in enumerate(config.emulator)]
    if config.grpc:
        listening += [(key, address.listen) for key, address in config.grpc.listening.items()]
    if config.mqtt and config.mqtt.listen:
        listening.append(("mqtt.listen", config.mqtt.listen))
    if config.opcua:
        listening.append(("opcua.listen", config.opcua.listen))
    if config.fabric and config.fabric.listen:
        listening.append(("fabric.listen", config.fabric.listen))
    if config.web:
        listening.append(("web.listen", config.web.listen))
    if config.metrics:
        listening.append(("metrics.listen", config.metrics.listen))
    seen: list[tuple[str, str, int, set[str]]] = []
    sockets: dict[UnixAddress, str] = {}
    for key, text in listening:
        with suppress(ConfigError):
            address = parse_address(text)
            with catching():
                _compare(key, text, address, seen, sockets)


def _compare(
    key: str,
    text: str,
    address: Address | UnixAddress,
    seen: list[tuple[str, str, int, set[str]]],
    sockets: dict[UnixAddress, str],
) -> None:
    """Compare an address with those ``seen`` and with ``sockets``, and add it to them.

    Raises:
        ConfigError: Its host name cannot be resolved, or it shares a port or a path.

    """
    if isinstance(address, UnixAddress):
        if address in sockets:
            raise ConfigError(f"{key}: {sockets[address]} has the same socket, {text}; choose another path")
        sockets[address] = key
        return
    try:
        hosts = _hosts(address)
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None
    for other, seen_text, port, others in seen:
        if port == address.port != 0 and _share(hosts, others):
            raise ConfigError(f"{key}: {text} has the same port as {other} ({seen_text}); choose another port")
    seen.append((key, text, address.port, hosts))


def check_ports(plan: Plan) -> None:
    """Check that all addresses of the plan are free.

    Raises:
        EndpointError: An address is in use.

    """
    for problem in taken(plan):
        raise EndpointError(problem)


def taken(plan: Plan) -> Iterator[str]:
    """Yield a message for each address of the plan that is in use, with the program that uses it, if known.

    Other faults of an address are not checked: the process that will listen there reports them.
    """
    for job in plan.jobs:
        for text in job.listening:
            address = parse_address(text)
            if isinstance(address, UnixAddress):
                if reason := obstacle(address.path):
                    yield f"{job.name}: cannot listen on {address}: {reason}"
            elif in_use(address):
                yield f"{job.name}: cannot listen on {address}: {_holder(address)}"


def in_use(address: Address) -> bool:
    """Return whether the address is in use; for a host name, whether all of its addresses are in use.

    Raises:
        ConfigError: The host name cannot be resolved.

    """
    with suppress(OSError):
        return address.port != 0 and all(_taken(family, place) for family, place in _places(address))
    return False


def served(address: Address) -> bool:
    """Return whether a process of this host listens at the address; for a host name, at any of its addresses."""
    return any(True for _ in _listening(address))


def _places(address: Address) -> list[tuple[int, tuple[Any, ...]]]:
    """Return (family, socket address) for each address of a host.

    Raises:
        ConfigError: The host name cannot be resolved.

    """
    try:
        found = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:  # UnicodeError: a part of the name is empty, or too long
        why = error.strerror if isinstance(error, OSError) else "this is not the name of a host"
        raise ConfigError(
            f"{address}: {address.host!r} cannot be resolved ({why}); write an address or a name of this host"
        ) from None
    return [(family, place) for family, _, _, _, place in found]


def _hosts(address: Address) -> set[str]:
    """Return all addresses of a host, in the form of /proc/net/tcp."""
    return {
        _words(socket.inet_pton(family, str(place[0]).partition("%")[0])).removeprefix(_MAPPED)
        for family, place in _places(address)
    }


def _share(hosts: set[str], others: set[str]) -> bool:
    """Return whether listeners on these two sets of addresses conflict if the port is the same. [::] includes IPv4."""
    if hosts & others or _ANY in hosts | others:
        return True
    ours, theirs = ({host for host in all_ if len(host) == len(_ANY_IPV4)} for all_ in (hosts, others))
    return bool(ours and theirs and _ANY_IPV4 in ours | theirs)


def _taken(family: int, place: tuple[Any, ...]) -> bool:
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # ignore closed connections
        try:
            probe.bind(place)
        except OSError as error:
            return error.errno == errno.EADDRINUSE
    return False


def _holder(address: Address) -> str:
    """Return which process listens at an address, and what to do about it."""
    links = {f"socket:[{inode}]" for inode in _listening(address)}
    for instance in instances():
        with suppress(ShmioError):
            for process in read_status(instance).processes:
                if process.pid and any(links.intersection(_open_files(pid)) for pid in _with_children(process.pid)):
                    return (
                        f"process {process.name} of instance {instance}, pid {process.pid}, listens there; choose "
                        f"another port, or stop that instance: shmio-supervisor down --instance {instance}"
                    )
    for pid in _pids():
        if links.intersection(_open_files(pid)):
            return f"{_command(pid)}, pid {pid}, listens there; choose another port, or end that program"
    return (
        "another program listens there; choose another port, or find that program with ss -ltnp sport = "
        f":{address.port}"
    )


def _listening(address: Address) -> Iterator[str]:
    """Yield the inodes of the sockets that listen at an address."""
    wanted = _hosts(address)
    for table in ("tcp", "tcp6"):
        with suppress(OSError):
            for line in Path("/proc/net", table).read_text().splitlines()[1:]:
                fields = line.split()
                host, _, port = fields[1].partition(":")
                there = fields[3] == _LISTEN and int(port, 16) == address.port
                if there and _share({host.removeprefix(_MAPPED)}, wanted):
                    yield fields[9]


def _words(packed: bytes) -> str:
    return "".join(packed[at : at + 4][::-1].hex() for at in range(0, len(packed), 4)).upper()


def _with_children(pid: int) -> Iterator[int]:
    """Yield a process and its children.

    The broker's process, for example, has mosquitto as a child.
    """
    yield pid
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            yield from map(int, (task / "children").read_text().split())


def _pids() -> list[int]:
    return sorted(int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdecimal())


def _command(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/comm").read_text(errors="replace").strip()
    return "a program"


def _open_files(pid: int) -> Iterator[str]:
    """Yield the targets of a process's file descriptors, as far as this user may read them."""
    with suppress(OSError):
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                yield os.readlink(entry)  # noqa: PTH115 - no path: socket:[4711]
