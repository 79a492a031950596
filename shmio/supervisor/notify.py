"""Notifies the service manager: readiness, reloads, state, and the watchdog (sd_notify(3))."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from contextlib import suppress

from shmio.supervisor.process import NOTIFY_VARIABLES

SOCKET, WATCHDOG_USEC, WATCHDOG_PID = NOTIFY_VARIABLES


class Notifier:
    """Notifies the service manager that the environment names, if any.

    Nothing here fails or blocks: an instance runs with or without a service manager.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._path = _path(environment.get(SOCKET, ""))
        self._period_ns = _watchdog_ns(environment) // 2  # twice as often as is asked for
        self._beat_ns = 0

    def ready(self) -> None:
        """Report that the start or a reload is over."""
        self._send("READY=1")

    def reloading(self) -> None:
        """Report that a reload has begun."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """Report that the stop has begun."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """Report a line of text for people."""
        self._send("STATUS=" + text.replace("\n", " "))

    def beat(self, now_ns: int) -> None:
        """Trigger the watchdog, as often as the service manager asks."""
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
    """Return the address of the socket: a path, or an abstract name after ``@``.

    Empty for others.
    """
    if name.startswith("@"):
        return "\0" + name[1:]
    return name if name.startswith("/") else ""


def _watchdog_ns(environment: Mapping[str, str]) -> int:
    """Return the watchdog period in ns; 0 if there is none, or it is for another process."""
    if environment.get(WATCHDOG_PID, str(os.getpid())) != str(os.getpid()):
        return 0
    text = environment.get(WATCHDOG_USEC, "")
    return int(text) * 1000 if text.isascii() and text.isdigit() else 0
