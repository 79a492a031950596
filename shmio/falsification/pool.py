"""Runs several trials at once, in separate processes."""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final, Protocol, Self, cast

import msgspec

from shmio.falsification.trial import Result, Task

READ_BYTES: Final = 1 << 16
MAX_LINE_BYTES: Final = 1 << 24
"""Maximum size in bytes of an answer from a process."""
START_S: Final = 120.0
"""Maximum time in s that a process may take to start; this time does not count for its first trial."""
END_S: Final = 5.0
"""Maximum time in s that an idle process may take to end when the pool is closed."""


@dataclass
class _Process:
    """A process, and the trial that it runs. It is ready when it has sent an empty line."""

    popen: subprocess.Popen[bytes]
    stdin: IO[bytes]
    stdout: IO[bytes]
    unsent: bytes = b""
    """The part of the present task that its pipe has no room for yet."""
    task: Task | None = None
    since_s: float = 0.0
    ready: bool = False
    answer: bytearray = field(default_factory=bytearray)


class TrialPool(Protocol):
    """Runs trials, several at once, for a search."""

    @property
    def jobs(self) -> int:
        """Maximum number of trials at once."""
        ...

    @property
    def idle(self) -> int:
        """Number of trials that can be submitted now."""
        ...

    def submit(self, task: Task) -> None:
        """Start a trial. There must be an idle place."""
        ...

    def wait(self, timeout_s: float) -> list[Result]:
        """Wait for results, for at most ``timeout_s`` seconds. Return the results that have arrived."""
        ...

    def cancel(self) -> None:
        """End the trials that are running, without results."""
        ...


class Pool:
    """A pool of processes that run trials. A process that ends or takes too long is replaced for the next trial."""

    def __init__(self, config: Path, folder: Path, jobs: int, limit_s: float, home: Path | None = None) -> None:
        """Create the pool. Processes start when they are needed.

        Args:
            config: The ``supervisor.toml``.
            folder: Folder of the campaign file.
            jobs: Maximum number of trials at once.
            limit_s: Maximum duration of a trial, in s of real time.
            home: Current folder of the processes; None: that of this process.

        """
        self.jobs = jobs
        self._config, self._folder, self._limit_s, self._home = config, folder, limit_s, home
        self._processes: list[_Process] = []
        self._selector = selectors.DefaultSelector()

    @property
    def idle(self) -> int:
        """Number of trials that can be submitted now."""
        return self.jobs - sum(one.task is not None for one in self._processes)

    def submit(self, task: Task) -> None:
        """Start a trial. Call this only if :attr:`idle` is not 0."""
        one = next((one for one in self._processes if one.task is None), None) or self._start()
        one.task, one.since_s = task, time.monotonic()
        one.answer.clear()
        one.unsent = msgspec.json.encode(task) + b"\n"
        self._send(one)

    def _send(self, one: _Process) -> None:
        """Send as much of a task as the pipe takes. A process that hangs delays nobody."""
        try:
            one.unsent = one.unsent[os.write(one.stdin.fileno(), one.unsent) :]
        except BlockingIOError:
            pass
        except BrokenPipeError:  # wait() finds that it has ended
            one.unsent = b""
        waits = one.stdin in self._selector.get_map()
        if one.unsent and not waits:
            self._selector.register(one.stdin, selectors.EVENT_WRITE, one)
        elif waits and not one.unsent:
            self._selector.unregister(one.stdin)

    def wait(self, timeout_s: float) -> list[Result]:
        """Wait at most ``timeout_s`` seconds for results, and return the results that have arrived."""
        left_s = [self._left_s(one) for one in self._processes if one.task is not None]
        ready = self._selector.select(max(0.0, min([timeout_s, *left_s])))
        for key, events in ready:
            if events & selectors.EVENT_WRITE:
                self._send(key.data)
        reads = [key.data for key, events in ready if events & selectors.EVENT_READ]
        found = [result for one in reads if (result := self._read(one)) is not None]
        for one in list(self._processes):
            if one.task is not None and self._left_s(one) <= 0:
                number = one.task.number
                why = f"it took longer than {self._limit_s:g} s (--limit)" if one.ready else "its process did not start"
                self._end(one)
                found.append(Result(number, "error", reason=why))
        return found

    def _left_s(self, one: _Process) -> float:
        """Return the time in s after which a process takes too long."""
        return one.since_s + (self._limit_s if one.ready else START_S) - time.monotonic()

    def run(self, task: Task) -> Result:
        """Run a trial, and return its result. No other trial may be running."""
        self.submit(task)
        while not (found := self.wait(self._limit_s)):
            pass
        return found[0]

    def cancel(self) -> None:
        """End all running trials, without results."""
        for one in list(self._processes):
            if one.task is not None:
                self._end(one)

    def _start(self) -> _Process:
        command = [sys.executable, "-P", "-m", "shmio.falsification.worker", str(os.getpid()), str(self._config)]
        popen = subprocess.Popen(
            [*command, str(self._folder)],
            cwd=self._home,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
        )
        one = _Process(popen, cast("IO[bytes]", popen.stdin), cast("IO[bytes]", popen.stdout))
        os.set_blocking(one.stdin.fileno(), False)
        self._selector.register(one.stdout, selectors.EVENT_READ, one)
        self._processes.append(one)
        return one

    def _read(self, one: _Process) -> Result | None:
        data = os.read(one.stdout.fileno(), READ_BYTES)
        one.answer += data
        if data and not one.answer.endswith(b"\n") and len(one.answer) < MAX_LINE_BYTES:
            return None
        if one.answer == b"\n":
            one.ready, one.since_s = True, time.monotonic()
            one.answer.clear()
            return None
        task, one.task, one.ready = one.task, None, True
        try:
            result = msgspec.json.decode(one.answer, type=Result)
        except msgspec.DecodeError:
            result = None
        if result is None or not data:
            ended = self._end(one)
            result = None if task is None else Result(task.number, "error", reason=f"its process {ended}")
        return result

    def _end(self, one: _Process) -> str:
        """End a process at once, and return how it ended."""
        self._processes.remove(one)
        self._selector.unregister(one.stdout)
        if one.unsent:
            self._selector.unregister(one.stdin)
        one.stdin.close()
        one.stdout.close()
        try:
            status = one.popen.wait(0 if one.task is not None else END_S)
        except subprocess.TimeoutExpired:
            one.popen.kill()
            status = one.popen.wait()
        return f"was ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for one in list(self._processes):
            self._end(one)
        self._selector.close()
