"""The process of a server that the instance runs: an MQTT broker, or a NATS server."""

from __future__ import annotations

import os
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol

from shmio.errors import EndpointError
from shmio.realtime import ProcessorTime
from shmio.worker import BEAT_S, Worker

START_S: Final = 10.0
"""Longest time in s until the server accepts connections."""
PAUSE_S: Final = 0.02
"""Pause in s between two attempts to connect to a server that starts."""
ASK_S: Final = 2.0
"""Pause in s between an answer of the server and the next question."""
LATE_S: Final = 1.0
"""Time in s without an answer that counts as a problem."""
CONNECT_S: Final = 1.0
"""Longest time in s to open the connection for the questions."""
HANG_S: Final = 5.0
"""Time in s without an answer after which the server counts as hung, as the supervisor's processes do.

Time for which it has waited for a processor does not count.
"""


class Probe(NamedTuple):
    """A question that a running server answers at once, and the connection for it.

    Attributes:
        connect: Opens a connection, and returns its socket. It may take ``CONNECT_S``, and may raise
            OSError.
        hello: What to send over a new connection. The server answers at once.
        ping: What to send later. The server answers at once.

    """

    connect: Callable[[], socket.socket]
    hello: bytes
    ping: bytes


class ServerProcess:
    """Runs another program as a server, and reads its log.

    Start it from the main thread, because the process ends with the thread that started it.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        stop_s: float,
        read: Callable[[str], str],
        probe: Probe,
    ) -> None:
        """Start the process.

        Args:
            name: Name of the server in messages.
            command: The program and its arguments.
            stop_s: Time that the process has to end before it is killed, in s.
            read: Called in another thread with each line of the log. It returns the text to show if
                the server ends; empty to keep the text of an earlier line.
            probe: How to find out whether the server answers.

        Raises:
            OSError: The process cannot be started.

        """
        self._liveness = Liveness(name, probe)
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
            self._check_end()
            try:
                if accepts():
                    return
            except OSError:
                pass  # not yet
            if time.monotonic() > until_s:
                raise EndpointError(f"{self._name} does not accept connections: {self._last}")
            beat()
            time.sleep(PAUSE_S)

    @property
    def problem(self) -> str:
        """The problem of the running server; empty if there is none."""
        return self._liveness.problem

    def check(self) -> None:
        """Check that the server is running, and that it answers. Call this each ``BEAT_S``.

        Raises:
            EndpointError: The server has ended, or hangs.

        """
        self._check_end()
        self._liveness.check(self._process.pid)

    def _check_end(self) -> None:
        code = self._process.poll()
        if code is not None:
            self._reader.join(1.0)
            raise EndpointError(f"{self._name} has ended: {self._last or f'exit status {code}'}")

    def stop(self) -> None:
        """Stop the server; kill it if it hangs."""
        self._liveness.close()
        if self._liveness.hangs:
            self._process.kill()
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


class Liveness:
    """Asks a server again and again whether it answers, without waiting for it."""

    def __init__(self, name: str, probe: Probe) -> None:
        """Create the object; the arguments are those of :class:`ServerProcess`."""
        self._name, self._probe = name, probe
        self._socket: socket.socket | None = None
        self._asked = False
        self._answered_s = time.monotonic()
        self._checked_s: float | None = None
        """When the server was asked, or when its answer was last looked for; None: no answer is due."""
        self._quiet_s = 0.0
        self._used: ProcessorTime | None = None
        """How the server had been scheduled when its answer became late; None: it is not late."""
        self.problem = ""
        """That the server does not answer; empty if it does."""
        self.hangs = False

    def check(self, pid: int) -> None:
        """Look for the answer to the last question, or ask again if that is due.

        Args:
            pid: The server's process.

        Raises:
            EndpointError: The server hangs.

        """
        now_s = time.monotonic()
        if self._checked_s is not None:
            # If this process was paused (host suspended, container paused), so was the server, and this time does not
            # count.
            self._quiet_s += min(now_s - self._checked_s, CONNECT_S + 2 * BEAT_S)
        elif now_s - self._answered_s < ASK_S:
            return
        self._checked_s = now_s
        try:
            answered = self._answered() if self._asked else self._ask()
        except (BlockingIOError, TimeoutError, ssl.SSLWantReadError):
            answered = False
        except OSError:  # that the server ends or refuses the connection is an answer, too
            self.close()
            answered = True
        if answered:
            self._asked, self._answered_s, self._quiet_s = False, now_s, 0.0
            self._checked_s, self._used, self.problem = None, None, ""
        else:
            self._judge(pid)

    def _ask(self) -> bool:
        if self._socket is None:
            self._socket = self._probe.connect()
            self._socket.setblocking(False)
            self._socket.sendall(self._probe.hello)
        else:
            self._socket.sendall(self._probe.ping)
        self._asked = True
        return False

    def _answered(self) -> bool:
        if self._socket is not None and not self._socket.recv(1 << 16):
            self.close()
        return True

    def _judge(self, pid: int) -> None:
        if self._quiet_s < LATE_S:
            return
        present = ProcessorTime.of(pid)
        if self._used is None:
            self._used = present
        used = present.since(self._used)
        self.problem = f"{self._name} has not answered for {self._quiet_s:.0f} s"
        if self._quiet_s - used.waited_ns / 1e9 >= HANG_S:  # a server that gets no processor does not hang
            self.hangs = True
            raise EndpointError(
                f"{self._name} hangs: it has not answered for {self._quiet_s:.0f} s, in which {used}; it was killed"
            )

    def close(self) -> None:
        """Close the connection to the server."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None


class Server(Protocol):
    """A server as :func:`serve` uses it; the methods are like those of :class:`ServerProcess`."""

    def await_start(self, beat: Callable[[], object]) -> None:
        """Wait until the server accepts connections."""

    @property
    def problem(self) -> str:
        """The problem of the running server; empty if there is none."""

    def check(self) -> None:
        """Check that the server is running, and that it answers."""

    def stop(self) -> None:
        """Stop the server."""


def serve(worker: Worker, server: Server, started: str) -> None:
    """Run a server until the worker is stopped.

    Args:
        worker: The process that runs the server.
        server: The server, which has been started.
        started: Text to log as soon as the server accepts connections.

    Raises:
        EndpointError: The server does not start, has ended, or hangs.

    """
    try:
        server.await_start(worker.report)
        worker.log.info("%s", started)
        worker.running()
        problem = ""
        while not worker.stopping.wait(BEAT_S):
            server.check()
            if server.problem and not problem:
                worker.log.warning("%s", server.problem)
            problem = server.problem
            worker.report(note=problem)
    finally:
        server.stop()
