"""A whole cell that a test starts and stops with shmio's commands, and helpers for such tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from shmio.config import Address
from shmio.errors import ConfigError

BIN = Path(os.environ.get("SHMIO_BIN", Path(sys.executable).parent))
"""Folder with shmio's commands."""
PATIENCE_S = 120.0

CONFIG = """
[instance]
name = "{instance}"

[[source]]
name = "cell"
connector = "s7"
layout = "db201.db"
period_ms = {period_ms}
host = "127.0.0.1"
port = {plc.port}
timeout = 1000

[[emulator]]
name = "plc"
kind = "s7"
layout = "db201.db"
program = "a50"
listen = "{plc}"

[grpc]
listen = ["{grpc}"]
"""


class Cell:
    """An instance in a folder, which tests control with shmio's commands."""

    def __init__(self, folder: Path, instance: str, grpc: Address) -> None:
        self.folder = folder
        self.instance = instance
        self.grpc = grpc

    def supervisor(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run ``shmio-supervisor`` with these arguments on this instance."""
        return self.run("shmio-supervisor", *arguments)

    def run(self, command: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run one of shmio's commands in the cell's folder."""
        return subprocess.run(
            [BIN / command, *arguments],
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )

    def output(self, command: str, *arguments: str) -> str:
        """Run one of shmio's commands, and return what it prints.

        Raises:
            AssertionError: The command failed. The message has its error output and the instance's logs.

        """
        done = self.run(command, *arguments)
        if done.returncode:
            line = " ".join((command, *arguments))
            raise AssertionError(f"{line}: exit status {done.returncode}\n{done.stdout}{done.stderr}\n{self.logs()}")
        return done.stdout

    def up(self) -> None:
        """Start the instance in the background. Return when it runs."""
        self.output("shmio-supervisor", "up", "--detach")

    def down(self) -> None:
        """Stop the instance. Return when it has ended."""
        self.output("shmio-supervisor", "down")

    def status(self) -> dict[str, Any]:
        """Return what ``shmio-supervisor status --json`` prints. This starts no process."""
        from shmio.local.status import read_status  # noqa: PLC0415  not part of shmio-client

        status: dict[str, Any] = msgspec.to_builtins(read_status(self.instance, ""))
        return status

    def processes(self) -> dict[str, dict[str, Any]]:
        """Return the processes of :meth:`status`, by name."""
        return {process["name"]: process for process in self.status()["processes"]}

    def logs(self) -> str:
        """Return all log files as text, for the message of a failing test."""
        return "\n".join(
            f"--- {file.name}\n{file.read_text()}" for file in sorted((self.folder / "logs").glob("*.log"))
        )


def until(condition: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> None:
    """Wait until ``condition`` returns true. After ``patience_s``, raise AssertionError, which names ``what``."""
    deadline = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > deadline:
            raise AssertionError(f"this did not become true within {patience_s} s: {what}")
        time.sleep(0.01)


def kill(pid: int, sign: signal.Signals = signal.SIGKILL) -> None:
    """Send a signal to a process that need not be a child.

    A pidfd keeps the signal from another process if this one ends during the call. The pid must be
    valid when the call begins.
    """
    handle = os.pidfd_open(pid)
    try:
        signal.pidfd_send_signal(handle, sign)
    finally:
        os.close(handle)


def may_be_realtime() -> bool:
    """Return whether this user may have a real-time priority."""
    from shmio import realtime  # noqa: PLC0415  not part of shmio-client

    try:
        realtime.check(1)
    except ConfigError:
        return False
    return True
