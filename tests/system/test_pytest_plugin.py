"""The pytest plugin, tried from its how-to as a new user would, in a run of pytest of its own."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from shmio.recording.dump import open_dump
from shmio.segment import running_instances
from shmio.testing.cell import PATIENCE_S

PAGES = Path(__file__).parents[2] / "docs/how-to"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
FAILING = """
import pytest

@pytest.mark.shmio("logic.toml")
def test_expectation(cell):
    cell.write({"cell/Inputs/Request": True})
    cell.run_for(1)
    cell.expect("eventually[0, 0.6] cell/Outputs/Locked")

@pytest.mark.shmio("logic.toml")
def test_undecided(cell):
    cell.run_for(0.1)
    cell.expect("eventually[0, 5] cell/Outputs/Locked")

@pytest.mark.shmio("logic.toml")
def test_plain(cell):
    cell.run_for(0.1)
    assert cell["cell/Outputs/Openings"] == 5

def test_unmarked(cell):
    pass

@pytest.mark.shmio("missing.toml")
def test_missing(cell):
    pass
"""
MISSPELT = """
import pytest

@pytest.mark.shmio("logic.toml")
def test_misspelt(cell):
    try:
        cell.disturb("plc", "hang")
    except Exception as error:
        print(error)
    cell.expect(nevr="cell/Outputs/Locked")
"""
TERMINATED = """
import os
import signal

import pytest

@pytest.mark.shmio("logic.toml")
def test_terminated(cell):
    os.kill(os.getpid(), signal.SIGTERM)
    cell.run_for(0.1)
"""


def blocks(page: str, kind: str) -> list[str]:
    return [found[2] for found in BLOCK.finditer((PAGES / page).read_text()) if found[1] == kind]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Write the files of both pages."""
    folder = tmp_path / "project"
    folder.mkdir()
    program, block, configuration = (
        one for kind in ("python", "scl", "toml") for one in blocks("write-a-plc-program.md", kind)
    )
    tests, logic_tests = blocks("test-a-cell.md", "python")
    (logic,) = blocks("test-a-cell.md", "toml")
    files = {
        "interlock.py": program,
        "door.db": block,
        "supervisor.toml": configuration,
        "test_door.py": tests,
        "logic.toml": logic,
        "test_logic.py": logic_tests,
        "test_failing.py": FAILING,
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder


def run_pytest(project: Path, *words: str) -> str:
    installed = any(one.value == "shmio.testing.plugin" for one in entry_points(group="pytest11"))
    plugin = [] if installed else ["-p", "shmio.testing.plugin"]
    base = f"--basetemp={project.parent / 'base'}"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", base, "-p", "no:cacheprovider", *plugin, *words],
        cwd=project,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    return done.stdout + done.stderr


def ours() -> set[str]:
    return {name for name in running_instances() if name.startswith("door-")}


def test_the_page_passes_in_parallel_and_leaves_nothing(project: Path) -> None:
    before, files = ours(), {file.name for file in project.iterdir()}
    output = run_pytest(project, "-n2", "test_door.py", "test_logic.py")
    assert "5 passed" in output, output
    assert ours() <= before
    assert {file.name for file in project.iterdir()} - files <= {"__pycache__"}


def test_a_failing_test_leaves_a_recording_and_plots(project: Path) -> None:
    output = run_pytest(project, "-n0", "test_failing.py", "--shmio-keep", "kept")
    assert "3 failed, 2 errors" in output, output
    assert "failed" in output
    assert "inconclusive" in output
    assert '@pytest.mark.shmio("supervisor.toml")' in output
    assert "missing.toml" in output
    recordings = [Path(project, path) for path in re.findall(r"^recording: (.*)$", output, re.MULTILINE)]
    reports = [Path(project, path) for path in re.findall(r"^plots: +(.*)$", output, re.MULTILINE)]
    assert len(recordings) == len(reports) == 3
    with open_dump(recordings[0]) as dump:
        assert dump.closed
        cycles = [entry.item.cycle for entry in dump.frames("cell")]
    assert cycles[-100:] == list(range(1, 101))
    pages = [file.read_text() for file in reports]
    assert all("<svg" in page for page in pages)
    assert "eventually[0, 0.6] cell/Outputs/Locked" in pages[0]
    assert "cell/Inputs/Request" in pages[0]
    assert "cell/Outputs/Openings" in pages[2]
    assert "kept" in recordings[0].parts
    assert (recordings[0].parent / "logs").is_dir()


def test_misspelt_names_are_answered_as_by_the_commands(project: Path) -> None:
    (project / "test_misspelt.py").write_text(MISSPELT)
    output = run_pytest(project, "-n0", "test_misspelt.py")
    assert "unknown emulator 'plc'; there are none" in output, output
    assert "expect[0].nevr: unknown key; did you mean 'never'?" in output


def test_sigterm_stops_the_instance(project: Path) -> None:
    before = ours()
    (project / "test_terminated.py").write_text(TERMINATED)
    assert "KeyboardInterrupt" in run_pytest(project, "-n0", "test_terminated.py")
    assert ours() <= before


def test_other_tests_do_not_import_shmio(project: Path) -> None:
    (project / "test_other.py").write_text(
        "import sys\ndef test_other():\n    assert 'shmio.segment' not in sys.modules\n"
    )
    assert "1 passed" in run_pytest(project, "-n0", "test_other.py")
