"""Programs that are run for a notice: what they get, and what they cannot do."""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from pathlib import Path

import pytest

from shmio.endpoints.alerts.command import MAX_OUTPUT_BYTES, Command
from shmio.endpoints.alerts.sender import DeliveryError
from tests.unit.endpoints.alerts.harness import notice

TIMEOUT_S = 60


def python(program: str, *arguments: str, timeout_s: float = TIMEOUT_S) -> Command:
    return Command([sys.executable, "-c", program, *arguments], timeout_s)


def test_a_program_gets_the_notice(tmp_path: Path) -> None:
    file = tmp_path / "told"
    program = (
        "import json, os, sys; json.dump([sys.argv[2:], json.load(sys.stdin), "
        "{k: v for k, v in os.environ.items() if k.startswith('SHMIO_ALERT_')}], open(sys.argv[1], 'w'))"
    )
    python(program, str(file), "$HOME; rm -rf /").deliver(notice())
    arguments, told, variables = json.loads(file.read_text())
    assert arguments == ["$HOME; rm -rf /"], "no shell reads it"
    assert told == json.loads(notice().json())
    assert variables["SHMIO_ALERT_NAME"] == "hot"
    assert variables["SHMIO_ALERT_STATE"] == "active"
    assert json.loads(variables["SHMIO_ALERT_VALUES"]) == {"cell/axis/position": 6.0}


def test_the_log_has_the_beginning_of_the_output(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "shmio.alerts")
    python("import sys; print('said'); sys.stderr.write('x' * 1_000_000)").deliver(notice())
    text = caplog.text
    assert "its command printed: said" in text
    assert f"its command printed {1_000_005 - MAX_OUTPUT_BYTES} more bytes, which the log leaves out" in text
    assert len(text) < 3 * MAX_OUTPUT_BYTES


@pytest.mark.parametrize(
    ("program", "problem"),
    [
        ("import sys; sys.exit(3)", "exit status 3"),
        ("import os; os.kill(os.getpid(), 15)", "signal 15"),
    ],
)
def test_a_program_that_fails_is_reported(program: str, problem: str) -> None:
    with pytest.raises(DeliveryError, match=problem) as raised:
        python(program).deliver(notice())
    assert not raised.value.again


def test_a_program_that_does_not_exist_is_reported(tmp_path: Path) -> None:
    with pytest.raises(DeliveryError, match="cannot be started: No such file"):
        Command([str(tmp_path / "none")], TIMEOUT_S).deliver(notice())


def test_a_program_that_takes_too_long_is_killed_with_its_children(tmp_path: Path) -> None:
    file = tmp_path / "pid"
    program = (
        "import subprocess, sys, time; p = subprocess.Popen(['sleep', '1000']); "
        "open(sys.argv[1], 'w').write(str(p.pid)); time.sleep(1000)"
    )
    with pytest.raises(DeliveryError, match=r"killed: it took longer than 0\.5 s"):
        python(program, str(file), timeout_s=0.5).deliver(notice())
    if file.exists():  # on a busy host the program may not have come so far
        child = Path("/proc") / file.read_text() / "stat"
        until_s = time.monotonic() + TIMEOUT_S
        while child.exists() and child.read_text().rpartition(")")[2].split()[0] != "Z":
            assert time.monotonic() < until_s
            time.sleep(0.01)


def test_a_program_that_leaves_a_child_behind_does_not_hold_us_up() -> None:
    begun_s = time.monotonic()
    python("import subprocess; subprocess.Popen(['sleep', '5'])").deliver(notice())
    assert time.monotonic() - begun_s < TIMEOUT_S, "the child still has the pipe"


def test_a_stop_ends_a_program() -> None:
    command = python("import time; time.sleep(1000)")
    timer = threading.Timer(0.1, command.stop)
    timer.start()
    with pytest.raises(DeliveryError, match="this process stops"):
        command.deliver(notice())
    timer.join()
