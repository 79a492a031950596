"""The gate of examples/falsify: its interlock fails within 40 ms only, and not if it is repaired."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from shmio.campaigns.live import Plan
from shmio.cli.campaign import main
from shmio.config.campaign import CampaignFile
from shmio.lab import Laboratory, prepare_laboratory

EXAMPLE = Path(__file__).parents[2] / "examples/falsify"


def test_the_fault_is_in_the_window_alone(tmp_path: Path) -> None:
    for file in EXAMPLE.iterdir():
        if file.is_file():
            shutil.copy(file, tmp_path)
    read, instance = CampaignFile(tmp_path / "campaign.toml"), prepare_laboratory(tmp_path / "supervisor.toml")
    found = {}
    for late_ms, scans in ((4920, 2), (4960, 2), (4980, 2), (5020, 2), (4960, 0), (4980, 0)):
        campaign = read.at({"late-valve.delay_ms": 20 + late_ms, "late-task.delay_ms": 20, "noise.value": 0})
        with Laboratory(instance, {"gate": {"scans_late": scans}}) as lab:
            run = lab.run(Plan([campaign.injection[0], campaign.injection[1]], campaign.expect, 11.0))
        (verdict,) = run.judge.verdicts
        found[late_ms, scans] = str(verdict.outcome), verdict.robustness
    failed = [key for key, (outcome, _) in found.items() if outcome == "failed"]
    assert failed == [(4960, 2), (4980, 2)], found
    assert found[4920, 2][1] == pytest.approx(50), "the closer, the less clearance"


def test_falsify_finds_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(EXAMPLE)
    words = ["falsify", "campaign.toml", "--seed", "37", "--trials", "40", "--shrink", "0", "--for", "14"]
    words += ["--set", "late-task.delay_ms=2500", "--set", "noise.value=0", "-o", str(tmp_path / "out")]
    assert main(words) == 1
    assert "failed: interlock" in capsys.readouterr().out
    assert (tmp_path / "out/case-001/run.mem").exists()
