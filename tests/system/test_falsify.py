"""``shmio-campaign falsify``: it finds, shrinks and stores, it repeats, and it can be interrupted."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from shmio.cli.campaign import main
from shmio.recording.compare import Comparison, compare
from shmio.recording.digest import digest_of_contents
from shmio.recording.dump import open_dump

CONFIG = """
[instance]
name = "falsify-system"
clock = "stepped"

[[source]]
name = "lift"
connector = "simulation"
model = "falsify_system_lift:Lift"
period_ms = 20
"""
MODEL = """
import os
import time
from shmio.simulation import Input, Model, Output, Parameter

class Lift(Model):
    speed = Input("LREAL", initial=1.0)
    height = Output("LREAL")
    gain = Parameter("LREAL", initial=1.0)

    def step(self, time_s, dt_s):
        self.height += self.gain * self.speed * dt_s
        if self.gain > 1.9:
            os._exit(1)
"""
CAMPAIGN = """
config = "supervisor.toml"
duration_s = 0.4

[parameters.lift]
gain = { from = 0.5, to = 1.5 }

[[injection]]
name = "push"
target = "lift/height"
operation = "offset"
value = { from = 0, to = 5 }
start_s = { from = 0, to = 0.3, step = 0.02 }
for_s = 0.1

[[injection]]
name = "shake"
target = "lift/height"
operation = "noise"
amplitude = { from = 0.01, to = 0.1 }

[[expect]]
name = "low"
always = "lift/height < 5"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (
        ("falsify_system_lift.py", MODEL),
        ("supervisor.toml", CONFIG),
        ("campaign.toml", CAMPAIGN),
    ):
        (tmp_path / name).write_text(text)
    return tmp_path


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "shmio.cli.campaign", *words]


def campaign(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*words), cwd=folder, capture_output=True, text=True, timeout=110, check=False)


def found(folder: Path, *words: str) -> dict[str, Any]:
    done = campaign(folder, "falsify", "campaign.toml", "--json", *words)
    assert done.stdout, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    result["status"] = done.returncode
    return result


def trials(folder: Path) -> list[Any]:
    """Return the points and the robustness of all trials of a search."""
    lines = [json.loads(line) for line in (folder / "trials.jsonl").read_text().splitlines()[1:]]
    return [
        (one["point"], one["result"]["expectations"][0]["robustness"]) for one in lines if one.get("result") is not None
    ]


def names(folder: Path) -> list[str]:
    """Return the names of all files in a folder."""
    return sorted(one.relative_to(folder).as_posix() for one in folder.rglob("*"))


def test_a_failure_is_found_shrunk_and_repeats_byte_for_byte(folder: Path) -> None:
    done = campaign(folder, "falsify", "campaign.toml", "--trials", "60", "-o", "out")
    assert done.returncode == 1, done.stderr + done.stdout
    assert "trial" in done.stdout
    assert "least robustness" in done.stdout
    case = folder / "out/case-001"
    assert sorted(one.name for one in case.iterdir()) == ["campaign.toml", "report.html", "run.mem"]
    text = (case / "campaign.toml").read_text()
    assert 'name = "shake"' not in text, "an injection that does not matter is left out"
    assert 'config = "../../supervisor.toml"' in text
    again = campaign(folder, "run", "out/case-001/campaign.toml", "--lab", "--record", "again.mem", "--json")
    assert again.returncode == 1, again.stderr
    told = json.loads(again.stdout)
    assert told["contents_sha256"] in text
    with open_dump(case / "run.mem") as one, open_dump(folder / "again.mem") as other:
        assert digest_of_contents(one) == digest_of_contents(other) == told["contents_sha256"]
        assert all(difference.same for difference in compare(one, other, Comparison()))
    assert campaign(folder, "run", "campaign.toml", "--lab").returncode == 2
    judged = campaign(folder, "judge", "again.mem", "-f", "campaign.toml", "--json")
    assert json.loads(judged.stdout)["verdicts"][0]["robustness"] == told["verdicts"][0]["robustness"]


def test_a_search_goes_on_as_if_it_had_not_been_interrupted(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    file = folder / "campaign.toml"
    file.write_text(CAMPAIGN.replace("from = 0, to = 5 }", "from = 2, to = 4.9 }"))
    words = ["falsify", "campaign.toml", "--all", "--trials", "12", "--jobs", "2", "--seed", "4", "--shrink", "1"]
    assert main([*words, "-o", "whole"]) == 1
    lines = (folder / "whole/trials.jsonl").read_bytes().splitlines(keepends=True)
    assert sum(b'"case"' in line for line in lines) == 1
    (folder / "cut/case-001").mkdir(parents=True)  # the kill came while the case was being stored
    (folder / "cut/case-001/campaign.toml").touch()
    (folder / "cut/trials.jsonl").write_bytes(b"".join(lines[:2]) + lines[2][:20])
    assert main([*words, "-o", "cut", "--resume"]) == 1
    assert "1 trial and 0 cases exist already" in capsys.readouterr().err
    assert trials(folder / "cut") == trials(folder / "whole")
    assert names(folder / "cut") == names(folder / "whole")
    assert main([*words, "-o", "cut", "--resume"]) == 1, "nothing is left to do"
    assert trials(folder / "cut") == trials(folder / "whole")
    file.write_text(file.read_text().replace("to = 4.9 }", "to = 6 }"))
    assert main([*words, "-o", "cut", "--resume"]) == 2
    assert "injection[0].value.to is 6, but was 4.9" in capsys.readouterr().err


def test_ctrl_c_and_kill(folder: Path) -> None:
    for sign, options in ((signal.SIGKILL, []), (signal.SIGINT, ["--resume"])):
        words = command("falsify", "campaign.toml", "--trials", "9000", "--set", "push.value=1", "-o", "out", *options)
        with subprocess.Popen(words, cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as one:
            assert one.stderr is not None
            assert any(" of 9000 trials" in line for line in one.stderr)
            workers = Path(f"/proc/{one.pid}/task/{one.pid}/children").read_text().split()
            assert workers
            one.send_signal(sign)
            rest = one.stderr.read()
            while any(Path(f"/proc/{pid}/exe").exists() for pid in workers):
                time.sleep(0.01)
        assert one.returncode == (-9 if sign == signal.SIGKILL else 3), rest
    assert "interrupted; continue with --resume" in rest
    assert len(trials(folder / "out")) >= 2


def test_statuses_and_refusals(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    file = folder / "campaign.toml"

    def told(*words: str) -> dict[str, Any]:
        status = main(["falsify", "campaign.toml", "--json", *words])
        result: dict[str, Any] = json.loads(capsys.readouterr().out)
        return result | {"status": status}

    values = [f"--set={text}" for text in ("push.value=1", "push.start_s=0.1", "shake.amplitude=0.01")]
    passing = told("--trials", "3", *values, "-o", "passing")
    assert (passing["status"], passing["outcomes"], passing["cases"]) == (0, {"passed": 3}, [])
    file.write_text(CAMPAIGN.replace("to = 1.5", "to = 2.5"))
    crashed = told("--trials", "3", "--search", "grid", *values, "-o", "crashed")
    assert crashed["status"] == 3
    assert crashed["outcomes"] == {"passed": 2, "error": 1}
    assert "ended with status 1" in crashed["unclear"]["reason"]
    for text, words, error in (
        (CAMPAIGN.replace('lift/height"\noperation = "offset', 'lift/high"\noperation = "offset'), [], "lift/high"),
        (CAMPAIGN, [*values, "--set=parameters.lift.gain=1"], "no ranges to search"),
        (CAMPAIGN, ["--set", "push.valu=1"], "unknown range 'push.valu'; did you mean"),
        (CAMPAIGN, ["--resume"], "no search to continue"),
        (CAMPAIGN, ["--trials", "9000000"], "at most 1000000"),
        (CAMPAIGN.replace("duration_s = 0.4", ""), [], "campaign.toml: duration_s: "),
        (CAMPAIGN.replace('config = "supervisor.toml"', ""), [], " -c FILE"),
        (CAMPAIGN.replace("lift/height < 5", "lift/height <"), [], "always: at character"),
    ):
        file.write_text(text)
        folder_of_search = f"refused-{len(list(folder.iterdir()))}"
        assert main(["falsify", "campaign.toml", "--trials", "2", *words, "-o", folder_of_search]) == 2, error
        assert error in capsys.readouterr().err
