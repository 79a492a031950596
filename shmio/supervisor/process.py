"""Starts or adopts one process, signals it, holds the pidfd that reports its end, and describes its end."""

from __future__ import annotations

import errno
import os
import re
import select
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import shmio
from shmio.realtime import ProcessorTime

NOTIFY_VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""Environment variables that the service manager sets: sd_notify(3), sd_watchdog_enabled(3)."""
_BLAS_VARIABLES = ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS")
"""Environment variables that set the number of threads of numpy's library for linear algebra."""
_DESCRIPTION = "description"
_PACKAGED = ("site-packages", "dist-packages")
_TAIL_BYTES = 4096
_STAMP = re.compile(r"^\S+Z [A-Z]+ +\S+\[\d+\] ")  # beginning of a line of shmio.logs


class ChildProcess:
    """A running child process.

    It has its own session, so that Ctrl-C in the terminal does not reach it.
    """

    def __init__(self, popen: subprocess.Popen[bytes], log_file: Path, log_size: int) -> None:
        self._popen = popen
        self._log_file = log_file
        self._log_size = log_size
        self.pid = popen.pid
        self.pidfd = os.pidfd_open(popen.pid)

    @classmethod
    def spawn(cls, module: str, description: bytes, log_file: Path) -> ChildProcess:
        """Start ``python -m module`` with ``description`` on its standard input.

        The output of the process, such as the traceback of a crash, is appended to ``log_file``.

        Raises:
            OSError: The process cannot be started.

        """
        log = _open_log(log_file)
        try:
            log_size = os.fstat(log).st_size
            # A file in memory, not a pipe: a child that does not read cannot block the supervisor.
            stdin = os.memfd_create(_DESCRIPTION)
            try:
                os.write(stdin, description)
                os.lseek(stdin, 0, os.SEEK_SET)
                popen = subprocess.Popen(
                    [sys.executable, "-P", "-m", module],
                    stdin=stdin,
                    stdout=log,
                    stderr=log,
                    env=child_environment(),
                    start_new_session=True,
                )
            finally:
                os.close(stdin)
            return cls(popen, log_file, log_size)
        finally:
            os.close(log)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self._popen.send_signal(signal.SIGTERM)

    def reread(self) -> None:
        """Send SIGHUP, which makes the process read its rules again."""
        self._popen.send_signal(signal.SIGHUP)

    def describe_again(self, description: bytes) -> None:
        """Replace the process's description, and send SIGHUP, so that the process reads it.

        Raises:
            OSError: The description cannot be replaced.

        """
        _write_description(self.pid, self.pidfd, description)
        self.reread()

    def kill(self) -> None:
        """Send SIGKILL."""
        self._popen.kill()

    def reap(self) -> int:
        """Return the exit code of the ended process (-n if signal n has killed it), and close its pidfd."""
        code = self._popen.wait()
        os.close(self.pidfd)
        return code

    def processor_time(self) -> ProcessorTime:
        """Return how long the threads of the process have run, and waited for a processor; 0 if unknown."""
        return ProcessorTime.of(self.pid)

    def last_words(self) -> str:
        """Return the last line that the process left in its log file; empty if there is none."""
        with suppress(OSError), self._log_file.open("rb") as log:
            size = os.fstat(log.fileno()).st_size
            log.seek(max(self._log_size, size - _TAIL_BYTES))
            lines = log.read(_TAIL_BYTES).decode("utf-8", "replace").split("\n")
            return _STAMP.sub("", next((line.strip() for line in reversed(lines) if line.strip()), ""))
        return ""


class AdoptedProcess:
    """A running process that another supervisor has started.

    It is not a child of this process, so its exit status remains unknown.
    """

    def __init__(self, pid: int, pidfd: int) -> None:
        """Store the process's descriptors; :meth:`reap` closes ``pidfd``."""
        self.pid = pid
        self.pidfd = pidfd

    def terminate(self) -> None:
        """Send SIGTERM."""
        self._send(signal.SIGTERM)

    def reread(self) -> None:
        """Send SIGHUP, which makes the process read its rules again."""
        self._send(signal.SIGHUP)

    def describe_again(self, description: bytes) -> None:
        """Replace the process's description, and send SIGHUP, so that the process reads it.

        Raises:
            OSError: The description cannot be replaced.

        """
        _write_description(self.pid, self.pidfd, description)
        self.reread()

    def kill(self) -> None:
        """Send SIGKILL."""
        self._send(signal.SIGKILL)

    def _send(self, sign: signal.Signals) -> None:
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, sign)

    def reap(self) -> None:
        """Wait for the end of the process, and close its pidfd."""
        select.select([self.pidfd], [], [])
        os.close(self.pidfd)

    def processor_time(self) -> ProcessorTime:
        """Return how long the threads of the process have run, and waited for a processor; 0 if unknown."""
        return ProcessorTime.of(self.pid)

    def last_words(self) -> str:
        """Return "", because it is unknown which lines of the log file are from this process."""
        return ""


def _write_description(pid: int, pidfd: int, description: bytes) -> None:
    """Replace the contents of the file in memory that is a process's standard input.

    This also reaches a process that another supervisor has started.

    Raises:
        OSError: The process has ended, or its standard input is not such a file.

    """
    path = Path(f"/proc/{pid}/fd/0")
    if not str(path.readlink()).startswith(f"/memfd:{_DESCRIPTION}"):
        raise OSError(errno.EBADF, "its standard input is not its description")
    file = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
    try:
        if select.select([pidfd], [], [], 0)[0]:  # then the file may be that of another process with this pid
            raise ProcessLookupError(errno.ESRCH, "it has ended")
        os.ftruncate(file, 0)
        os.pwrite(file, description, 0)
    finally:
        os.close(file)


def _open_log(file: Path) -> int:
    """Open a log file for appending; if that fails, open /dev/null."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        return os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        return os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)


def describe_end(code: int | None) -> str:
    """Return in words how a process ended, from its exit code; None if the code is unknown."""
    if code is None:
        return "ended; its exit status is unknown, because an earlier supervisor started it"
    if code >= 0:
        return f"exit status {code}" if code else "ended by itself"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"


def child_environment() -> dict[str, str]:
    """Return the environment of a child, in which it imports the same shmio as the supervisor.

    Children run with ``-P``, so Python does not import from the current folder. If shmio is not in
    site-packages, the folder that contains shmio is added to PYTHONPATH. (The folder site-packages
    must not be added: it would come before the standard library, and could hide modules of it.)
    """
    environment = dict(os.environ, PYTHONFAULTHANDLER="1")
    # Otherwise gRPC prints a line for each bad handshake of any client, and the log would not rotate.
    environment.setdefault("GRPC_VERBOSITY", "NONE")
    # Otherwise numpy starts a thread for each core, which doubles the time of its import. shmio multiplies no matrices.
    if not {*environment}.intersection(_BLAS_VARIABLES):
        environment[_BLAS_VARIABLES[0]] = "1"
    for name in NOTIFY_VARIABLES:  # a child must not notify the service manager
        environment.pop(name, None)
    root = Path(shmio.__file__).parents[1]
    if root.name not in _PACKAGED:
        path = environment.get("PYTHONPATH")
        environment["PYTHONPATH"] = f"{root}{os.pathsep}{path}" if path else str(root)
    return environment
