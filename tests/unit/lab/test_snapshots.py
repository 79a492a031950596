"""Snapshots in a laboratory: the remainder is the same bytes, in the same or another laboratory."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shmio.campaigns.live import Plan as RunPlan
from shmio.config import Expectation
from shmio.config.campaign import parse_campaign
from shmio.errors import SnapshotError
from shmio.lab import Laboratory, prepare_laboratory
from shmio.local.attach import Attachment
from shmio.plan.processes import Plan
from shmio.recording.dump import open_dump
from shmio.segment import EventKind, Quality

SECTIONS = """
[instance]
name = "snapshot-test"

[[source]]
name = "cell"
connector = "simulation"
model = "shmio.simulation.a50:A50Cell"
period_ms = 20

[[source]]
name = "walk"
connector = "simulation"
model = "snapshot_walk:Walk"
period_ms = 20
seed = 5
writable = ["up"]
connections = { up = "panel/Up" }

[[source]]
name = "panel"
connector = "memory"
layout = "panel.db"
writable = ["**"]
armed = true

[[injection]]
name = "configured"
target = "walk/at"
operation = "noise"
amplitude = 0.5
start_s = 0.3
end_s = 1.1
"""
PANEL = (
    'DATA_BLOCK "panel"\nSTRUCT\n  Up : LREAL := 1.0;\n  Go : BOOL;\n  N : DINT;\nEND_STRUCT;\nBEGIN\nEND_DATA_BLOCK\n'
)
MODEL = """
from collections import deque
from dataclasses import dataclass
from shmio.simulation import Input, Model, Output

@dataclass
class Part:
    age: float

class Walk(Model):
    up = Input("LREAL", 1.0)
    at = Output("LREAL")
    oldest = Output("LREAL")

    def start(self):
        self.parts = deque()

    def step(self, time_s, dt_s):
        if self.random.random() < 0.5:
            self.parts.append(Part(0.0))
        for part in self.parts:
            part.age += dt_s
        if len(self.parts) > 5:
            self.oldest = self.parts.popleft().age
        self.at += self.up * self.random.normal()
"""
CAMPAIGN: dict[str, Any] = {
    "injection": [
        {"name": "often", "target": "walk/at", "operation": "offset", "value": 5, "seed": 1,
         "when": "rising(walk/oldest > 0.2)", "for_s": 0.1},
        {"name": "frozen", "target": "cell/Robot_800/Axs1_Pos", "operation": "freeze", "when": "walk/at > 0",
         "seed": 2},
        {"name": "dropped", "target": "cell/Robot_825/Axs1_Pos", "operation": "drop", "probability": 0.4, "seed": 3},
        {"name": "late", "target": "cell/Robot_850/*", "operation": "delay", "delay_ms": 130, "seed": 4},
        {"name": "any", "target": "panel/Go", "operation": "flip", "probability": 0.3, "seed": 5},
        {"name": "held", "target": "panel/N/in", "operation": "delay", "delay_ms": 90, "seed": 6},
        {"name": "once", "target": "panel/Up", "operation": "random", "min": 0, "max": 1, "start_s": 0.8, "for_s": 0.4,
         "seed": 7},
    ]
}  # fmt: skip


@pytest.fixture
def plan(tmp_path: Path) -> Callable[..., Plan]:
    (tmp_path / "snapshot_walk.py").write_text(MODEL)
    (tmp_path / "panel.db").write_text(PANEL)

    def prepared(sections: str = SECTIONS) -> Plan:
        (tmp_path / "supervisor.toml").write_text(sections)
        return prepare_laboratory(tmp_path / "supervisor.toml")

    return prepared


class Tap:
    """Everything that is published from now on, without numbers that count on."""

    def __init__(self, cell: Attachment) -> None:
        self._blocks = [cell.block(source) for source in cell.sources]
        self._cursors = [(block, block.cursor(), block.events.cursor()) for block in self._blocks]

    def take(self) -> list[tuple[Any, ...]]:
        found: list[tuple[Any, ...]] = []
        for block, frames, events in self._cursors:
            while (frame := frames.poll()) is not None:
                found.append((block.source, *frame[1:2], frame.clock_ns, *frame[4:5], *frame[6:8], *frame[9:]))
            while (event := events.poll()) is not None:
                if event.writer == 0xFFFFFFFF:
                    found.append((block.source, event.kind, event.cycle, event.clock_ns, event.utc_ns, *event[11:]))
            assert not frames.missed
        return found


def go_on(cell: Attachment, steps: int, writes: random.Random) -> None:
    for _ in range(steps):
        if writes.random() < 0.2:
            cell.write({"panel/N": writes.randrange(1000)})
        cell.step(0.02)


def test_the_remainder_is_the_same_from_any_moment(plan: Callable[..., Plan]) -> None:
    moments = random.Random(7)
    with Laboratory(plan()) as lab, lab.attach() as cell:
        campaign = cell.declare(parse_campaign(CAMPAIGN), keep=True)
        with campaign, cell.inject("cell/Robot_800/Axs2_Pos", keep=True, name="by hand") as shadow:
            shadow.set({"cell/Robot_800/Axs2_Pos": 12.5})
            for number in range(4):
                go_on(cell, moments.randrange(1, 15), moments)
                cell.save_snapshot("here")
                tap, writes = Tap(cell), moments.getstate()
                go_on(cell, 25, moments)
                expected = tap.take()
                for _ in range(2):
                    shadow.set({"cell/Robot_800/Axs2_Pos": float(number)})
                    cell.restore_snapshot("here")
                    tap = Tap(cell)
                    moments.setstate(writes)
                    go_on(cell, 25, moments)
                    assert tap.take() == expected
                kinds = {one[1] for one in expected if isinstance(one[1], int)}
                assert len(expected) >= 75
                assert number or EventKind.ACTIVATED in kinds


def test_another_laboratory_continues_with_the_same_bytes(plan: Callable[..., Plan]) -> None:
    prepared = plan()
    with Laboratory(prepared) as lab, lab.attach() as cell:
        cell.declare(parse_campaign(CAMPAIGN))
        go_on(cell, 30, random.Random(1))
        saved = cell.save_snapshot("warm")
        tap = Tap(cell)
        go_on(cell, 40, random.Random(2))
        expected = tap.take()
    assert (saved.step, saved.time_ns, dict(saved.left_out)) == (30, 600_000_000, {})
    with Laboratory(prepared) as lab, lab.attach() as cell:
        [found] = cell.snapshots()
        assert found == saved
        events = cell.block("walk").events.cursor(after=0)
        assert cell.restore_snapshot("warm") == saved
        assert cell.clock.time_ns == 600_000_000
        kinds = [event.kind for event in iter(events.poll, None)]
        assert EventKind.RESTORED in kinds
        assert EventKind.INJECTED in kinds, "a recording that begins here names the injections"
        tap = Tap(cell)
        go_on(cell, 40, random.Random(2))
        assert tap.take() == expected
        names = {one.name for one in cell.injections()}
        assert {"often", "late", "configured"} <= names, "they stay, although their client has ended"
        cell.delete_snapshot("warm")
        assert cell.snapshots() == []
        with pytest.raises(SnapshotError, match=r"unknown snapshot 'warm'.*none"):
            cell.restore_snapshot("warm")


MORE = '[[source]]\nname = "more"\nconnector = "memory"\nlayout = "panel.db"\n[[injection]]'


def test_a_snapshot_of_another_configuration_is_refused(plan: Callable[..., Plan]) -> None:
    with Laboratory(plan()) as lab, lab.attach() as cell:
        cell.step(0.02, 3)
        cell.save_snapshot("old")
    for old, new, names in (
        ("[[injection]]", MORE, "no source more"),
        ("amplitude = 0.5", "amplitude = 0.25", "different injections: configured"),
        ("shmio.simulation.a50:A50Cell", "shmio.simulation.loopback:Loopback", "source cell.*layout"),
    ):
        assert old in SECTIONS
        with Laboratory(plan(SECTIONS.replace(old, new))) as lab, lab.attach() as cell:
            cell.step(0.02, 5)
            before = Tap(cell)
            with pytest.raises(SnapshotError, match=f"{names}.*nothing was changed"):
                cell.restore_snapshot("old")
            assert cell.clock.step == 5
            assert before.take() == []


def test_a_model_whose_code_has_changed_is_refused(
    plan: Callable[..., Plan], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Laboratory(plan()) as lab, lab.attach() as cell:
        cell.save_snapshot("old")
    (tmp_path / "snapshot_walk.py").write_text(MODEL + "\n# changed\n")
    monkeypatch.delitem(sys.modules, "snapshot_walk")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    with (
        Laboratory(plan()) as lab,
        lab.attach() as cell,
        pytest.raises(SnapshotError, match=r"snapshot_walk:Walk.*code has changed"),
    ):
        cell.restore_snapshot("old")


def test_what_cannot_be_saved_is_named_and_can_be_left_out(plan: Callable[..., Plan]) -> None:
    prepared = plan()
    with Laboratory(prepared) as lab, lab.attach() as cell:
        lab.loops["walk"]._source._runner._model.handle = object()  # type: ignore[attr-defined]
        with pytest.raises(SnapshotError, match=r"walk: .*handle.*save_state.*--partial"):
            cell.save_snapshot("all")
        assert cell.snapshots() == []
        saved = cell.save_snapshot("rest", partial=True)
        assert list(saved.left_out) == ["walk"]
        cell.step(0.02, 5)
        walked = cell["walk/at"]
        assert cell.restore_snapshot("rest") == saved
        assert cell["walk/at"] == walked, "it stays as it is"
        assert cell.clock.step == 0
        cell.step(0.02)


def test_names_that_are_no_file_names_are_refused(plan: Callable[..., Plan]) -> None:
    with Laboratory(plan()) as lab, lab.attach() as cell:
        for name in ("", "a/b", "../up", ".hidden", "x" * 64, "ä", "a\0"):
            for call in (cell.save_snapshot, cell.restore_snapshot, cell.delete_snapshot):
                with pytest.raises(SnapshotError, match="name"):
                    call(name)


def test_a_campaign_starts_from_a_snapshot(plan: Callable[..., Plan], tmp_path: Path) -> None:
    prepared = plan()
    limit = Expectation(name="low", always="walk/at < 1e6")
    with Laboratory(prepared) as lab, lab.attach() as cell:
        go_on(cell, 30, random.Random(1))
        cell.save_snapshot("warm")
    recordings = []
    for number in range(2):
        recordings.append(tmp_path / f"{number}.mem")
        with Laboratory(prepared) as lab:
            run = lab.run(RunPlan(parse_campaign(CAMPAIGN), [limit], 0.5, record=recordings[-1], start="warm"))
        assert run.problem is None
        assert run.start is not None
        assert [one.outcome for one in run.judge.verdicts] == ["passed"]
    first, second = (list(open_dump(file).frames("walk")) for file in recordings)
    assert [(one.item.clock_ns, one.item.raw, one.item.effective) for one in first] == [
        (one.item.clock_ns, one.item.raw, one.item.effective) for one in second
    ]
    assert first[-1].item.clock_ns == 1_100_000_000
    with Laboratory(prepared) as lab, pytest.raises(SnapshotError, match="unknown snapshot 'none'"):
        lab.run(RunPlan([], [limit], 0.5, start="none"))


def test_edges_across_a_snapshot_are_noticed(plan: Callable[..., Plan]) -> None:
    prepared = plan()
    edges = {
        "injection": [
            {"name": "edge", "target": "cell/NCAchse1_Pos", "operation": "offset", "value": 5,
             "when": "rising(panel/Go)"},
            {"name": "again", "target": "cell/NCAchse2_Pos", "operation": "offset", "value": 5, "when": "panel/N > 0",
             "for_s": 0.04},
        ]
    }  # fmt: skip

    def runs(cell: Attachment) -> dict[str, int]:
        return {one.name: one.running.runs for one in cell.injections("cell") if one.running is not None}

    with Laboratory(prepared) as lab, lab.attach() as cell:
        cell.declare(parse_campaign(edges))
        cell.write({"panel/N": 1})
        cell.step(0.02, 5)
        cell.write({"panel/N": 0})
        cell.step(0.02, 2)
        assert runs(cell) == {"edge": 0, "again": 1}
        cell.save_snapshot("before")
    with Laboratory(prepared) as lab, lab.attach() as cell:
        cell.restore_snapshot("before")
        cell.write({"panel/N": 1, "panel/Go": True})
        cell.step(0.02, 2)
        assert runs(cell) == {"edge": 1, "again": 2}


def test_a_state_that_cannot_be_restored_makes_the_source_bad(plan: Callable[..., Plan]) -> None:
    with Laboratory(plan()) as lab, lab.attach() as cell:
        cell.step(0.02, 3)
        with pytest.raises(SnapshotError):
            lab.loops["walk"].restore(b"damaged", "old")
        frame = cell.frame("walk")
        assert (frame.quality, frame.cycle) == (Quality.BAD, 3)
        assert "the snapshot old was not restored" in frame.reason
