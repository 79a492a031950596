"""The check of retained messages accepts the present state, and detects each kind of error."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.faults.checks import Source
from tests.faults.configuration import DECLARED
from tests.faults.retained import WORDS, wrong
from tests.faults.truth import Truth

OLD, NEW = 6, 7


@pytest.fixture
def source(tmp_path: Path) -> Iterator[Source]:
    truth = Truth(tmp_path / "truth", create=True)
    for generation in range(1, NEW + 1):
        truth.record(generation, generation)  # long ago: just after the host has started
    yield Source("cell", 72, 1, 10**9, 10**9, True, truth)
    truth.close()


def found(**changes: bytes | None) -> dict[str, bytes]:
    words = {f"cell/{word}/out": b"0" for word in (*WORDS, "rest")}
    good = {"status": b"online", "cell/status": json.dumps({"quality": "good"}).encode(), "other/stamp/out": b"1"}
    good |= words | {"cell/stamp/out": str(NEW).encode(), "cell/declared/out": str(DECLARED).encode()}
    given = {name.replace("_", "/"): value for name, value in changes.items()}
    return {name: value for name, value in (good | given).items() if value is not None}


def test_what_is_so_now_passes(source: Source) -> None:
    assert wrong(found(), [source], {"cell": "rest"}, 1.0) == []


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"status": b"offline"}, "status is b'offline'"),
        ({"status": None}, "status is None"),
        ({"cell_shown_out": None}, "missing topics of cell: ['cell/shown/out'], unexpected: []"),
        ({"cell_other_out": b"1"}, "missing topics of cell: [], unexpected: ['cell/other/out']"),
        ({"cell_status": b'{"quality": "bad"}'}, "cell is bad"),
        ({"cell_stamp_out": str(OLD).encode()}, "value 6 is good, but"),
        ({"cell_declared_out": b"0"}, "cell/declared is b'0'"),
    ],
)  # fmt: skip
def test_what_is_not_is_found(source: Source, changes: dict[str, bytes | None], problem: str) -> None:
    problems = wrong(found(**changes), [source], {"cell": "rest"}, 1.0)
    assert len(problems) == 1
    assert problem in problems[0]
