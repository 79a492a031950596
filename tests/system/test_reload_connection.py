"""Reloads that change only the registers of a source: its process and its connection stay."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import shmio
from shmio.emulators.proxy import FaultProxy
from shmio.segment import Quality, Segment
from shmio.testing.cell import Cell, kill, until
from tests.unit.connectors.modbus.device import Device

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "pumps"
connector = "modbus"
layout = "pump.toml"
period_ms = 20
timeout = TIMEOUT
stale_ms = STALE
host = "127.0.0.1"
port = PORT
[grpc]
listen = ["{grpc}"]
"""
SPEED = '"Speed" = { type = "UINT", address = "holding 100", writable = true }'
LEVEL = '"Level" = { type = "UINT", address = "holding 101" }'
SAME = "pumps: changed, and keeps its connection"


class Plant:
    """An instance with a source that reads a device through a proxy, which counts the connections."""

    def __init__(self, cell: Cell, device: Device, proxy: FaultProxy) -> None:
        self.cell, self.device, self.proxy = cell, device, proxy

    def table(self, *rows: str) -> None:
        (self.cell.folder / "pump.toml").write_text("\n".join(["[registers]", *rows]))

    def reload(self, *options: str) -> list[str]:
        done = self.cell.supervisor("reload", *options)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout.splitlines()

    @property
    def pid(self) -> int:
        return int(self.cell.processes()["pumps"]["pid"])

    def good(self) -> None:
        until(lambda: self.cell.processes()["pumps"]["quality"] == "good", "good quality")

    def value(self, path: str) -> object:
        with shmio.attach(self.cell.instance) as reader:
            until(lambda: reader.read(path).quality is Quality.GOOD, f"{path} is good")
            return reader.read(path).value


@pytest.fixture
def plant(make_cell: Callable[..., Cell], request: pytest.FixtureRequest) -> Iterator[Plant]:
    """The instance. A parameter is the time-out and stale_ms of its source, in ms."""
    patience_ms = getattr(request, "param", 500)
    with Device() as device, FaultProxy(device.address, framing=None) as proxy:
        device.set("holding", 100, [125, 7])
        config = CONFIG.replace("TIMEOUT", str(patience_ms)).replace("STALE", str(patience_ms))
        plant = Plant(make_cell(config=config.replace("PORT", str(proxy.address.port))), device, proxy)
        plant.table(SPEED)
        plant.cell.up()
        plant.good()
        yield plant


def test_registers_come_and_go_over_the_same_connection(plant: Plant) -> None:
    pid = plant.pid
    with shmio.attach(plant.cell.instance) as reader:
        held = reader.block("pumps")
        plant.table(LEVEL, SPEED)
        assert (
            plant.reload("--dry-run")[0]
            == "would keep the connection of pumps: registers: 1 added (Level), 1 moved (Speed)"
        )
        assert reader.block("pumps") is held
        assert plant.reload()[0] == SAME
        assert held.retired
    assert (plant.value("pumps/Level"), plant.value("pumps/Speed")) == (7, 125)
    plant.cell.output("shmio", "set", "Speed", "99")
    assert plant.device.get("holding", 100) == [99]
    for rows in ((SPEED,), (LEVEL,)):  # two in a row, of which the first removes a register
        plant.table(*rows)
        assert plant.reload()[0] == SAME
    assert plant.value("pumps/Level") == 7
    file = plant.cell.folder / "supervisor.toml"
    file.write_text(file.read_text().replace("period_ms = 20", "period_ms = 40\nmax_gap = 1"))
    assert plant.reload()[0] == SAME
    file.write_text(file.read_text().replace("max_gap = 1", "max_gap = 2"))  # the block stays the same
    assert plant.reload()[0] == SAME
    assert plant.value("pumps/Level") == 7
    assert (plant.pid, plant.proxy.accepted) == (pid, 1)
    file.write_text(file.read_text().replace("timeout = 500", "timeout = 600"))
    assert plant.reload("--dry-run")[0] == "would restart pumps: options.timeout: 600 instead of 500"
    assert plant.reload()[0] == "pumps: restarted, because its configuration has changed"
    plant.good()
    assert plant.pid != pid


def test_a_process_that_does_not_answer_is_restarted(plant: Plant) -> None:
    pid = plant.pid
    os.kill(pid, signal.SIGSTOP)
    plant.table(LEVEL)
    done = plant.cell.supervisor("reload")
    assert "pumps: restarted" in done.stdout
    assert plant.value("pumps/Level") == 7
    assert plant.pid != pid


@pytest.fixture
def stopped(plant: Plant) -> Iterator[threading.Thread]:
    """Stop the source's process, and begin a reload in a thread, which waits for the process."""
    pid = plant.pid
    os.kill(pid, signal.SIGSTOP)
    plant.table(LEVEL)
    asking = threading.Thread(target=plant.cell.supervisor, args=("reload",))
    asking.start()
    until(lambda: b'"revision"' in Path(f"/proc/{pid}/fd/0").read_bytes(), "the new description is there")
    yield asking
    asking.join()


def test_a_process_killed_during_the_reload_starts_with_the_new_registers(
    plant: Plant, stopped: threading.Thread
) -> None:
    pid = plant.pid
    kill(pid)
    stopped.join()
    assert plant.value("pumps/Level") == 7
    assert plant.pid != pid


@pytest.mark.parametrize("plant", [60_000], indirect=True)  # it may be stopped while it waits for an answer
def test_a_source_continues_as_before_if_the_supervisor_dies_during_the_reload(
    plant: Plant, stopped: threading.Thread
) -> None:
    pid = plant.pid
    with Segment.open(plant.cell.instance) as segment:
        kill(segment.supervisor[0])
    os.kill(pid, signal.SIGCONT)
    stopped.join()
    plant.device.set("holding", 100, [126])
    until(lambda: plant.value("pumps/Speed") == 126, "the source reads on")
    assert (plant.pid, plant.proxy.accepted) == (pid, 1)
    plant.cell.up()  # takes over, and begins with the new file
    assert plant.value("pumps/Level") == 7


def test_a_device_that_is_away_does_not_delay_the_reload(plant: Plant) -> None:
    pid = plant.pid
    plant.proxy.refuse()
    until(lambda: plant.cell.processes()["pumps"]["quality"] == "bad", "bad quality")
    plant.table(LEVEL)
    assert "not connected now: " in plant.reload("--dry-run")[0]
    assert plant.reload()[0].startswith("pumps: changed, but not connected: ")
    plant.proxy.admit()
    assert plant.value("pumps/Level") == 7
    assert plant.pid == pid


def test_a_connection_that_cannot_be_kept_is_reported(plant: Plant) -> None:
    """The device accepts connections, but does not answer."""
    pid = plant.pid
    plant.proxy.freeze()
    plant.table(LEVEL)
    assert plant.reload()[0].startswith("pumps: changed, and connected again: ")
    plant.proxy.thaw()
    assert plant.value("pumps/Level") == 7
    assert plant.pid == pid


def test_a_process_that_was_taken_over_keeps_its_connection(plant: Plant) -> None:
    pid = plant.pid
    with Segment.open(plant.cell.instance) as segment:
        kill(segment.supervisor[0])
    plant.cell.up()
    plant.table(LEVEL)
    assert plant.reload()[0] == SAME
    assert plant.value("pumps/Level") == 7
    assert (plant.pid, plant.proxy.accepted) == (pid, 1)
