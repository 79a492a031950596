"""Addresses to listen on: ``host:port`` (IPv6 in brackets), or ``unix:PATH`` for a UNIX socket."""

from __future__ import annotations

import os
import re
from typing import Final

import msgspec

from shmio.errors import ConfigError

UNIX: Final = "unix:"
_LOOPBACK: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104  keys
"""The loopback address for each address that stands for all addresses of a host."""
MAX_PATH_BYTES: Final = 107
"""Maximum length in bytes of a UNIX socket's path: ``sun_path`` holds 108, including a final zero (unix(7))."""


class Address(msgspec.Struct, frozen=True):
    """A host name or IP address, and a TCP port; port 0 stands for any free port."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """Parse ``127.0.0.1:8089``, ``localhost:0`` or ``[::1]:8089``.

        Raises:
            ConfigError: The text is not an address.

        """
        host, colon, port = text.rpartition(":")
        if host.startswith("[") and host.endswith("]"):
            host = host[1:-1]
        elif ":" in host:
            raise ConfigError(f"{text!r}: write an IPv6 address in brackets, such as [::1]:8089")
        if not colon or not host or not port.isascii() or not port.isdecimal() or int(port) > 65535:
            raise ConfigError(f"{text!r} is not an address; expected host:port, such as 127.0.0.1:8089")
        check_host(host)
        return cls(host, int(port))

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @property
    def wildcard(self) -> bool:
        """True if the address stands for all addresses of this host."""
        return self.host in _LOOPBACK

    @property
    def here(self) -> Address:
        """The address at which this host itself reaches a server that listens at this address."""
        return Address(_LOOPBACK.get(self.host, self.host), self.port)

    @property
    def loopback(self) -> bool:
        """True if only this host can reach the address.

        Any host name except ``localhost`` counts as reachable from other hosts.
        """
        if self.host == "localhost":
            return True
        import ipaddress  # noqa: PLC0415  takes 1 ms, and most processes check no address

        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False


_NUMERIC: Final = re.compile(r"[0-9]+(\.[0-9]+)+")


def check_host(host: str) -> None:
    """Refuse numbers with dots that are not an IPv4 address, or that may be read as octal.

    Raises:
        ConfigError: The text is such. Whether a host has this name is not checked.

    """
    if _NUMERIC.fullmatch(host) and not _is_ipv4(host):
        raise ConfigError(f"{host!r} is not an IP address; write four numbers from 0 to 255, such as 192.168.0.10")
    if _NUMERIC.fullmatch(host) and (plain := ".".join(str(int(part)) for part in host.split("."))) != host:
        raise ConfigError(
            f"{host!r} is not clear, because libraries read a number that begins with 0 as octal; write {plain}"
        )


def _is_ipv4(text: str) -> bool:
    parts = text.split(".")
    return len(parts) == 4 and all(len(part) <= 3 and int(part) <= 255 for part in parts)


class UnixAddress(msgspec.Struct, frozen=True):
    """The path of a UNIX socket."""

    path: str

    @classmethod
    def parse(cls, text: str) -> UnixAddress:
        """Parse ``unix:PATH``, or ``unix:///PATH`` as gRPC writes it.

        Raises:
            ConfigError: The text is not a UNIX socket's address, or the path is too long.

        """
        path = text.removeprefix(UNIX)
        if path.startswith("//"):
            path = path[2:]
        if not text.startswith(UNIX) or not path:
            raise ConfigError(f"{text!r} is not a UNIX socket; expected unix:PATH, such as unix:run/shmio.sock")
        if len(os.fsencode(path)) > MAX_PATH_BYTES:
            raise ConfigError(
                f"{text}: the path of a UNIX socket has at most {MAX_PATH_BYTES} bytes; choose a shorter path"
            )
        return cls(path)

    def __str__(self) -> str:
        return f"{UNIX}{self.path}"

    @property
    def loopback(self) -> bool:
        """Always True, because only this host can reach a UNIX socket."""
        return True


def parse_address(text: str) -> Address | UnixAddress:
    """Parse ``host:port`` or ``unix:PATH``.

    Raises:
        ConfigError: The text is not an address.

    """
    return UnixAddress.parse(text) if text.startswith(UNIX) else Address.parse(text)
