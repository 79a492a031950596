"""Runs a program for each notice, without a shell, and limits its time and output."""

from __future__ import annotations

import logging
import os
import select
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from shmio.endpoints.alerts.notice import Notice
from shmio.endpoints.alerts.sender import DeliveryError
from shmio.wording import printable

MAX_AT_ONCE: Final = 4
"""Maximum number of commands that run at the same time, for all alerts together."""
MAX_OUTPUT_BYTES: Final = 8192
"""Maximum size in bytes of a command's output that is logged. The rest is discarded."""
LEAVE_S: Final = 1.0
"""Maximum time in s for which a running command may continue when this process stops."""

log = logging.getLogger("shmio.alerts")


class Command:
    """An action that runs a program, and passes the notice to it.

    The program gets the notice as JSON on its standard input, and as environment variables. It runs
    in a session of its own. If it takes too long, its whole process group is killed.
    """

    once = True  # nobody knows what an interrupted program has already done

    def __init__(self, arguments: Sequence[str], timeout_s: float) -> None:
        """Prepare to run a program: ``arguments`` has its name, and then its arguments."""
        self.text = f"command {arguments[0]}"
        self._arguments, self._timeout_s = list(arguments), timeout_s
        self._stopping = threading.Event()
        self._stop = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def stop(self) -> None:
        """Make :meth:`deliver` kill a running command unless it ends within ``LEAVE_S``. Any thread may call this."""
        self._stopping.set()
        os.eventfd_write(self._stop, 1)

    def deliver(self, notice: Notice) -> None:
        """Run the program, wait until it ends, and log its output.

        Raises:
            DeliveryError: The program could not be started, failed, or took too long.

        """
        stdin = os.memfd_create("notice")  # not a pipe: a program that does not read cannot block us
        try:
            os.write(stdin, notice.json())
            os.lseek(stdin, 0, os.SEEK_SET)
            process = subprocess.Popen(
                self._arguments,
                stdin=stdin,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env={**os.environ, **notice.environment()},
                start_new_session=True,
            )
        except OSError as error:
            raise DeliveryError(f"cannot be started: {error.strerror}") from None
        finally:
            os.close(stdin)
        output = _Output(process, notice.alert)
        try:
            ended = self._await(process, output)
            if not ended:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
            code = process.wait()
        finally:
            output.close()
        if not ended:
            what = "this process stops" if self._stopping.is_set() else f"it took longer than {self._timeout_s:g} s"
            raise DeliveryError(f"killed: {what}")
        if code < 0:
            raise DeliveryError(f"ended by signal {-code}")
        if code > 0:
            raise DeliveryError(f"exit status {code}")

    def _await(self, process: subprocess.Popen[bytes], output: _Output) -> bool:
        """Read the output until the program ends, and return whether it has ended in time."""
        until_s = time.monotonic() + self._timeout_s
        poll = select.poll()
        pidfd = os.pidfd_open(process.pid)
        try:
            for descriptor in (pidfd, output.descriptor, self._stop):
                poll.register(descriptor, select.POLLIN)
            while (rest_s := until_s - time.monotonic()) > 0:
                ready = [descriptor for descriptor, _ in poll.poll(1000 * rest_s)]
                if output.descriptor in ready and not output.read():
                    poll.unregister(output.descriptor)
                if pidfd in ready:
                    output.read()
                    return True
                if self._stop in ready:
                    poll.unregister(self._stop)
                    until_s = min(until_s, time.monotonic() + LEAVE_S)
            return False
        finally:
            os.close(pidfd)


class _Output:
    """Collects the start of a program's output, and logs it at the end."""

    def __init__(self, process: subprocess.Popen[bytes], alert: str) -> None:
        assert process.stdout is not None  # noqa: S101  it is a pipe
        self._pipe = process.stdout
        self._alert = alert
        self._kept = bytearray()
        self._size = 0
        self.descriptor = self._pipe.fileno()
        os.set_blocking(self.descriptor, False)

    def read(self) -> bool:
        """Read the available output, at most 64 KiB. Return False at the end of the output."""
        try:
            data = os.read(self.descriptor, 1 << 16)
        except BlockingIOError:
            return True
        self._size += len(data)
        self._kept += data[: MAX_OUTPUT_BYTES - len(self._kept)]
        return bool(data)

    def close(self) -> None:
        """Close the pipe, and log the output."""
        self._pipe.close()
        for line in self._kept.decode(errors="replace").splitlines():
            if line.strip():
                log.info("alert %s: its command printed: %s", self._alert, printable(line))
        if self._size > len(self._kept):
            log.info(
                "alert %s: its command printed %d more bytes, which the log leaves out",
                self._alert,
                self._size - len(self._kept),
            )
