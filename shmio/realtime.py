"""Real-time priority of a process: it runs before all others of the host that have none or less, sched(7)."""

from __future__ import annotations

import os
import threading

from shmio.errors import ConfigError


def prioritise(priority: int) -> None:
    """Give the calling thread, and those that it starts from now on, a priority of SCHED_FIFO.

    ConfigError: this user may not have it, with the remedy.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:  # EPERM, too, where the process's control group has no real-time budget
        raise ConfigError(
            f"realtime_priority: this user may not have {priority} ({error.strerror}); allow it (LimitRTPRIO= in the "
            "service's unit, rtprio in limits.conf, --ulimit rtprio of a container), or leave the key out"
        ) from None


def check(priority: int) -> None:
    """Whether a process of this user may have it; ConfigError."""
    refused: list[ConfigError] = []

    def attempt() -> None:
        try:
            prioritise(priority)
        except ConfigError as error:
            refused.append(error)

    thread = threading.Thread(target=attempt, name="priority")  # which keeps it: the caller goes on as it is
    thread.start()
    thread.join()
    if refused:
        raise refused[0]
