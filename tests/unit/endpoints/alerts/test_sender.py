"""Notices are delivered in order, are repeated only where that is harmless, and never pile up."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from shmio.backoff import Backoff
from shmio.endpoints.alerts import sender
from shmio.endpoints.alerts.notice import Notice
from shmio.endpoints.alerts.sender import DeliveryError, Sender
from tests.unit.endpoints.alerts.harness import notice

TIMEOUT_S = 30
NO_WAIT = Backoff(0.0, 0.0)


class Scripted:
    """An action that does for each attempt what the test says."""

    text = "action"

    def __init__(self, *script: str, once: bool = False) -> None:
        self.once = once
        self._script = list(script)
        self.attempts: list[str] = []
        self.gate = threading.Event()
        self.arrived = threading.Event()

    def deliver(self, notice: Notice) -> None:
        self.attempts.append(notice.id)
        step = self._script.pop(0) if self._script else "works"
        if step == "hangs":
            self.arrived.set()
            assert self.gate.wait(TIMEOUT_S)
        elif step != "works":
            raise DeliveryError(step, again=step == "busy")

    def stop(self) -> None:
        self.gate.set()


class Changes:
    """Waits until a sender has changed to what the test expects."""

    def __init__(self) -> None:
        self._changed = threading.Condition()

    def __call__(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def until(self, condition: Any) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, TIMEOUT_S)


@contextmanager
def sending(action: Scripted, *waiting: Notice, **how: Any) -> Iterator[tuple[Sender, Changes]]:
    changes = Changes()
    made = Sender("hot", action, changes, waiting, retry=how.pop("retry", NO_WAIT), **how)
    try:
        yield made, changes
    finally:
        made.stop()
        made.join(TIMEOUT_S)


def test_a_notice_that_failed_comes_again_before_the_next() -> None:
    action, first, second = Scripted("busy", "busy"), notice(number=1), notice(number=2)
    with sending(action) as (one, changes):
        one.put(first)
        one.put(second)
        changes.until(lambda: not one.waiting_count)
        assert action.attempts == [first.id] * 3 + [second.id]
        assert (one.problem, one.failed) == ("", 0)


def test_what_can_never_arrive_is_dropped_and_remembered() -> None:
    action = Scripted("refused")
    with sending(action) as (one, changes):
        one.put(notice())
        changes.until(lambda: one.failed == 1)
        assert "refused" in one.problem
        assert "hot" in one.problem
        one.put(notice(number=2))
        changes.until(lambda: len(action.attempts) == 2 and not one.waiting_count)
        assert one.problem == "", "the next one arrived"


def test_attempts_end() -> None:
    with sending(Scripted("busy"), give_up_s=0.0) as (one, changes):
        one.put(notice())
        changes.until(lambda: one.failed == 1)
        assert one.waiting == []


def test_a_hanging_action_keeps_a_bounded_number() -> None:
    action = Scripted("hangs")
    with sending(action) as (one, changes):
        for number in range(sender.MAX_WAITING + 10):
            one.put(notice(number=number))
            if not number:
                assert action.arrived.wait(TIMEOUT_S)
        assert one.waiting_count == sender.MAX_WAITING
        assert one.failed == 10
        action.gate.set()
        changes.until(lambda: not one.waiting_count)
        assert len(action.attempts) == sender.MAX_WAITING + 1
        assert action.attempts[-1] == notice(number=sender.MAX_WAITING + 9).id


def test_what_is_not_delivered_stays_for_the_next_process() -> None:
    action = Scripted("busy")
    with sending(action, retry=Backoff(1e6, 1e6)) as (one, changes):
        one.put(notice())
        changes.until(lambda: bool(one.problem))
    left = one.waiting
    assert [kept.id for kept in left] == [notice().id]
    again = Scripted()
    with sending(again, *left) as (one, changes):
        changes.until(lambda: not one.waiting_count)
    assert again.attempts == [notice().id]


def test_what_has_begun_is_never_repeated_if_it_must_happen_once() -> None:
    action = Scripted("hangs", once=True)
    with sending(action) as (one, _):
        one.put(notice())
        assert action.arrived.wait(TIMEOUT_S)
        assert one.waiting == [], "a killed process leaves nothing to repeat"


def test_a_limit_of_attempts_at_the_same_time() -> None:
    turns = threading.BoundedSemaphore(1)
    slow, other = Scripted("hangs", once=True), Scripted(once=True)
    with sending(slow, turns=turns) as (first, changes), sending(other, turns=turns) as (second, others):
        first.put(notice())
        assert slow.arrived.wait(TIMEOUT_S)
        second.put(notice(number=2))
        assert second.waiting_count == 1
        slow.gate.set()
        others.until(lambda: not second.waiting_count)
        changes.until(lambda: not first.waiting_count)
