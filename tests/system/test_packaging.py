"""The systemd unit: systemd's own check of it, and the behaviour that it relies on."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from shmio.testing.cell import BIN

ROOT = Path(__file__).parents[2]
UNIT = ROOT / "packaging" / "shmio@.service"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_verifies_the_unit(tmp_path: Path) -> None:
    installed = UNIT.read_text().replace("/opt/shmio/bin/shmio-supervisor", str(BIN / "shmio-supervisor"))
    installed = installed.replace("User=shmio", "User=root")
    (tmp_path / "shmio@a50.service").write_text(installed)
    unit = str(tmp_path / "shmio@a50.service")
    verified = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, check=False)
    assert (verified.returncode, verified.stderr) == (0, "")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_the_unit_is_hardly_exposed(tmp_path: Path) -> None:
    """docs/how-to/run-as-a-service.md gives the score, in which 10 is the worst; 0.1 more may be another systemd."""
    shutil.copy(UNIT, tmp_path)
    unit = str(tmp_path / UNIT.name)
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", "--threshold=18", unit]
    rated = subprocess.run(command, capture_output=True, text=True, check=False)
    assert rated.returncode == 0, rated.stdout + rated.stderr


@pytest.mark.parametrize(
    ("result", "cleared"),
    [("success", True), ("timeout", True), ("signal", False), ("watchdog", False), ("oom-kill", False)],
)
def test_only_a_stop_clears_remaining_processes(result: str, cleared: bool) -> None:
    """After a crash of the supervisor, the processes continue, and the restarted supervisor takes them over."""
    (line,) = [line for line in UNIT.read_text().splitlines() if line.startswith("ExecStopPost=")]
    script = line.partition("-c ")[2].strip("'").replace("%i", "a50").replace(">/dev/null 2>&1", "")
    ran = subprocess.run(
        ["/bin/sh", "-c", script.replace("/opt/shmio/bin/shmio-supervisor", "echo")],
        env={"SERVICE_RESULT": result},
        capture_output=True,
        text=True,
        check=True,
    )
    assert ran.stdout == ("down -c /etc/shmio/a50/supervisor.toml\n" if cleared else "")


def test_out_of_memory_ends_one_process_only() -> None:
    """By systemd's default, a process that runs out of memory would stop the whole service."""
    assert "OOMPolicy=continue" in UNIT.read_text().splitlines()
