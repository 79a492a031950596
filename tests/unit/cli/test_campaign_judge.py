"""``shmio-campaign judge``: verdicts over recordings, as text and JSON, and the exit status."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from shmio.cli.campaign import main
from tests.unit.recording.build import build, image, varied


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with a recording of 40 frames: the speed rises by 1 a frame, frame 20 was missed."""
    monkeypatch.chdir(tmp_path)
    with build(tmp_path / "run.mem") as work:
        work.block("cell")
        for number in range(1, 41):
            if number != 20:
                seen = image(number, 99.0 if number == 30 else number, on=number > 5)
                work.frame(number, image(number, number, on=number > 5), effective=seen if number == 30 else None)
            if number % 7 == 0:
                work.chunk()
    return tmp_path


def campaign(*tables: str) -> None:
    Path("c.toml").write_text("".join(f'[[expect]]\nname = "e{at}"\n{table}\n' for at, table in enumerate(tables)))


def judged(capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, dict[str, Any]]:
    status = main(["judge", "run.mem", "-f", "c.toml", "--json", *options])
    return status, json.loads(capsys.readouterr().out)


def test_verdicts_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    campaign("always = 'speed < 100'", "never = 'speed > 10'\nrequirement = 'R1'", "formula = 'eventually on'")
    status, found = judged(capsys)
    first, second, third = found["verdicts"]
    assert status == 1
    assert (first["outcome"], first["robustness"]) == ("inconclusive", None)
    assert "frames of cell were missed from 0.380 s to 0.420 s" in first["reason"]
    assert (second["outcome"], second["moment_s"], second["requirement"]) == ("failed", 0.22, "R1")
    assert [pair["value"] for pair in second["around"]["cell/speed"]] == [9, 10, 11, 12, 13, 14]
    assert (third["outcome"], third["robustness"]) == ("passed", 1)
    assert (found["begin_s"], found["end_s"], found["files"]) == (0.02, 0.8, ["run.mem"])


def test_a_recording_that_was_not_closed_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    campaign("never = 'speed > 10'")
    assert main(["judge", "run.mem", "-f", "c.toml"]) == 1
    whole = capsys.readouterr()
    assert whole.err == ""
    with Path("run.mem").open("r+b") as file:
        file.truncate(file.seek(-30, os.SEEK_END))
    assert main(["judge", "run.mem", "-f", "c.toml"]) == 1
    cut = capsys.readouterr()
    assert cut.out == whole.out
    assert cut.err.startswith("run.mem: not closed (it ")
    assert cut.err.endswith("or its recorder was killed; judged up to 0.800 s\n")
    assert cut.err.count("\n") == 1


def test_exit_status_and_text(capsys: pytest.CaptureFixture[str]) -> None:
    campaign("never = 'speed > 100'")
    assert main(["judge", "run.mem", "-f", "c.toml"]) == 3
    campaign("never = 'speed > 100'", "always = 'raw(speed) < 41'")
    assert main(["judge", "run.mem", "-f", "c.toml", "--from", "0.42"]) == 0
    text = capsys.readouterr().out
    assert "inconclusive  e0  frames of cell were missed" in text
    assert "passed        e0  robustness 1\npassed        e1  robustness 1\n2 passed, 0 failed, 0" in text
    campaign("never = 'speed > 98'")
    assert main(["judge", "run.mem", "-f", "c.toml"]) == 1
    assert "cell/speed  0.560: 28  0.580: 29  0.600: 99  0.620: 31" in capsys.readouterr().out


def test_two_sources_and_damage_of_values(capsys: pytest.CaptureFixture[str]) -> None:
    varied(Path("run.mem"))
    campaign(
        "always = 'cell/count + press/count < 5'", "never = 'quality(cell/count) = bad'", "always = 'press/count < 0'"
    )
    status, found = judged(capsys)
    assert status == 1
    assert [one["outcome"] for one in found["verdicts"]] == ["failed", "failed", "passed"]


def test_like_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with build(tmp_path / "golden.mem") as work:
        work.block("cell")
        for number in range(101, 121):
            work.frame(number, image(number - 100, number - 101, on=number > 106))
    near = "like = 'golden.mem'\nsignal = ['speed', 'on']\ntolerance = 0.5\ntolerance_s = 0.02"
    campaign(near, near.replace("0.02", "0.01"), "like = 'golden.mem'\nsignal = 'cell'")
    status, found = judged(capsys, "--to", "0.36")
    assert status == 1
    assert [(one["outcome"], one["moment_s"]) for one in found["verdicts"][1:]] == [("failed", 0.02), ("failed", 0.02)]
    assert "the run ended" in found["verdicts"][0]["reason"], "the recording is shorter"
    assert main(["judge", "run.mem", "-f", "c.toml", "--report", "out.html"]) == 1
    page = Path("out.html").read_text()
    assert (page.count("<svg"), page.count("#2da44e")) == (7, 14), "a plot for each signal, with two limits"
    assert set(found["verdicts"][2]["around"]) == {"cell/count", "cell/speed", "cell/on"}


@pytest.mark.parametrize(
    ("table", "error"),
    [
        ("like = 'no.mem'\nsignal = 'on'", "expect[0].like: no.mem: No such file or directory"),
        ("like = 'c.toml'\nsignal = 'on'", "expect[0].like: c.toml"),
        ("like = 'run.mem'\nsignal = 'no'", "expect[0].signal: no: DB1 has no such register"),
        ("like = 'run.mem'\nsignal = ['row']", "expect[0].signal: row is an array"),
        ("like = 'run.mem'\nsignal = []", "expect[0].signal: must not be empty"),
        ("like = 'run.mem'", "expect[0].signal: this key is needed with like"),
        ("like = 'run.mem'\nsignal = 'on'\ntolerance = -1", "expect[0].tolerance: expected"),
    ],
)
def test_wrong_recording_has_status_2(table: str, error: str, capsys: pytest.CaptureFixture[str]) -> None:
    campaign(table)
    assert main(["judge", "run.mem", "-f", "c.toml"]) == 2
    told = capsys.readouterr().err
    assert error in told
    assert told.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", "c.toml: expect: this key is needed; write an [[expect]] table, or create the injections alone with "),
        ("[[expect]]\n", "c.toml:1: expect[0].name: this key is needed"),
        ('[[expect]]\nname = "e"\n', "expect[0].formula: an expectation needs one of formula, then, never"),
        (
            '[[expect]]\nname = "e"\nnever = "speed >"\n',
            "c.toml:3: expect[0].never: at character 8: expected a register",
        ),
        ('[[expect]]\nname = "e"\nnever = "no > 1"\n', "never: at character 1: no: DB1 has no such register"),
        ('[[expect]]\nname = "e"\nnever = "row > 1"\n', "row is an array, but a formula reads single values"),
        ('[[expect]]\nname = "e"\nnever = "on"\nfor_s = 1\n', "for_s: never takes no such key; the key is for stays"),
        (
            '[[expect]]\nname = "e"\nnever = "on"\nalways = "on"\n',
            "expect[0].always: this expectation already has never",
        ),
        ('[[expect]]\nname = "e"\nstays = "on"\n', "expect[0].for_s: this key is needed with stays"),
        ('[[expect]]\nname = "e"\nstays = "on"\nfor_s = nan\n', "expect[0].for_s: expected"),
        (
            '[[expect]]\nname = "e"\nnever = "on"\nseverity = "huge"\n',
            "severity: unknown severity 'huge'; valid: info, warning",
        ),
        ('[[expect]]\nname = "e"\nnever = "on"\n' * 2, "expect[1].name: 'e' is already the name of expect[0]"),
        (
            '[[expect]]\nname = "e"\nsignal = "speed"\nmaxrate = 1\n',
            "c.toml:4: expect[0].maxrate: unknown key; did you mean 'max_rate'? (expect \"e\")",
        ),
        ('[[expect]]\nnam = "e"\n', "c.toml:2: expect[0].nam: unknown key; did you mean 'name'?"),
        ('[[expect]]\nname = "e"\nwhere = "x"\n', "where: unknown key; did you mean 'when'?"),
        ('[[expect]]\nname = "e"\nzzz = "x"\n', "zzz: unknown key; valid: name, formula, when, within_s, then"),
        ('[expect]\nname = "e"\n', "expect: write [[expect]] with double brackets"),
        ("".join(f'[[expect]]\nname = "e{at}"\nnever = "on"\n' for at in range(257)), "at most 256 are allowed"),
    ],
)
def test_wrong_campaign_has_status_2(text: str, error: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("c.toml").write_text(text)
    assert main(["judge", "run.mem", "-f", "c.toml"]) == 2
    told = capsys.readouterr().err
    assert error in told
    assert told.count("\n") == 1


def test_file_that_is_no_recording_has_status_3(capsys: pytest.CaptureFixture[str]) -> None:
    campaign("never = 'on'")
    assert main(["judge", "c.toml", "-f", "c.toml"]) == 3
    assert main(["judge", "c.toml", "-f", "c.toml", "--json"]) == 3
    assert "error" in json.loads(capsys.readouterr().out.splitlines()[-1])


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["no.mem"], "no.mem: No such file or directory"),
        (["run.mem", "--from", "yesterday"], "--from"),
        (["run.mem", "--from", "3", "--to", "2"], "--to 2 is before --from 3"),
    ],
)
def test_wrong_usage_has_status_2(words: list[str], error: str, capsys: pytest.CaptureFixture[str]) -> None:
    campaign("never = 'on'")
    assert main(["judge", *words, "-f", "c.toml", "--json"]) == 2
    assert error in json.loads(capsys.readouterr().out)["error"]
