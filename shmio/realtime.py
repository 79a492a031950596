"""How the kernel gives processors to threads: real-time priority (sched(7)), and how long they ran and waited.

A thread with real-time priority runs before all threads without it.
"""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

from shmio.errors import ConfigError


def prioritise(priority: int) -> None:
    """Give the calling thread, and threads that it starts later, this priority, with SCHED_FIFO.

    Raises:
        ConfigError: This user may not use the priority. The message contains the remedy.

    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:  # also EPERM if the process's control group has no real-time budget
        raise ConfigError(
            f"realtime_priority: this user may not have {priority} ({error.strerror}); allow it (LimitRTPRIO= in the "
            "service's unit, rtprio in limits.conf, --ulimit rtprio of a container), or leave the key out"
        ) from None


def check(priority: int) -> None:
    """Raise ConfigError unless processes of this user may use this priority."""
    refused: list[ConfigError] = []

    def attempt() -> None:
        try:
            prioritise(priority)
        except ConfigError as error:
            refused.append(error)

    thread = threading.Thread(target=attempt, name="priority")  # in a thread, so that the caller keeps its priority
    thread.start()
    thread.join()
    if refused:
        raise refused[0]


class ProcessorTime(NamedTuple):
    """How the kernel has scheduled a process, in ns: the sums for all its threads.

    While a thread waits for another one's lock, only the other counts as running or waiting.
    """

    ran_ns: int = 0
    waited_ns: int = 0
    """Time for which threads could run, but had to wait for a processor."""

    @classmethod
    def of(cls, pid: int) -> Self:
        """Return the times of a process; 0 if unknown."""
        ran = waited = 0
        with suppress(OSError):  # the process has ended
            for thread in Path(f"/proc/{pid}/task").iterdir():
                with suppress(OSError, IndexError, ValueError):  # it has ended; or proc(5): a kernel lacks the file
                    figures = (thread / "schedstat").read_text().split()
                    ran += int(figures[0])
                    waited += int(figures[1])
        return cls(ran, waited)

    def since(self, earlier: ProcessorTime) -> ProcessorTime:
        """Return the times since an earlier moment. The times of threads that have ended since then are missing."""
        return ProcessorTime(max(0, self.ran_ns - earlier.ran_ns), max(0, self.waited_ns - earlier.waited_ns))

    def __str__(self) -> str:
        return f"its threads ran for {self.ran_ns / 1e9:.1f} s and waited {self.waited_ns / 1e9:.1f} s for a processor"
