"""The file with the state of the alerts: what it keeps, and whose content is not trusted."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from shmio.config import Alert
from shmio.endpoints.alerts.lifecycle import Progress
from shmio.endpoints.alerts.state_file import AlertState, State, StateWriter, Waiting, digest, read_state
from tests.unit.endpoints.alerts.harness import notice

HOT = Alert(name="hot", when="cell/x > 5")
STATE = State(
    7, {"hot": AlertState(digest(HOT), "warning", "", "", Progress(active=True, notices=3))}, Waiting([notice()])
)


def written(file: Path) -> Path:
    writer = StateWriter(file)
    writer.write(State(7))
    writer.write(STATE)
    writer.close(30)
    return file


def test_the_newest_state_is_read_again(tmp_path: Path) -> None:
    file = written(tmp_path / "alerts.json")
    assert read_state(file, 7) == STATE
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert [*tmp_path.iterdir()] == [file]


def test_only_the_state_of_this_run_and_of_the_same_condition_counts(tmp_path: Path) -> None:
    file = written(tmp_path / "alerts.json")
    assert read_state(file, 8) == State(8)
    assert read_state(file, 7).progress([HOT])["hot"].notices == 3
    assert read_state(file, 7).progress([Alert(name="hot", when="cell/x > 6")]) == {}


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b'{"epoch": 7, "alerts": 3}', b"\xff" * 100])
def test_a_damaged_file_is_no_state(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "alerts.json").write_bytes(data)
    assert read_state(tmp_path / "alerts.json", 7) == State(7)


def test_a_folder_that_cannot_be_written_is_a_problem(tmp_path: Path) -> None:
    writer = StateWriter(tmp_path / "none" / "alerts.json")
    writer.write(STATE)
    writer.close(30)
    assert "alerts.json: No such file" in writer.problem
