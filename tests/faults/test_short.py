"""The fault suite itself, for a short time: each kind of fault, a piece of a seed's schedule, a broken promise."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults import report, suite
from tests.faults.schedule import DEVICE_FAULTS, SOURCES, SUPERVISOR, WEIGHTS, Fault, Round
from tests.faults.suite import Record, Suite

pytestmark = pytest.mark.timeout(400)

SHORT_S = 0.3
NUMBER = 0x1234_5678
TARGETS = {"kill": "fast", "hang": "grpc", "pause": "block", "restart": "plc", "torn": "fast", "relayout": "block"}


def one(*targets: tuple[str, str]) -> Round:
    return Round(tuple(Fault(kind, target, 0.0, SHORT_S, NUMBER) for kind, target in targets), 0.0)


def run(folder: Path, instance: str, faults: list[Round] | None = None, for_s: float = 0.0) -> Record:
    record = Suite(folder, instance, seed=11, say=print).run(for_s, faults)
    print(report.write(record))
    return record


def test_each_kind_of_fault(tmp_path: Path, instance: str) -> None:
    devices = [one(*((kind, f"device of {source}") for source in SOURCES)) for kind in DEVICE_FAULTS]
    others = [kind for kind in WEIGHTS if kind not in DEVICE_FAULTS]
    places = {kind: SUPERVISOR if kind.startswith(SUPERVISOR) else TARGETS.get(kind, kind) for kind in others}
    record = run(tmp_path, instance, devices + [one(place) for place in places.items()])
    assert record.violations == []
    assert set(record.faults) == set(WEIGHTS)
    assert all(counts.values > 0 for counts in record.counts.values()), record.counts
    assert record.counts["slow fast"].missed > 0
    assert record.adopted + record.replaced == record.mid_kills == 1


def test_a_piece_of_a_schedule(tmp_path: Path, instance: str) -> None:
    record = run(tmp_path, instance, for_s=5.0)
    assert record.violations == []
    assert record.rounds > 0


def test_a_broken_promise_is_told(tmp_path: Path, instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that restarts although nothing was to restart it."""
    monkeypatch.setattr(suite, "RESTARTING", set())
    record = run(tmp_path, instance, [one(("kill", "grpc")), one(("pause", "grpc"))])
    assert "grpc was not hit, but went from" in record.violations[0]
    assert "seed 11" in record.violations[0]
    assert "kill grpc" in record.violations[0]
    assert record.rounds == 1, "it went on"
