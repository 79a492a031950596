"""The checks of writes accept a correct history, and detect each kind of error."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.model.values import OutcomeKind
from tests.faults.checks import Source
from tests.faults.truth import Truth
from tests.faults.write_checks import LATE_NS, PublishCheck, WriteCheck


@pytest.fixture
def found() -> list[str]:
    return []


@pytest.fixture
def landed(tmp_path: Path) -> Iterator[Truth]:
    landed = Truth(tmp_path / "landed", create=True)
    yield landed
    landed.close()


@pytest.fixture
def source(landed: Truth) -> Source:
    return Source("cell", 32, 1, 1, 1, True, landed=landed)


def test_writes_are_held_to_what_the_plc_got(source: Source, landed: Truth, found: list[str]) -> None:
    check = WriteCheck(source, found.append)
    for value in (1, 2, 3, 9):
        landed.land(value, value)
    check.outcome(1, OutcomeKind.WRITTEN, "")
    check.outcome(2, OutcomeKind.UNKNOWN, "no answer")
    check.outcome(4, OutcomeKind.UNKNOWN, "no answer")
    check.outcome(5, OutcomeKind.EXPIRED, "too late")
    landed.land(4, 10)  # allowed, because its outcome is unknown
    for value in (1, 2, 4, 5):
        check.again(value)
    assert found == []
    assert (check.counts.values, check.counts.good, check.counts.since_ns) == (4, 1, 1)
    check.outcome(6, OutcomeKind.WRITTEN, "")
    check.outcome(3, OutcomeKind.REFUSED, "protected")
    check.outcome(7, OutcomeKind.ACCEPTED, "")
    check.outcome(8, OutcomeKind.REJECTED, "not now")
    check.outcome(9, OutcomeKind.WRITTEN, "")
    landed.land(8, 11)
    landed.land(9, 12)
    check.again(8)
    check.again(9)
    parts = ("6 was reported as written", "3 was reported as REFUSED", "7 ended as", "8 was REJECTED", "9 was WRITTEN")
    assert [part in line for part, line in zip(parts, found, strict=True)] == [True] * 5


def test_published_values_come_in_time_and_once(source: Source, landed: Truth, found: list[str]) -> None:
    check = PublishCheck(source, found.append)
    for value in (1, 3, 5, 7):
        check.sent(value, 1000)
    landed.land(1, 1001)
    landed.land(3, 1001 + LATE_NS)
    check.look([1, 3, 5], slack_ns=1)
    landed.land(5, 2000)
    check.look([1, 3, 5, 7], slack_ns=1)
    assert found == []
    assert (check.counts.values, check.counts.good, check.counts.since_ns) == (4, 3, 1001 + LATE_NS)
    landed.land(1, 3000)
    landed.land(7, 1001 + LATE_NS)
    check.look([1, 7])
    assert ["1 came to the PLC at 1001 and again" in found[0], "7 came to the PLC 6.5 s after" in found[1]] == [
        True
    ] * 2
    check.forget(7)
    assert len(found) == 2
