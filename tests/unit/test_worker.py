"""What every child process does, seen by its supervisor, with a real process and segment."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shmio.segment import Activity, ProcessSpec, Segment, State
from shmio.testing.cell import until

WORK = """
import gc, logging, os, signal, sys, threading
from shmio import logs, worker
from shmio.errors import ConfigError, ConnectorError

def run(w):
    started = gc.isenabled()
    w.running()
    what = w.config["do"]
    if what == "refuse":
        raise ConfigError("host: this key is needed")
    if what == "fail":
        raise ConnectorError("the device is on fire")
    if what == "crash":
        raise ZeroDivisionError
    told = []
    if what == "reread late":
        os.kill(os.getpid(), signal.SIGHUP)
        w.stopping.wait(0.2)
    if what.startswith("reread"):
        w.on_reread(lambda: told.append("anew"))
    if what.startswith("reload"):
        reload = worker.Reload(w, threading.Event())
        told.append(f"permitted: {reload.permitted(lambda: what == 'reload begun')}")
    if what == "collect":
        told.append(f"collects: {started}, then {gc.isenabled()}")
    if what == "flood":
        logs.TURN_S = 0.05
        limited = logs.rate_limited("shmio.source")
        limited.__enter__()
        for number in range(1000):
            logging.getLogger("shmio.source").warning("the quality is %s", number)
    while not w.stopping.wait(0.01):
        w.report((1, 2, 3), note=" ".join(["at work", *told]))

raise SystemExit(worker.main(run))
"""


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    with Segment.create(instance, [], [ProcessSpec("cell", "source")]) as segment:
        yield segment
        segment.unlink()


class Started:
    """A worker process, which is killed at the end of the test."""

    def __init__(self, segment: Segment, folder: Path, do: str, **changes: Any) -> None:
        self.log = folder / "cell.log"
        spec = {
            "instance": segment.instance,
            "epoch": segment.header.epoch,
            "name": "cell",
            "kind": "source",
            "log_file": str(self.log),
            "config": {"do": do},
        } | changes
        self.start(json.dumps(spec))

    def start(self, standard_input: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", WORK], stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.process.stdin is not None
        self.process.stdin.write(standard_input)
        self.process.stdin.close()

    def __enter__(self) -> Started:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stderr is not None
        self.process.stderr.close()

    def end(self) -> tuple[int, str]:
        assert self.process.stderr is not None
        errors = self.process.stderr.read()
        return self.process.wait(20), errors


def test_it_takes_its_role_reports_sends_heartbeats_and_stops(segment: Segment, tmp_path: Path) -> None:
    slot = segment.processes.find("cell")
    with Started(segment, tmp_path, "work") as worker:
        until(lambda: slot.report.note == "at work", "a report")
        report = slot.report
        assert (report.pid, report.activity, report.counters[:3]) == (worker.process.pid, Activity.RUNNING, (1, 2, 3))
        assert slot.alive()
        beat = slot.heartbeat_ns
        until(lambda: slot.heartbeat_ns > beat, "a heartbeat")
        worker.process.send_signal(signal.SIGINT)  # the supervisor handles Ctrl-C
        beat = slot.heartbeat_ns
        until(lambda: slot.heartbeat_ns > beat, "a heartbeat after SIGINT")
        worker.process.terminate()
        assert worker.end() == (0, "")
    assert (slot.report.activity, slot.alive()) == (Activity.STOPPING, False)
    assert "stopped" in worker.log.read_text().splitlines()[-1]


def test_the_last_line_that_a_rate_limit_has_left_out_is_written(segment: Segment, tmp_path: Path) -> None:
    with Started(segment, tmp_path, "flood") as worker:
        until(lambda: worker.log.exists() and "the quality is 999" in worker.log.read_text(), "the last line")


def test_garbage_is_collected_once_the_start_is_over(segment: Segment, tmp_path: Path) -> None:
    slot = segment.processes.find("cell")
    with Started(segment, tmp_path, "collect"):
        until(lambda: slot.report.note == "at work collects: False, then True", "collection after the start")


def test_it_reads_its_files_again_at_each_sighup(segment: Segment, tmp_path: Path) -> None:
    slot = segment.processes.find("cell")
    with Started(segment, tmp_path, "reread") as worker:
        for note in ("at work", "at work anew", "at work anew anew"):
            until(lambda note=note: slot.report.note == note, note)  # type: ignore[misc]
            worker.process.send_signal(signal.SIGHUP)
        worker.process.terminate()
        assert worker.end() == (0, "")
    with Started(segment, tmp_path, "work") as worker:  # a worker that has nothing to read again ignores the signal
        until(lambda: slot.report.pid == worker.process.pid and slot.report.note == "at work", "work")
        worker.process.send_signal(signal.SIGHUP)
        beat = slot.heartbeat_ns
        until(lambda: slot.heartbeat_ns > beat, "a heartbeat after SIGHUP")
        worker.process.terminate()
        assert worker.end() == (0, "")


def test_a_sighup_before_it_can_read_again_is_not_lost(segment: Segment, tmp_path: Path) -> None:
    slot = segment.processes.find("cell")
    with Started(segment, tmp_path, "reread late") as worker:
        until(lambda: slot.report.note.startswith("at work anew"), "it reads anew")
        worker.process.terminate()
        assert worker.end() == (0, "")


def test_a_reload_waits_for_the_permission(segment: Segment, tmp_path: Path) -> None:
    slot = segment.processes.find("cell")
    with Started(segment, tmp_path, "reload"):
        until(lambda: slot.report.activity is Activity.PAUSED, "the pause")
        for _ in range(2):
            beat = slot.heartbeat_ns
            until(lambda beat=beat: slot.heartbeat_ns > beat, "a heartbeat")  # type: ignore[misc]
        assert slot.report.note == ""
        slot.digest = b"x" * 32
        until(lambda: slot.report.note == "at work permitted: True", "the permission")


def test_a_reload_goes_on_if_the_segment_has_changed(segment: Segment, tmp_path: Path) -> None:
    slot = segment.processes.find("cell")
    with Started(segment, tmp_path, "reload begun"):
        until(lambda: slot.report.note == "at work permitted: True", "the end of the wait")


def test_a_reload_whose_supervisor_ends_changes_nothing(segment: Segment, tmp_path: Path) -> None:
    slot = segment.processes.find("cell")
    with Started(segment, tmp_path, "reload") as worker:
        until(lambda: slot.report.activity is Activity.PAUSED, "the pause")
        segment.set_state(segment.supervisor[0] + 1, State.RUNNING)  # another supervisor has taken over
        until(lambda: slot.report.note == "at work permitted: False", "the end of the wait")
    assert "continues as before" in worker.log.read_text()


@pytest.mark.parametrize(
    ("do", "status", "note"),
    [("refuse", 2, "host: this key is needed"), ("fail", 1, "the device is on fire"), ("crash", 1, "")],
)
def test_the_exit_status_says_whether_a_restart_can_help(
    segment: Segment, tmp_path: Path, do: str, status: int, note: str
) -> None:
    with Started(segment, tmp_path, do) as worker:
        returned, errors = worker.end()
        assert returned == status
        assert ("ZeroDivisionError" in errors) == (do == "crash")
    assert segment.processes.find("cell").report.note == note
    assert (note or "ZeroDivisionError") in worker.log.read_text()


def test_it_waits_for_its_role_until_the_holder_has_ended(segment: Segment, tmp_path: Path) -> None:
    slot = segment.processes.find("cell")
    with Started(segment, tmp_path, "work") as first:
        until(lambda: slot.report.note == "at work", "the first worker's report")
        with Started(segment, tmp_path, "work") as second:
            os.kill(first.process.pid, signal.SIGKILL)
            until(lambda: slot.report.pid == second.process.pid, "the second worker in the role")


def test_a_worker_works_without_a_log(segment: Segment, tmp_path: Path) -> None:
    slot = segment.processes.find("cell")
    (tmp_path / "file").touch()
    with Started(segment, tmp_path / "file", "work"):
        until(lambda: slot.report.note == "at work", "work")


def test_a_worker_of_another_run_of_the_instance_exits(segment: Segment, tmp_path: Path) -> None:
    with Started(segment, tmp_path, "work", epoch=1) as worker:
        returned, errors = worker.end()
    assert returned == 1
    assert "another run" in errors


def test_a_worker_that_gets_its_role_in_a_removed_segment_exits(segment: Segment, tmp_path: Path) -> None:
    with Segment.open(segment.instance, writable=True) as holder:
        assert holder.processes.find("cell").take()
        with Started(segment, tmp_path, "work") as worker:
            name = f"/dev/shm/shmio-{segment.instance}"
            until(lambda: name in Path(f"/proc/{worker.process.pid}/maps").read_text(), "the worker attached")
            segment.unlink()
            holder.close()
            returned, errors = worker.end()
    assert returned == 1
    assert "was removed" in errors


def test_without_a_description_it_explains_how_it_is_started(segment: Segment, tmp_path: Path) -> None:
    for standard_input in ("", "nonsense", "[]", '{"name": "cell"}'):
        with Started.__new__(Started) as worker:
            worker.start(standard_input)
            returned, errors = worker.end()
        assert returned == 2
        assert "description" in errors
        assert "Traceback" not in errors
