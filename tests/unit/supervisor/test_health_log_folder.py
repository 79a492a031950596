"""The check of the log folder while an instance runs."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from shmio.config.folder import Obstacle
from shmio.supervisor import health
from shmio.supervisor.health import LOOK_S, SILENT_S, LogFolder
from tests.unit.supervisor.harness import Launch, until

LOOK_NS, SILENT_NS = round(LOOK_S * 1e9), round(SILENT_S * 1e9)


def test_a_disk_that_does_not_answer_blocks_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answering, looks = threading.Event(), []

    def unwritable(folder: Path) -> Obstacle:
        looks.append(folder)
        answering.wait()
        return Obstacle("it is full", full=True)

    monkeypatch.setattr(health, "unwritable", unwritable)
    logs = LogFolder(tmp_path)
    assert logs.problem(0) == ""
    assert logs.problem(LOOK_NS + 1) == ""
    assert logs.problem(SILENT_NS + 1) == f"log_dir: {tmp_path}: the disk does not answer"
    assert looks == [tmp_path], "one check at a time"
    answering.set()
    until(lambda: logs.problem(0) == "log_dir: it is full; log lines are lost until that is fixed")


def test_status_reports_the_problem_while_it_lasts_and_processes_continue(launch: Launch, tmp_path: Path) -> None:
    cell = launch(look_s=0.1)
    cell.wait_state("running")
    pids = cell.pids()
    away = tmp_path.with_name("away")
    tmp_path.rename(away)
    tmp_path.touch()
    try:
        until(lambda: cell.status().state == "degraded")
        assert cell.status().note == f"log_dir: {tmp_path} is not a directory; log lines are lost until that is fixed"
        cell.wait_state("degraded")
    finally:
        tmp_path.unlink()
        away.rename(tmp_path)
    until(lambda: (cell.status().state, cell.status().note) == ("running", ""))
    assert cell.pids() == pids
    assert cell.stop() == 0
