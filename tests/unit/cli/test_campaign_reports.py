"""``shmio-campaign``: files of reports that cannot be written cost no verdict."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from shmio.cli.campaign import main
from tests.unit.recording.build import build, image

CAMPAIGN = '[[expect]]\nname = "low"\nalways = "speed < {limit}"\n'


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with a recording and two campaigns, of which it meets one."""
    monkeypatch.chdir(tmp_path)
    with build(tmp_path / "run.mem") as work:
        work.block("cell")
        for number in range(1, 10):
            work.frame(number, image(number, number, on=True))
    (tmp_path / "good.toml").write_text(CAMPAIGN.format(limit=100))
    (tmp_path / "bad.toml").write_text(CAMPAIGN.format(limit=5))
    return tmp_path


@pytest.fixture
def full(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the disk fill when a report gets its name."""

    def refuse(_self: Path, _target: Path) -> Path:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "replace", refuse)


@pytest.mark.parametrize("option", ["--report", "--junit"])
@pytest.mark.parametrize(
    ("place", "error"),
    [
        ("good.toml/out", "{folder}/good.toml is not a directory"),
        ("/proc/none/out", "/proc/none cannot be created in /proc: "),
        (".", "this is a folder; name a file"),
    ],
)
@pytest.mark.parametrize("words", [["judge", "run.mem", "-f"], ["run", "--for", "1", "--lab", "-c", "none.toml"]])
def test_place_is_checked_before_the_run(
    folder: Path, words: list[str], option: str, place: str, error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "bad.toml", option, place]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith(f"{option} {place}: ")
    assert error.format(folder=folder) in told.err
    assert told.err.count("\n") == 1


@pytest.mark.usefixtures("full")
@pytest.mark.parametrize(("campaign", "status"), [("good.toml", 0), ("bad.toml", 1)])
def test_verdicts_are_printed_before_a_file_fails(
    folder: Path, campaign: str, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "old.html").write_text("old")
    before = {one.name for one in folder.iterdir()}
    assert main(["judge", "run.mem", "-f", campaign, "--report", "old.html", "--junit", "o.xml"]) == status
    told = capsys.readouterr()
    assert "low" in told.out
    assert told.err.splitlines() == [
        "--report old.html: it cannot be written: No space left on device",
        "--junit o.xml: it cannot be written: No space left on device",
    ]
    assert (folder / "old.html").read_text() == "old"
    assert {one.name for one in folder.iterdir()} == before


def test_missing_folders_are_created(folder: Path) -> None:
    places = ["--report", "a/b/out.html", "--junit", "c/out.xml"]
    assert main(["judge", "run.mem", "-f", "good.toml", *places]) == 0
    assert (folder / "a/b/out.html").exists()
    assert (folder / "c/out.xml").exists()


def test_a_file_that_fails_does_not_stop_the_other(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["judge", "run.mem", "-f", "bad.toml", "--report", "/dev/full", "--junit", "o.xml"]) == 1
    assert capsys.readouterr().err == "--report /dev/full: it cannot be written: No space left on device\n"
    assert b"<failure" in (folder / "o.xml").read_bytes()
    assert not Path("/dev/full").is_file()


@pytest.mark.parametrize(("campaign", "status"), [("good.toml", 0), ("bad.toml", 1)])
@pytest.mark.parametrize(
    ("broken", "warning"),
    [
        ("shmio.judging.report._svg", "--report o.html: the plot of cell/speed cannot be drawn"),
        ("shmio.judging.report._page", "--report o.html: it cannot be made"),
        ("shmio.judging.report._case", "--junit o.xml: it cannot be made"),
        ("shmio.judging.trace.Traces.add", "--report o.html: it has no plots"),
        ("shmio.judging.trace.Traces.plot", "--report o.html: it has no plots"),
        ("shmio.cli.campaigns.verdicts.lines", "standard output: the verdicts"),
    ],
)
def test_a_fault_of_a_display_is_a_warning(
    folder: Path,
    campaign: str,
    status: int,
    broken: str,
    warning: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def divide(*_arguments: object, **_keywords: object) -> None:
        raise ZeroDivisionError("float division by zero")

    monkeypatch.setattr(broken, divide)
    assert main(["judge", "run.mem", "-f", campaign, "--report", "o.html", "--junit", "o.xml"]) == status
    assert capsys.readouterr().err == f"{warning}: ZeroDivisionError: float division by zero\n"
    lost = "o.html" if "html: it cannot be made" in warning else "o.xml" if "xml" in warning else ""
    assert {name: (folder / name).exists() for name in ("o.html", "o.xml")} == {
        name: name != lost for name in ("o.html", "o.xml")
    }


@pytest.mark.parametrize(("campaign", "status"), [("good.toml", 0), ("bad.toml", 1)])
def test_a_broken_output_changes_no_exit_status(folder: Path, campaign: str, status: int) -> None:
    for out, err in (("/dev/full", "/dev/null"), ("/dev/null", "/dev/full"), ("/dev/full", "/dev/full")):
        with Path(out).open("wb") as stdout, Path(err).open("wb") as stderr:
            code = "import sys; from shmio.cli.entry import shmio_campaign; sys.exit(shmio_campaign())"
            words = [sys.executable, "-c", code, "judge", "run.mem", "-f", campaign, "--junit", "o.xml"]
            done = subprocess.run(words, stdout=stdout, stderr=stderr, cwd=folder, check=False)
        assert done.returncode == status, (out, err)
    assert (folder / "o.xml").exists()


def test_an_older_file_keeps_its_permissions_and_a_link_its_target(folder: Path) -> None:
    (folder / "real.xml").write_text("old")
    (folder / "real.xml").chmod(0o640)
    (folder / "link.xml").symlink_to("real.xml")
    assert main(["judge", "run.mem", "-f", "good.toml", "--junit", "link.xml"]) == 0
    assert (folder / "link.xml").is_symlink()
    assert (folder / "real.xml").read_text().startswith("<?xml")
    assert (folder / "real.xml").stat().st_mode & 0o777 == 0o640
