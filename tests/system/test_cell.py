"""The A50 cell as a user has it: started, watched, its processes killed one by one, stopped."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import grpc
import pytest

import shmio
from shmio.segment import Quality, instances
from shmio.testing.cell import BIN, PATIENCE_S, Cell, kill, until
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub

ROOT = Path(__file__).parents[2]
AXIS = "cell/Robot_800/Axs1_Pos"


def five_values(address: str) -> list[float]:
    with grpc.insecure_channel(address) as channel:
        stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        stream = stub.Subscribe(TopicDescriptor(path=AXIS), timeout=PATIENCE_S, wait_for_ready=True)
        values = [float(next(stream).value) for _ in range(5)]
        stream.cancel()
    return values


def test_ctrl_c_leaves_nothing(make_cell: Callable[[], Cell]) -> None:
    cell = make_cell()
    pipe = subprocess.PIPE
    with subprocess.Popen([BIN / "shmio-supervisor", "up"], cwd=cell.folder, stdout=pipe, stderr=pipe, text=True) as up:
        five_values(str(cell.grpc))
        pids = [process["pid"] for process in cell.status()["processes"]]
        up.send_signal(signal.SIGINT)
        _, errors = up.communicate(timeout=PATIENCE_S)
    assert (up.returncode, "Traceback" in errors) == (0, False)
    assert cell.instance not in instances()
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((cell.grpc.host, cell.grpc.port))
    after = cell.supervisor("status", "--json")
    assert (after.returncode, json.loads(after.stdout)["state"]) == (1, "stopped")


@pytest.fixture(scope="module")
def shared_cell(make_shared_cell: Callable[..., Cell]) -> Cell:
    cell = make_shared_cell()
    cell.up()
    return cell


@pytest.fixture
def cell(shared_cell: Cell) -> Cell:
    """Return the running cell, with good values. Each test leaves it so."""
    five_values(str(shared_cell.grpc))
    until(lambda: shared_cell.processes()["cell"]["quality"] == "good", "good quality")
    return shared_cell


class Load:
    """Readers under load: one follows every frame, others poll, and two subscribe by gRPC."""

    def __init__(self, cell: Cell) -> None:
        self._stopping = threading.Event()
        self.cycles: list[tuple[int, int, int]] = []  # number, cycle, incarnation
        self.missed = 0
        self._attached = shmio.attach(cell.instance)
        self._block = self._attached.block("cell")
        self._threads = [threading.Thread(target=self._stream)] + [
            threading.Thread(target=self._latest) for _ in range(2)
        ]
        self._clients = [
            subprocess.Popen(
                [sys.executable, ROOT / "examples/subscribe.py", str(cell.grpc), AXIS], stdout=subprocess.DEVNULL
            )
            for _ in range(2)
        ]
        for thread in self._threads:
            thread.start()

    def _stream(self) -> None:
        cursor = self._block.cursor()
        while not self._stopping.is_set():
            frame = cursor.next(timeout_s=0.1)
            if frame is not None:
                self.cycles.append((frame.number, frame.cycle, frame.incarnation))
        self.missed = cursor.missed

    def _latest(self) -> None:
        while not self._stopping.wait(0.001):
            self._block.latest()

    @property
    def newest(self) -> int:
        return self.cycles[-1][0] if self.cycles else 0

    def good(self) -> bool:
        frame = self._block.latest()
        return frame is not None and self._block.assess(frame)[0] is Quality.GOOD

    def stop(self) -> None:
        self._stopping.set()
        for thread in self._threads:
            thread.join()
        for client in self._clients:
            client.terminate()
            client.wait()
        del self._block
        self._attached.close()


@pytest.mark.parametrize("victim", ["plc", "cell", "grpc"])
def test_a_killed_process_is_restarted_and_no_other(
    cell: Cell, victim: str, record_property: Callable[[str, object], None]
) -> None:
    before = cell.processes()  # before the load starts, as overruns that it causes count from here
    load = Load(cell)
    try:
        until(lambda: load.newest > 0, "frames")
        killed_s = time.monotonic()
        kill(before[victim]["pid"])
        until(
            lambda: (now := cell.processes()[victim])["state"] == "running" and now["pid"] != before[victim]["pid"],
            f"{victim} running again",
        )
        five_values(str(cell.grpc))
        until(load.good, "good quality again")
        record_property("back_s", round(time.monotonic() - killed_s, 2))
        reached = load.newest
        until(lambda: load.newest > reached + 10, "more frames")
    finally:
        load.stop()
    after = cell.processes()
    for name in before:
        assert after[name]["restarts"] - before[name]["restarts"] == (1 if name == victim else 0), cell.logs()
        assert (after[name]["pid"] == before[name]["pid"]) == (name != victim)
    numbers = [number for number, _, _ in load.cycles]
    assert numbers == list(range(numbers[0], numbers[-1] + 1))
    assert load.missed == 0
    first = load.cycles[0][2]
    assert {incarnation for _, _, incarnation in load.cycles} == ({first, first + 1} if victim == "cell" else {first})
    if victim == "grpc":  # no other process may lose a cycle
        cycles = [cycle for _, cycle, _ in load.cycles]
        lost = cycles[-1] - cycles[0] + 1 - len(cycles)
        until(
            lambda: cell.processes()["cell"]["overruns"] - before["cell"]["overruns"] >= lost,
            "the reason in the next report",
        )


def test_a_frozen_process_is_replaced(cell: Cell) -> None:
    before = cell.processes()["grpc"]
    os.kill(before["pid"], signal.SIGSTOP)
    until(lambda: cell.processes()["grpc"]["pid"] not in (before["pid"], None), "another process")
    assert len(five_values(str(cell.grpc))) == 5


def test_an_unplugged_plc_turns_values_bad_until_it_is_back(cell: Cell) -> None:
    restarts = cell.processes()["cell"]["restarts"]
    with shmio.attach(cell.instance) as attached:
        plc = cell.processes()["plc"]["pid"]
        os.kill(plc, signal.SIGSTOP)
        until(lambda: attached.read(AXIS).quality is Quality.BAD, "bad quality")  # by its age
        until(lambda: "no answer" in attached.read(AXIS).reason, "the reason")  # after the time-out
        assert cell.status()["state"] == "degraded"
        os.kill(plc, signal.SIGCONT)
        until(lambda: attached.read(AXIS).quality is Quality.GOOD, "good quality")
        assert cell.processes()["cell"]["restarts"] == restarts


def test_a_mistake_in_the_config_is_one_clear_line(make_cell: Callable[[], Cell]) -> None:
    cell = make_cell()
    file = cell.folder / "supervisor.toml"
    file.write_text(file.read_text().replace("period_ms", "perid_ms", 1))
    for verb in ("check", "up"):
        done = cell.supervisor(verb)
        assert done.returncode == 1
        assert "source[0].perid_ms" in done.stderr
        assert "Traceback" not in done.stderr
        assert done.stderr.count("\n") == 1
    assert cell.instance not in instances()
