"""Shrinking: simpler values, fewer injections, a shorter run, and always the same failure."""

from __future__ import annotations

from typing import Any

from shmio.config.ranges import Space
from shmio.falsification.shrink import Case, Shrinker
from shmio.falsification.trial import Found, Result
from shmio.judging.verdict import Outcome

TABLES: dict[str, Any] = {
    "duration_s": 60.0,
    "injection": [
        {"name": "idle", "target": "c/a", "operation": "freeze", "start_s": {"from": 0, "to": 9}},
        {"name": "push", "target": "c/b", "operation": "offset", "value": {"from": -5, "to": 5},
         "start_s": {"from": 0, "to": 50}, "for_s": {"from": 0.1, "to": 20}},
        {"name": "other", "target": "c/d", "operation": "scale", "value": {"choice": [1, 2, 3]}},
    ],
    "expect": [{"name": "e", "always": "c/b < 5"}, {"name": "f", "always": "c/a < 5"}],
}  # fmt: skip
POINT = {
    "idle.start_s": 3.3333, "push.value": 4.123456, "push.start_s": 33.333333, "push.for_s": 7.77777, "other.value": 3,
}  # fmt: skip


def fails(tables: dict[str, Any]) -> Result:
    """Return a failure of ``e`` 1 s after a push of more than 3 which lasts 2 s; else a failure of ``f``."""
    push = next((one for one in tables["injection"] if one["name"] == "push"), None)
    moment_s = None if push is None else push["start_s"] + 1
    if push is not None and push["value"] > 3 and push["for_s"] >= 2 and tables["duration_s"] > push["start_s"] + 5:
        return Result(1, "failed", [Found("e", Outcome.FAILED, -1.0, moment_s=moment_s)])
    return Result(1, "failed", [Found("e", Outcome.PASSED, 1.0), Found("f", Outcome.FAILED, -0.1)])


def shrunk(runs: int) -> tuple[Case, Result, Shrinker, list[dict[str, Any]]]:
    tried: list[dict[str, Any]] = []

    def try_out(tables: dict[str, Any]) -> Result:
        tried.append(tables)
        return fails(tables)

    space = Space(TABLES)
    shrinker = Shrinker(space, 0.02, runs, try_out)
    case, result = shrinker.shrink(Case(dict(POINT), 60.0), fails(space.at(POINT)))
    return case, result, shrinker, tried


def test_a_case_becomes_simple() -> None:
    case, result, shrinker, tried = shrunk(200)
    assert [one["name"] for one in case.tables(Space(TABLES))["injection"]] == ["push"]
    assert 3 < case.point["push.value"] < 3.3
    assert case.point["push.start_s"] == 0
    assert 2 <= case.point["push.for_s"] < 3
    assert 5 < case.duration_s < 9
    assert len(str(case.point["push.for_s"])) <= 5, "it is rounded"
    assert result.failed == ["e"]
    assert fails(case.tables(Space(TABLES))).failed == ["e"]
    assert shrinker.runs == len(tried) < 80
    assert shrunk(200)[0] == case, "it repeats"


def test_the_number_of_runs_is_limited() -> None:
    for runs in (0, 5):
        case, result, shrinker, tried = shrunk(runs)
        assert shrinker.runs == len(tried) == runs
        assert result.failed == ["e"]
        assert fails(case.tables(Space(TABLES))).failed == ["e"]


def test_the_user_can_stop_it() -> None:
    shrinker = Shrinker(Space(TABLES), 0.02, 100, lambda _tables: None)
    shrinker.shrink(Case(dict(POINT), 60.0), fails(Space(TABLES).at(POINT)))
    assert shrinker.stopped
    assert shrinker.runs == 0
