"""Decides which broker to try next, and how long to wait before the attempt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from shmio.backoff import Backoff
from shmio.config import Mqtt
from shmio.config.mqtt import brokers

RECONNECT: Final = Backoff(0.25, 15.0, jitter=0.5)
"""Waiting times before attempts to connect.

They vary at random, so that the bridges of a plant do not all reconnect at the same time.
"""
RECONNECT_OWN: Final = Backoff(0.25, 0.5, jitter=0.5)
"""Waiting times before attempts to connect to the instance's own broker.

They are short, because this broker runs on this host and is restarted at once.
"""


@dataclass(frozen=True, slots=True)
class Target:
    """The address of a broker. If ``transport`` is ``unix``, ``host`` is the path of its socket."""

    host: str
    port: int = 1883
    transport: Literal["tcp", "unix"] = "tcp"
    name: str = ""

    def __str__(self) -> str:
        return self.name


def targets(settings: Mqtt, own_socket: str) -> list[Target]:
    """Return the addresses of the brokers, in the order in which to try them.

    Args:
        settings: The configuration's ``[mqtt]`` section.
        own_socket: Path of the socket of the instance's own broker, which is used unless the
            configured broker is external.

    """
    if settings.broker != "external":
        return [Target(own_socket, transport="unix", name="of this instance")]
    return [Target(address.host, address.port, "tcp", str(address)) for address in brokers(settings)]


class ReconnectPolicy:
    """Chooses the broker to try next, and how long to wait before the attempt."""

    def __init__(self, settings: Mqtt, client_id: str, there: Sequence[Target]) -> None:
        self.settings = settings
        self.client_id = client_id
        self._targets = there
        self._next = 0
        self._failures = 0

    @property
    def count(self) -> int:
        """Number of brokers."""
        return len(self._targets)

    def use_only(self, target: Target) -> None:
        """Try only this broker from now on."""
        self._targets = [target]
        self.reset_failures()

    def retry_same(self) -> None:
        """Make :meth:`next` return the last broker once more."""
        self._next -= 1

    def next(self) -> Target:
        """Return the next broker to try. The brokers take turns."""
        self._next += 1
        return self._targets[(self._next - 1) % len(self._targets)]

    def wait_s(self) -> float:
        """Count a failure, and return the wait before the next attempt, in s.

        The wait grows with each failure.
        """
        backoff = RECONNECT_OWN if all(target.transport == "unix" for target in self._targets) else RECONNECT
        wait_s = backoff.wait_s(self._failures // self.count)
        self._failures += 1
        return wait_s

    def reset_failures(self) -> None:
        """Reset the back-off."""
        self._failures = 0
