"""A real-time priority: taken where it is allowed, refused with the remedy where it is not."""

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
def test_it_is_the_calling_threads_and_of_those_it_starts() -> None:
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
    assert os.sched_getscheduler(0) != os.SCHED_FIFO, "who only asks goes on as before"


def test_where_it_is_not_allowed_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    for ask in (realtime.prioritise, realtime.check):
        with pytest.raises(
            ConfigError, match=r"realtime_priority: this user may not have 7 \(.*\); allow it \(LimitRT"
        ):
            ask(7)
