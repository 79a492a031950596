"""Where the broker is, and how we are let in: looked up anew for each attempt, so that a mended file is enough."""

from __future__ import annotations

import ssl
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from shmio.config import Mqtt, MqttTls
from shmio.config.accounts import read_password
from shmio.config.mqtt import brokers
from shmio.config.mqtttls import client_context


@dataclass(frozen=True, slots=True)
class Target:
    """One broker. ``host``: the socket's path if ``transport`` is unix."""

    host: str
    port: int = 1883
    transport: Literal["tcp", "unix"] = "tcp"
    name: str = ""
    username: str | None = None
    password: str | None = None
    context: ssl.SSLContext | None = None

    def __str__(self) -> str:
        return self.name


class Dialling:
    """Which broker is tried next."""

    def __init__(self, settings: Mqtt, client_id: str, own_socket: Callable[[], str]) -> None:
        """``own_socket``: where our own broker is reached, if there is no external one."""
        self.settings = settings
        self.client_id = client_id
        self._own_socket = own_socket
        self._addresses = brokers(settings)
        self._next = 0

    @property
    def count(self) -> int:
        """How many brokers there are."""
        return max(1, len(self._addresses))

    def repeat(self) -> None:
        """Try the last one again."""
        self._next -= 1

    def next(self) -> Target:
        """The next one. ConfigError: a file that is needed for it will not do."""
        settings = self.settings
        if settings.broker == "external":
            address = self._addresses[self._next % len(self._addresses)]
        self._next += 1
        if settings.broker != "external":
            return Target(self._own_socket(), transport="unix", name="of this instance")
        password = read_password(settings.password_file) if settings.password_file else None
        context = _context(settings.tls)
        return Target(address.host, address.port, "tcp", str(address), settings.username, password, context)


def _context(tls: MqttTls | None) -> ssl.SSLContext | None:
    return None if tls is None else client_context(tls)
