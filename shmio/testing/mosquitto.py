"""A mosquitto broker that a test may kill and restart."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from pathlib import Path

from shmio.config import Address
from shmio.endpoints.mqtt.broker.program import find_mosquitto

PATIENCE_S = 20.0
KILL_WITH_PARENT = ("setpriv", "--pdeathsig", "KILL") if shutil.which("setpriv") else ()
"""Prefix of the broker's command, by which the broker ends with the thread that started it."""


def missing() -> str:
    """Return why mosquitto cannot run here; empty if it can."""
    return "" if find_mosquitto() else "mosquitto is not installed: apt-get install mosquitto"


class Mosquitto:
    """A broker that keeps its port across restarts. Its log is ``mosquitto.log`` in its folder."""

    def __init__(self, folder: Path, address: Address, *lines: str) -> None:
        """Write a configuration with the port and ``lines``.

        Without ``lines``, anybody may connect.
        """
        self.folder = folder
        self.address = address
        self._file = folder / "mosquitto.conf"
        self._process: subprocess.Popen[bytes] | None = None
        head = (f"listener {address.port} {address.host}", "user root", "log_dest stderr", "log_type notice")
        self._file.write_text("\n".join((*head, *(lines or ("allow_anonymous true",)), "")))

    @property
    def log(self) -> str:
        """Text of the log file."""
        return (self.folder / "mosquitto.log").read_text()

    @property
    def pid(self) -> int:
        """Pid of the broker; 0 if it does not run."""
        return self._process.pid if self._process else 0

    def start(self) -> None:
        """Start the broker. Return when it listens."""
        program = find_mosquitto() or "mosquitto"
        with (self.folder / "mosquitto.log").open("ab") as log:
            self._process = subprocess.Popen([*KILL_WITH_PARENT, program, "-c", self._file], stdout=log, stderr=log)
        until_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                socket.create_connection((self.address.host, self.address.port), timeout=PATIENCE_S).close()
            except ConnectionRefusedError:
                if time.monotonic() > until_s or self._process.poll() is not None:
                    raise AssertionError(self.log) from None
                time.sleep(0.005)
            else:
                return

    def kill(self) -> None:
        """Kill the broker, as in a crash."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(PATIENCE_S)
            self._process = None

    stop = kill
