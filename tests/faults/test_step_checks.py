"""The checks of steps accept a correct history, and detect each kind of error."""

from __future__ import annotations

from typing import Any

import pytest

from shmio.model.clock import Clock, ClockMode
from shmio.segment import Quality
from tests.faults.step_checks import PARTICIPANTS, Answer, RecordedSteps, StepCheck

MS = 1_000_000
BEFORE = Clock(ClockMode.VIRTUAL, 7, 100 * MS, 20 * MS, 7)
AFTER = BEFORE._replace(step=8, time_ns=150 * MS, dt_ns=50 * MS, done=8)
VALUES: dict[str, dict[str, object]] = {
    "lead": {"count": 8, "at_s": 0.15}, "follow": {"seen": 7, "at_s": 0.15}, "panel": {},
}  # fmt: skip


@pytest.fixture
def found() -> list[str]:
    return []


def answers(**changed: dict[str, Any]) -> dict[str, Answer]:
    """Return the answers of a correct step, with these fields of these sources changed."""
    return {
        name: Answer(8, 150 * MS, Quality.GOOD, VALUES[name])._replace(**changed.get(name, {})) for name in PARTICIPANTS
    }


def test_steps_that_are_whole_or_fail_by_name_pass(found: list[str]) -> None:
    check = StepCheck(found.append)
    check.done(BEFORE, 8, 50 * MS, AFTER, answers())
    kept = {"quality": Quality.UNCERTAIN, "values": {"seen": 5, "at_s": 0.15}}
    check.done(BEFORE, 8, 50 * MS, AFTER, answers(follow=kept))
    failed = AFTER._replace(done=7)
    check.failed(BEFORE, "step 8: panel: no answer within 10 s from pid 5", 50 * MS, failed)
    check.failed(BEFORE, "step 8: recorder (pid 5) did not deliver the step within 10 s", 50 * MS, AFTER)
    check.failed(BEFORE, "the time of instance 'x' is moved by another program (pid 12)", 50 * MS, BEFORE)
    for after in (BEFORE, failed, AFTER):
        check.unclear(BEFORE, 50 * MS, after)
    assert found == []


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"lead": {"cycle": 7}}, "lead has no frame for it"),
        ({"panel": {"quality": Quality.BAD}}, "panel is bad in it"),
        ({"panel": {"clock_ns": 1}}, "panel has the time 1"),
        ({"lead": {"values": {"count": 8, "at_s": 0.1}}}, "lead has computed step 8 for 0.1 s"),
        ({"follow": {"values": {"seen": 8, "at_s": 0.15}}}, "follow has seen 8 in step 8, which made it 8"),
    ],
)
def test_a_step_that_is_not_whole_is_found(changed: dict[str, Any], problem: str, found: list[str]) -> None:
    StepCheck(found.append).done(BEFORE, 8, 50 * MS, AFTER, answers(**changed))
    assert len(found) == 1
    assert problem in found[0]


@pytest.mark.parametrize(
    ("after", "problem"),
    [
        (AFTER._replace(step=9, done=9), "step 8 is reported as done"),
        (AFTER._replace(done=7), "step 8 is reported as done"),
        (AFTER._replace(time_ns=160 * MS), "does not lead there"),
        (AFTER._replace(mode=ClockMode.WALL), "time is not virtual"),
    ],
)
def test_a_page_that_tells_something_else_is_found(after: Clock, problem: str, found: list[str]) -> None:
    StepCheck(found.append).done(BEFORE, 8, 50 * MS, after, answers())
    assert any(problem in line for line in found), found


@pytest.mark.parametrize(
    ("text", "after", "problem"),
    [
        ("step 8: it was cancelled", AFTER._replace(done=7), "names no cause"),
        ("step 8: lead: ?", AFTER._replace(step=9, done=7), "more than its number"),
        ("step 8: lead: ?", BEFORE._replace(done=6), "nobody requested is done"),
        ("step 8: lead: ?", AFTER._replace(done=7, time_ns=0), "does not lead there"),
    ],
)
def test_a_step_that_fails_otherwise_is_found(text: str, after: Clock, problem: str, found: list[str]) -> None:
    StepCheck(found.append).failed(BEFORE, text, 50 * MS, after)
    assert any(problem in line for line in found), found


def test_recordings_are_held_to_what_was_done(found: list[str]) -> None:
    check = RecordedSteps(found.append)
    done, cycles = {1, 2, 4}, {name: {1, 2, 3, 4, 5} for name in PARTICIPANTS}
    check.check(done, {3, 0}, {1, 2, 4, 5}, cycles, {})
    check.check(done, {3}, {1}, cycles | {"lead": {1}}, {"lead": 2})
    assert found == []
    check.check(done, {3}, {3}, cycles, {})
    check.check(done, {3}, {1}, cycles | {"panel": {1}}, {"panel": 1})
    assert ["failed steps [3] are recorded as done" in found[0], "2 frames of panel are not" in found[1]] == [True] * 2
