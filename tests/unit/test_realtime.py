"""Real-time priority: set where the host allows it, and refused with the remedy elsewhere."""

from __future__ import annotations

import errno
import os
import threading

import pytest

from shmio import realtime
from shmio.errors import ConfigError
from shmio.testing.cell import may_be_realtime


def refuse(*_: object) -> None:
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))


@pytest.mark.skipif(not may_be_realtime(), reason="this user may have no real-time priority")
def test_the_priority_is_of_the_calling_thread_and_its_new_threads() -> None:
    policies: list[int] = []

    def work() -> None:
        realtime.prioritise(3)
        policies.append(os.sched_getscheduler(0))
        inner = threading.Thread(target=lambda: policies.append(os.sched_getscheduler(0)))
        inner.start()
        inner.join()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert policies == [os.SCHED_FIFO, os.SCHED_FIFO]
    realtime.check(3)
    assert os.sched_getscheduler(0) != os.SCHED_FIFO, "a check changes nothing"


def test_without_permission_the_error_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    for ask in (realtime.prioritise, realtime.check):
        with pytest.raises(
            ConfigError, match=r"realtime_priority: this user may not have 7 \(.*\); allow it \(LimitRT"
        ):
            ask(7)
