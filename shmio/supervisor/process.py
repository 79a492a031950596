"""One process: started by exec or taken over, watched through its pidfd, its end put into words."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import shmio

NOTIFY_VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""What a service manager tells its service by, sd_notify(3), sd_watchdog_enabled(3)."""
_PACKAGED = ("site-packages", "dist-packages")
_TAIL_BYTES = 4096
_STAMP = re.compile(r"^\S+Z [A-Z]+ +\S+\[\d+\] ")  # what begins a line of shmio.logs


class ChildProcess:
    """A running child process in a session of its own, which Ctrl-C at the terminal does not reach."""

    def __init__(self, popen: subprocess.Popen[bytes], log_file: Path, log_size: int) -> None:
        self._popen = popen
        self._log_file = log_file
        self._log_size = log_size
        self.pid = popen.pid
        self.pidfd = os.pidfd_open(popen.pid)

    @classmethod
    def spawn(cls, module: str, description: bytes, log_file: Path) -> ChildProcess:
        """Start ``python -m module`` with ``description`` as its standard input; OSError when the host cannot.

        What it prints, such as the traceback of an interpreter that dies, goes to the end of its log file.
        """
        log = _open_log(log_file)
        try:
            log_size = os.fstat(log).st_size
            # A file in memory, not a pipe: a child that never reads cannot block its supervisor.
            stdin = os.memfd_create("description")
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
        """Ask it to end."""
        self._popen.send_signal(signal.SIGTERM)

    def reread(self) -> None:
        """Have it read anew what it may take while it runs."""
        self._popen.send_signal(signal.SIGHUP)

    def kill(self) -> None:
        """End it."""
        self._popen.kill()

    def reap(self) -> int:
        """The return code of a process whose pidfd is readable (-n: killed by signal n); the pidfd is closed."""
        code = self._popen.wait()
        os.close(self.pidfd)
        return code

    def last_words(self) -> str:
        """The last line that this process left in its log file; empty when it left none."""
        with suppress(OSError), self._log_file.open("rb") as log:
            size = os.fstat(log.fileno()).st_size
            log.seek(max(self._log_size, size - _TAIL_BYTES))
            lines = log.read(_TAIL_BYTES).decode("utf-8", "replace").split("\n")
            return _STAMP.sub("", next((line.strip() for line in reversed(lines) if line.strip()), ""))
        return ""


class AdoptedProcess:
    """A running process that another supervisor has started: not a child of this one, so it has no exit status."""

    def __init__(self, pid: int, pidfd: int) -> None:
        """``pidfd`` is closed by :meth:`reap`."""
        self.pid = pid
        self.pidfd = pidfd

    def terminate(self) -> None:
        """Ask it to end."""
        self._send(signal.SIGTERM)

    def reread(self) -> None:
        """Have it read anew what it may take while it runs."""
        self._send(signal.SIGHUP)

    def kill(self) -> None:
        """End it."""
        self._send(signal.SIGKILL)

    def _send(self, sign: signal.Signals) -> None:
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, sign)

    def reap(self) -> None:
        """Wait for its end."""
        select.select([self.pidfd], [], [])
        os.close(self.pidfd)

    def last_words(self) -> str:
        """It is not known where in its log file they would begin."""
        return ""


def _open_log(file: Path) -> int:
    """Open a log file for appending. A controller is read with or without one."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        return os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        return os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)


def describe_end(code: int | None) -> str:
    """A return code in words; None: it is not known."""
    if code is None:
        return "ended; its exit status is not known, for an earlier supervisor had started it"
    if code >= 0:
        return f"exit status {code}" if code else "ended by itself"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"


def child_environment() -> dict[str, str]:
    """The environment of a child: it must find the shmio that its supervisor is, and no namesakes in this folder.

    Hence ``-P``, and the folder of a shmio that is not installed (never site-packages, which would then come before
    the standard library).
    """
    environment = dict(os.environ, PYTHONFAULTHANDLER="1")
    # gRPC prints a line for each bad handshake, which any client may send, into a log that would not even rotate then.
    environment.setdefault("GRPC_VERBOSITY", "NONE")
    for name in NOTIFY_VARIABLES:  # a child must not speak to the service manager in the supervisor's name
        environment.pop(name, None)
    root = Path(shmio.__file__).parents[1]
    if root.name not in _PACKAGED:
        path = environment.get("PYTHONPATH")
        environment["PYTHONPATH"] = f"{root}{os.pathsep}{path}" if path else str(root)
    return environment
