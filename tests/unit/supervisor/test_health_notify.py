"""Notifications to a service manager, received on a socket like systemd's."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.supervisor.health import Notifier
from tests.unit.supervisor.harness import CELL, DEADLINE_S, Launch


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """Return the service manager's end of the socket that the environment names."""
    name = f"@shmio-test-{os.getpid()}" if request.param == "abstract" else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(name.replace("@", "\0"))
        manager.settimeout(DEADLINE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        yield manager


def heard(manager: socket.socket) -> dict[str, str]:
    return dict(line.split("=", 1) for line in manager.recv(4096).decode().split("\n"))


def test_notifications_from_start_to_stop(
    launch: Launch, manager: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "1000000")
    cell = launch([*CELL, ("witness", "emulator", ["good"])])
    told: list[dict[str, str]] = []

    def until(begin: str) -> str:
        """Receive until a line begins with this text."""
        while True:
            told.append(heard(manager))
            for key, value in told[-1].items():
                if f"{key}={value}".startswith(begin):
                    return value

    until("READY=1")
    until("STATUS=running")
    assert not any("STOPPING" in message for message in told)
    environment = Path(f"/proc/{cell.pid('witness')}/environ").read_bytes()
    assert b"NOTIFY_SOCKET" not in environment
    assert b"WATCHDOG" not in environment
    cell.reload(CELL)
    assert int(until("MONOTONIC_USEC=")) > 0
    assert told[-1]["RELOADING"] == "1"
    until("READY=1")
    until("WATCHDOG=1")
    os.kill(cell.pid("cell"), signal.SIGKILL)
    until("STATUS=degraded: cell is not running")
    cell.process.send_signal(signal.SIGTERM)
    until("STOPPING=1")
    assert cell.wait_end() == 0


def test_a_refused_reload_is_reported_as_finished_at_once(launch: Launch, manager: socket.socket) -> None:
    cell = launch()
    cell.wait_state("running")
    with pytest.raises(Exception, match=r"instance\.name"):
        cell.reload(CELL, instance="other")
    keys = [key for _ in range(4) for key in heard(manager)]
    assert keys == ["READY", "STATUS", "RELOADING", "MONOTONIC_USEC", "READY"]


@pytest.mark.parametrize(
    "environment",
    [{}, {"NOTIFY_SOCKET": "relative"}, {"NOTIFY_SOCKET": "/nowhere/at/all"}, {"NOTIFY_SOCKET": "/" + "x" * 300}],
)
def test_without_a_service_manager_notifications_are_skipped(environment: dict[str, str]) -> None:
    notifier = Notifier(environment)
    notifier.ready()
    notifier.beat(1)


def test_the_watchdog_is_fed_only_for_the_named_process_and_not_too_often(manager: socket.socket) -> None:
    environment = {"NOTIFY_SOCKET": os.environ["NOTIFY_SOCKET"], "WATCHDOG_USEC": "1000"}
    Notifier({**environment, "WATCHDOG_PID": "1"}).beat(1_000_000_000)
    notifier = Notifier({**environment, "WATCHDOG_PID": str(os.getpid())})
    notifier.beat(1_000_000_000)
    notifier.beat(1_000_400_000)  # less than half of 1 ms later
    notifier.beat(1_000_500_000)
    notifier.ready()
    assert [heard(manager) for _ in range(3)] == [{"WATCHDOG": "1"}, {"WATCHDOG": "1"}, {"READY": "1"}]
