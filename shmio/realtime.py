"""How the kernel gives processors to threads: real-time priority (sched(7)), and how long a process has waited.

A thread with real-time priority runs before all threads without it.
"""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path

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


def waited_ns(pid: int) -> int:
    """Return how long the threads of a process have waited for a processor, in ns; 0 if unknown.

    This is the sum for all threads: while a thread waits for another one's lock, only the other
    counts as waiting.
    """
    waited = 0
    with suppress(OSError):  # the process has ended
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError, IndexError, ValueError):  # the thread has ended; or proc(5): a kernel lacks the file
                waited += int((thread / "schedstat").read_text().split()[1])
    return waited
