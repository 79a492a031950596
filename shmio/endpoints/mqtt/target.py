"""Where the broker is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from shmio.config import Mqtt
from shmio.config.mqtt import brokers


@dataclass(frozen=True, slots=True)
class Target:
    """One broker. ``host``: the socket's path if ``transport`` is unix."""

    host: str
    port: int = 1883
    transport: Literal["tcp", "unix"] = "tcp"
    name: str = ""

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
        """The next one."""
        if self.settings.broker != "external":
            return Target(self._own_socket(), transport="unix", name="of this instance")
        address = self._addresses[self._next % len(self._addresses)]
        self._next += 1
        return Target(address.host, address.port, "tcp", str(address))
