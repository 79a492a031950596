"""``shmio-campaign run`` in a laboratory: recordings that fail, and the exit status."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from shmio.cli.campaign import main

CONFIG = """
[instance]
name = "run-test"

[[source]]
name = "lift"
connector = "simulation"
model = "run_lift:Lift"
period_ms = 20
"""
MODEL = """
from shmio.simulation import Model, Output

class Lift(Model):
    height = Output("LREAL")

    def step(self, time_s, dt_s):
        self.height += dt_s
"""
CAMPAIGN = 'duration_s = {duration_s}\n[[expect]]\nname = "low"\nalways = "lift/height < {limit}"\n'

RANGE = """
[[injection]]
name = "late"
target = "lift/height"
operation = "set"
value = { from = 0.0, to = 1.0 }
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with a configuration and two campaigns, of which it meets one."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run_lift.py").write_text(MODEL)
    (tmp_path / "supervisor.toml").write_text(CONFIG)
    (tmp_path / "good.toml").write_text(CAMPAIGN.format(limit=1e6, duration_s=1))
    (tmp_path / "bad.toml").write_text(CAMPAIGN.format(limit=0.5, duration_s=1))
    return tmp_path


def lab(campaign: str, *options: str) -> int:
    return main(["run", campaign, "-c", "supervisor.toml", "--lab", *options])


def test_the_head_line_counts_in_singular_and_plural(capsys: pytest.CaptureFixture[str]) -> None:
    assert lab("good.toml") == 0
    assert "laboratory: 0 injections, 1 expectation, virtual time" in capsys.readouterr().err


def test_without_an_instance_the_option_that_starts_one_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "good.toml"]) != 0
    told = capsys.readouterr().err
    assert "no instance 'run-test' is running" in told
    assert told.endswith("; or add -c supervisor.toml, with which the run starts and stops it\n")


def test_the_folder_of_a_recording_is_created(folder: Path) -> None:
    assert lab("good.toml", "--record", "new/folder/a.mem") == 0
    assert (folder / "new/folder/a.mem").exists()


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_new_files_have_the_permissions_that_the_umask_allows(folder: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        assert lab("good.toml", "--record", "a.mem", "--report", "r.html", "--junit", "r.xml") == 0
    finally:
        os.umask(before)
    assert {(folder / name).stat().st_mode & 0o777 for name in ("a.mem", "r.html", "r.xml")} == {0o666 & ~umask}


@pytest.fixture
def full(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every disk be full for recordings."""

    def refuse(*_: Any) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", refuse)


@pytest.mark.usefixtures("full")
@pytest.mark.parametrize(("campaign", "status"), [("good.toml", 3), ("bad.toml", 1)])
def test_a_full_disk_costs_the_recording_only(
    folder: Path, campaign: str, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert lab(campaign, "--record", "a.mem", "--report", "r.html", "--junit", "r.xml", "--json") == status
    told = capsys.readouterr()
    found = json.loads(told.out)
    assert [one["name"] for one in found["verdicts"]] == ["low"]
    assert "contents_sha256" not in found
    assert told.err.endswith("--record a.mem: No space left on device\n")
    assert told.err.count("No space") == 1
    assert (folder / "r.html").exists()
    assert (folder / "r.xml").exists()


@pytest.mark.usefixtures("full")
def test_a_long_run_ends_early_when_the_disk_is_full(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "long.toml").write_text(CAMPAIGN.format(limit=0.5, duration_s=80_000))
    assert lab("long.toml", "--record", "a.mem") == 1
    told = capsys.readouterr()
    assert "was false at 0.5" in told.out
    assert told.err.endswith("the run ended early: --record a.mem: No space left on device\n")


def test_a_removed_recording_ends_the_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def remove(_fd: int, data: memoryview, _at: int) -> int:
        (folder / "a.mem").unlink(missing_ok=True)
        return len(data)

    monkeypatch.setattr("shmio.recorder.recorder.CHECK_S", 0.0)
    monkeypatch.setattr(os, "pwrite", remove)
    (folder / "long.toml").write_text(CAMPAIGN.format(limit=0.5, duration_s=80_000))
    assert lab("long.toml", "--record", "a.mem") == 1
    told = capsys.readouterr()
    assert "was false at 0.5" in told.out
    assert told.err.endswith("the run ended early: --record a.mem was removed while it was being written\n")


@pytest.mark.parametrize("where", [["--lab"], []])
@pytest.mark.parametrize(
    ("config", "error"),
    [
        (None, "wrong.toml: No such file or directory"),
        (CONFIG + "rate = 1\n", "unknown key"),
        (CONFIG.replace("run_lift:Lift", "run_lift:Left"), "Left"),
    ],
)
def test_a_fault_in_the_configuration_has_status_2_and_not_the_campaigns_name(
    folder: Path, where: list[str], config: str | None, error: str, capfd: pytest.CaptureFixture[str]
) -> None:
    if config is not None:
        (folder / "wrong.toml").write_text(config)
    assert main(["run", "good.toml", "-c", "wrong.toml", *where]) == 2
    told = capfd.readouterr().err
    assert error in told
    assert told.startswith("wrong.toml") or str(folder / "wrong.toml") in told
    assert "good.toml" not in told


def test_a_log_folder_that_cannot_be_used_has_status_2(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (folder / "wrong.toml").write_text(CONFIG.replace("[instance]", '[instance]\nlog_dir = "run_lift.py"'))
    assert main(["run", "good.toml", "-c", "wrong.toml"]) == 2
    assert "log_dir" in capfd.readouterr().err


def test_a_fault_in_the_campaign_has_its_name(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "wrong.toml").write_text(CAMPAIGN.format(limit=1, duration_s=1).replace("height", "weight"))
    assert lab("wrong.toml") == 2
    assert capsys.readouterr().err.startswith("wrong.toml:4: expect[0].always: ")


def test_an_unknown_snapshot_has_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert lab("good.toml", "--start", "wram") == 2
    assert "unknown snapshot 'wram'" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["0", "0.0001", "3600001", "nan", "x"])
@pytest.mark.parametrize("verb", ["run", "falsify"])
def test_a_step_has_limits(verb: str, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([verb, "good.toml", "-c", "supervisor.toml", "--step-ms", text])
    assert stop.value.code == 2
    assert f"argument --step-ms: '{text}' is not a number of ms from 0.001 to 3600000\n" in capsys.readouterr().err


@pytest.mark.parametrize("step_ms", ["0.0001", "3600001.0"])
def test_the_key_of_a_step_has_the_same_limits(folder: Path, step_ms: str, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "steps.toml").write_text(f"step_ms = {step_ms}\n{(folder / 'good.toml').read_text()}")
    assert lab("steps.toml") == 2
    assert "step_ms: expected a number" in capsys.readouterr().err


def test_falsify_refuses_a_file_as_its_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = CAMPAIGN.format(limit=1, duration_s=1)
    (folder / "ranges.toml").write_text(text + RANGE)
    words = ["falsify", "ranges.toml", "-c", "supervisor.toml", "--search", "random", "-o", "good.toml"]
    assert main(words) == 2
    assert capsys.readouterr().err == "-o good.toml: this is a file; name a new or an empty folder\n"


def test_a_missing_library_has_status_2(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    text = CAMPAIGN.format(limit=1, duration_s=1)
    (folder / "ranges.toml").write_text(text + RANGE)
    assert main(["falsify", "ranges.toml", "-c", "supervisor.toml"]) == 2
    assert "shmio[falsify]" in capsys.readouterr().err


def test_a_large_constant_costs_no_verdict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    field = Path(__file__).parents[2] / "field/campaigns"
    for name, other in (("supervisor.toml", "big_constant_supervisor.toml"), ("cm.py", "big_constant_model.py.txt")):
        shutil.copy(field / other, tmp_path / name)
    shutil.copy(field / "big_constant.toml", tmp_path)
    monkeypatch.chdir(tmp_path)
    words = ["run", "big_constant.toml", "--lab", "--report", "o.html", "--junit", "o.xml"]
    assert main(words) == 0
    assert "1 passed" in Path("o.html").read_text()
    assert b'failures="0" errors="0"' in Path("o.xml").read_bytes()
