"""The process of a server that the instance runs: an MQTT broker, or a NATS server."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from shmio.errors import EndpointError
from shmio.worker import BEAT_S, Worker

START_S: Final = 10.0
"""Longest time in s until the server accepts connections."""
PAUSE_S: Final = 0.02
"""Pause in s between two attempts to connect to a server that starts."""


class ServerProcess:
    """Runs another program as a server, and reads its log.

    Start it from the main thread, because the process ends with the thread that started it.
    """

    def __init__(self, name: str, command: Sequence[str], stop_s: float, read: Callable[[str], str]) -> None:
        """Start the process.

        Args:
            name: Name of the server in messages.
            command: The program and its arguments.
            stop_s: Time that the process has to end before it is killed, in s.
            read: Called in another thread with each line of the log. It returns the text to show if
                the server ends; empty to keep the text of an earlier line.

        Raises:
            OSError: The process cannot be started.

        """
        self._name, self._stop_s, self._read = name, stop_s, read
        self._last = ""
        parent = [sys.executable, "-P", "-m", "shmio.parent", str(os.getpid())]
        self._process = subprocess.Popen(
            [*parent, *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
        )
        self._reader = threading.Thread(target=self._read_log, name=f"log of {name}", daemon=True)
        self._reader.start()

    def await_start(self, accepts: Callable[[], bool], beat: Callable[[], object]) -> None:
        """Wait until the server accepts connections.

        Args:
            accepts: Returns whether the server accepts a connection. It may raise OSError if not.
            beat: Called repeatedly while waiting.

        Raises:
            EndpointError: The server has ended, or takes too long. The message has its last text.

        """
        until_s = time.monotonic() + START_S
        while True:
            self.check()
            try:
                if accepts():
                    return
            except OSError:
                pass  # not yet
            if time.monotonic() > until_s:
                raise EndpointError(f"{self._name} does not accept connections: {self._last}")
            beat()
            time.sleep(PAUSE_S)

    def check(self) -> None:
        """Check that the server is running.

        Raises:
            EndpointError: The server has ended.

        """
        code = self._process.poll()
        if code is not None:
            self._reader.join(1.0)
            raise EndpointError(f"{self._name} has ended: {self._last or f'exit status {code}'}")

    def stop(self) -> None:
        """Stop the server."""
        self._process.terminate()
        try:
            self._process.wait(self._stop_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(1.0)
        if self._process.stderr is not None:
            self._process.stderr.close()

    def _read_log(self) -> None:
        for line in self._process.stderr or ():
            self._last = self._read(line.strip()) or self._last


class Server(Protocol):
    """A server as :func:`serve` uses it; the methods are like those of :class:`ServerProcess`."""

    def await_start(self, beat: Callable[[], object]) -> None:
        """Wait until the server accepts connections."""

    def check(self) -> None:
        """Check that the server is running."""

    def stop(self) -> None:
        """Stop the server."""


def serve(worker: Worker, server: Server, started: str) -> None:
    """Run a server until the worker is stopped.

    Args:
        worker: The process that runs the server.
        server: The server, which has been started.
        started: Text to log as soon as the server accepts connections.

    Raises:
        EndpointError: The server does not start, or has ended.

    """
    try:
        server.await_start(worker.report)
        worker.log.info("%s", started)
        worker.running()
        while not worker.stopping.wait(BEAT_S):
            server.check()
            worker.report()
    finally:
        server.stop()
