"""Short runs of the fault suite: each kind of fault, part of a schedule, and a violation."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from itertools import cycle
from pathlib import Path

import pytest

from tests.faults import report, suite
from tests.faults.checks import Counts
from tests.faults.schedule import BROKER, DEVICE_FAULTS, SOURCES, SUPERVISOR, WEIGHTS, Fault, Round, rounds
from tests.faults.stepping import STEPPER, WORKERS, Stepping
from tests.faults.suite import Record, Suite

pytestmark = pytest.mark.timeout(900)

SEED = 11
SHORT_S = 0.3
PIECE_S = 5.0
NUMBER = 0x1234_5678
TARGETS = {
    "kill": "fast", "hang": "grpc", "pause": "block", "restart": "plc", "torn": "fast", "relayout": "block",
    "broker_kill": BROKER, "broker_pause": BROKER,
}  # fmt: skip


def one(*targets: tuple[str, str]) -> Round:
    return Round(tuple(Fault(kind, target, 0.0, SHORT_S, NUMBER) for kind, target in targets), 0.0)


def seen(counts: Mapping[str, Counts]) -> bool:
    """Return whether each reader has seen values, and the slow reader has missed frames.

    Recordings are checked only after they have ended.
    """
    readers = [each for name, each in counts.items() if not name.startswith("recorded")]
    return all(each.values > 0 for each in readers) and counts["slow fast"].missed > 0


def run(folder: Path, instance: str, faults: Iterable[Round]) -> Record:
    record = Suite(folder, instance, Record(SEED), say=print).run(0.0, faults, seen)
    print(report.write(record))
    return record


def test_each_kind_of_fault(tmp_path: Path, instance: str) -> None:
    """Up to three faults at a time; those of the supervisor come alone."""
    alone = [one((kind, SUPERVISOR)) for kind in WEIGHTS if kind.startswith(SUPERVISOR)]
    others = [kind for kind in WEIGHTS if not (kind in DEVICE_FAULTS or kind.startswith(SUPERVISOR))]
    together = []
    devices = [(kind, f"device of {source}") for kind, source in zip(DEVICE_FAULTS, cycle(SOURCES), strict=False)]
    for at, beside in enumerate(others):
        together.append(one(*devices[2 * at : 2 * at + 2], (beside, TARGETS.get(beside, beside))))
    assert 2 * len(others) >= len(devices)
    record = run(tmp_path, instance, together + alone)
    assert record.violations == []
    assert set(record.faults) == set(WEIGHTS)
    assert seen(record.counts), record.counts
    assert all(counts.values > 0 for counts in record.counts.values()), record.counts
    assert record.adopted + record.replaced == record.mid_kills == 1


def test_steps_are_whole_or_fail_by_name(tmp_path: Path, instance: str) -> None:
    record = Record(SEED)
    kinds = [("kill", worker) for worker in WORKERS] + [("pause", "lead"), ("pause", "recorder"), ("restart", "panel")]
    kinds += [("stepper_kill", STEPPER), ("stepper_kill", STEPPER), ("supervisor_kill", SUPERVISOR)]
    faults = [Fault(kind, target, 0.0, SHORT_S, NUMBER) for kind, target in kinds]
    Stepping(tmp_path / "stepped", instance, record, print).run(0.0, faults)
    print(report.write(record))
    assert record.violations == []
    assert record.rounds == len(faults)
    assert record.steps["done"] > 0
    assert record.steps["recorded marks"] > 0


def test_a_piece_of_a_schedule_and_then_a_broken_promise(
    tmp_path: Path, instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A restart that no fault explains is a violation. The rounds before have none."""
    piece: list[Round] = []

    def turns() -> Iterator[Round]:
        begun_s = time.monotonic()
        for turn in rounds(SEED):
            if time.monotonic() - begun_s > PIECE_S:
                break
            piece.append(turn)
            yield turn
        monkeypatch.setattr(suite, "RESTARTING", set())
        yield one(("kill", "grpc"))
        yield one(("pause", "grpc"))

    record = run(tmp_path, instance, turns())
    assert piece
    assert "grpc was not hit, but went from" in record.violations[0]
    assert f"seed {SEED}" in record.violations[0]
    assert "kill grpc" in record.violations[0]
    assert "grpc crashed: killed by SIGKILL" in record.violations[0]
    assert record.rounds == len(piece) + 1, "it went on"
