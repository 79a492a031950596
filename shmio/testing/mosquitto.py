"""A mosquitto of a test's own, to be killed and started as it likes."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from pathlib import Path

from shmio.config import Address
from shmio.endpoints.mqtt.broker.program import find_mosquitto

PATIENCE_S = 20.0
TETHER = ("setpriv", "--pdeathsig", "KILL") if shutil.which("setpriv") else ()
"""Of util-linux: what it starts dies with the thread that starts it, so that a test run that is killed leaves none."""


def missing() -> str:
    """Why there can be none here; empty: there can."""
    return "" if find_mosquitto() else "mosquitto is not installed: apt-get install mosquitto"


class Mosquitto:
    """Keeps its port from one start to the next; its log is ``mosquitto.log`` in its folder."""

    def __init__(self, folder: Path, address: Address, *lines: str) -> None:
        """``lines``: of its configuration, after those for the port; default: anybody may connect."""
        self.folder = folder
        self.address = address
        self._file = folder / "mosquitto.conf"
        self._process: subprocess.Popen[bytes] | None = None
        head = (f"listener {address.port} {address.host}", "user root", "log_dest stderr", "log_type notice")
        self._file.write_text("\n".join((*head, *(lines or ("allow_anonymous true",)), "")))

    @property
    def log(self) -> str:
        """What it has logged so far."""
        return (self.folder / "mosquitto.log").read_text()

    @property
    def pid(self) -> int:
        """Of the process, if it runs; 0: it does not."""
        return self._process.pid if self._process else 0

    def start(self) -> None:
        """Start it; returns when it listens."""
        program = find_mosquitto() or "mosquitto"
        with (self.folder / "mosquitto.log").open("ab") as log:
            self._process = subprocess.Popen([*TETHER, program, "-c", self._file], stdout=log, stderr=log)
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
        """End it as a crash would."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(PATIENCE_S)
            self._process = None

    stop = kill
