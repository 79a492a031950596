"""Listening addresses: ``host:port``, IPv6 in brackets."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from shmio.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Address:
    """A host name or literal, and a TCP port (0: any free one)."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """Read ``127.0.0.1:8089``, ``localhost:0`` or ``[::1]:8089``; ConfigError otherwise."""
        host, colon, port = text.rpartition(":")
        if host.startswith("[") and host.endswith("]"):
            host = host[1:-1]
        elif ":" in host:
            raise ConfigError(f"{text!r}: an IPv6 address is written in brackets, [::1]:8089")
        if not colon or not host or not port.isascii() or not port.isdecimal() or int(port) > 65535:
            raise ConfigError(f"{text!r} is not an address; expected host:port, such as 127.0.0.1:8089")
        return cls(host, int(port))

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it. A name other than ``localhost`` is not trusted to be."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False
