"""What a service manager is told: readiness, reloads, state, and that the loop goes round (sd_notify(3))."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from contextlib import suppress

from shmio.supervisor.process import NOTIFY_VARIABLES

SOCKET, WATCHDOG_USEC, WATCHDOG_PID = NOTIFY_VARIABLES


class Notifier:
    """Speaks to the service manager that the environment names; to nobody if it names none.

    Nothing here fails or waits: an instance runs with or without a service manager that listens.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._path = _path(environment.get(SOCKET, ""))
        self._period_ns = _watchdog_ns(environment) // 2  # twice as often as is asked for
        self._beat_ns = 0

    def ready(self) -> None:
        """The start, or a reload, is over."""
        self._send("READY=1")

    def reloading(self) -> None:
        """A reload has begun."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """The stop has begun."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """A line for people."""
        self._send("STATUS=" + text.replace("\n", " "))

    def beat(self, now_ns: int) -> None:
        """The loop goes round; told as often as the service manager wants to know."""
        if self._period_ns and now_ns - self._beat_ns >= self._period_ns:
            self._beat_ns = now_ns
            self._send("WATCHDOG=1")

    def _send(self, *lines: str) -> None:
        if not self._path:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
            client.setblocking(False)
            client.sendto("\n".join(lines).encode(), self._path)


def _path(name: str) -> str:
    """The address of the socket: a path, or an abstract name, which begins with ``@``; empty for others."""
    if name.startswith("@"):
        return "\0" + name[1:]
    return name if name.startswith("/") else ""


def _watchdog_ns(environment: Mapping[str, str]) -> int:
    """How often the service manager expects to hear; 0: never, or it means another process."""
    if environment.get(WATCHDOG_PID, str(os.getpid())) != str(os.getpid()):
        return 0
    text = environment.get(WATCHDOG_USEC, "")
    return int(text) * 1000 if text.isascii() and text.isdigit() else 0
