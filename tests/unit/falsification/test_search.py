"""Strategies of searches: they repeat, stay in the space, and optimisers beat chance."""

from __future__ import annotations

import statistics
import sys
from typing import Any

import pytest

from shmio.config.ranges import Choice, Point, Space
from shmio.errors import ConfigError, MissingLibraryError
from shmio.falsification.search import SEARCHES, GridSearch, SearchName, begin_search

SPACE = Space(
    {
        "injection": [
            {
                "name": "a",
                "value": {"from": -1, "to": 3},
                "times": {"from": 1, "to": 4},
                "delay_ms": {"from": 1, "to": 1000, "log": True},
                "start_s": {"from": 0.1, "to": 1, "step": 0.2},
                "when": {"choice": ["x", "y", "z"]},
            }
        ]
    }
)


def robustness(point: Point) -> float:
    """Return the distance from a point in the middle of nowhere."""
    return float(abs(point["a.value"] - 1.7) + abs(point["a.times"] - 2) + (point["a.when"] != "y"))


def searched(name: SearchName, seed: int, trials: int, jobs: int = 1) -> list[Point]:
    search = begin_search(name, SPACE, seed, trials, jobs)
    found: list[Point] = []
    for number in range(trials):
        point = search.ask(number)
        if point is None:
            break
        found.append(point)
        if number >= jobs - 1:
            told = number - jobs + 1
            search.tell(told, None if told % 7 == 3 else robustness(found[told]))
    return found


@pytest.mark.parametrize("name", SEARCHES)
def test_points_repeat_and_are_in_the_space(name: SearchName) -> None:
    found = searched(name, 5, 30, jobs=2)
    assert found == searched(name, 5, 30, jobs=2)
    assert found != searched(name, 6, 30, jobs=2)
    for point in found:
        assert list(point) == [one.name for one in SPACE.dimensions]
        for one in SPACE.dimensions:
            value = point[one.name]
            if isinstance(one, Choice):
                assert value in one.options
            else:
                assert one.low <= value <= one.high
                assert one.nearest(value) == value
                assert isinstance(value, int if one.whole else float)


@pytest.mark.parametrize("name", ["tpe", "cmaes"])
def test_an_optimiser_gets_closer_than_chance(name: SearchName) -> None:
    def best(name: SearchName) -> float:
        return statistics.median(min(map(robustness, searched(name, seed, 60))) for seed in range(3))

    assert best(name) < best("random") / 2


def test_a_grid_covers_the_space_once() -> None:
    search = GridSearch(SPACE, 1, 200)
    assert search.counts == [3, 3, 3, 3, 2]
    table = {"name": "a", "value": {"choice": [1, 2, 3]}, "start_s": {"from": 0, "to": 1, "step": 0.25}}
    small = GridSearch(Space({"injection": [table]}), 1, 1000)
    points = [point for number in range(20) if (point := small.ask(number)) is not None]
    assert len(points) == 15
    assert {(one["a.value"], one["a.start_s"]) for one in points} == {
        (value, start) for value in (1, 2, 3) for start in (0, 0.25, 0.5, 0.75, 1)
    }


def test_optimisers_take_fewer_trials() -> None:
    with pytest.raises(ConfigError, match=r"--trials 10001.*--search random"):
        begin_search("tpe", SPACE, 1, 10_001, 1)
    assert len({str(begin_search("random", SPACE, 1, 10**6, 1).ask(number)) for number in (0, 10**6 - 1)}) == 2


@pytest.mark.parametrize(("name", "module"), [("tpe", "optuna"), ("cmaes", "cmaes")])
def test_a_missing_library_is_named_with_the_remedy(name: Any, module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingLibraryError, match=rf"{module} is not installed.*shmio\[falsify\].*--search random"):
        begin_search(name, SPACE, 1, 10, 1)
