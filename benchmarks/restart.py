"""Kills each process of a whole cell with SIGKILL, under load, and measures the time until its service is back.

``running``: until the successor has reported that it runs. ``serving``: until its data flows again, as seen from
outside. For source and emulator, that is a good frame in the segment; for the endpoint, a value by a new gRPC call.
"""

from __future__ import annotations

import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack
from pathlib import Path

import grpc
from common import begin, keep, table

from shmio.segment import Activity, Quality, Segment
from shmio.testing.cell import CONFIG, Cell, kill, until
from shmio.testing.ports import reserved_port
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub

ROOT = Path(__file__).parents[1]
AXIS = "cell/Robot_800/Axs1_Pos"
ROUNDS = 5
FIGURES = (min, statistics.median, max)
STABLE_S = 6.0  # a process that ran this long is restarted at once; sooner, it would wait its turn


def one_value(address: str) -> None:
    """Wait for a value by a new call on a new connection."""
    with grpc.insecure_channel(address, options=[("grpc.initial_reconnect_backoff_ms", 20)]) as channel:
        stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        stream = stub.Subscribe(TopicDescriptor(path=AXIS), timeout=20, wait_for_ready=True)
        next(stream)
        stream.cancel()


def measure(cell: Cell, segment: Segment, victim: str) -> tuple[float, float]:
    """Kill one process. Return the s until its successor runs, and until its data flows."""
    block, slot = segment.blocks["cell"], segment.processes.find(victim)
    pid = slot.report.pid
    killed_s, killed_ns = time.monotonic(), time.monotonic_ns()
    kill(pid, signal.SIGKILL)
    until(lambda: slot.report.pid != pid and slot.report.activity is Activity.RUNNING, f"{victim} running")
    running_s = time.monotonic() - killed_s
    if victim == "grpc":
        one_value(str(cell.grpc))
    else:

        def fresh() -> bool:
            frame = block.latest()
            return frame is not None and frame.quality is Quality.GOOD and frame.publish_ns > killed_ns

        until(fresh, "a good frame")
    return running_s, time.monotonic() - killed_s


def main() -> None:
    rounds = 1 if begin("Restart: how long a killed process is gone") else ROUNDS
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        plc, address = (stack.enter_context(reserved_port()) for _ in range(2))
        shutil.copy(ROOT / "db201.db", folder)
        (folder / "supervisor.toml").write_text(CONFIG.format(instance="restart", period_ms=20, plc=plc, grpc=address))
        cell = Cell(folder, "restart", address)
        cell.up()
        stack.callback(cell.down)
        for _ in range(2):  # the load; ends with the endpoint's first death
            client = [sys.executable, str(ROOT / "examples/subscribe.py"), str(address), AXIS]
            quiet = subprocess.DEVNULL
            load = stack.enter_context(subprocess.Popen(client, stdout=quiet, stderr=quiet))
            stack.callback(load.kill)
        segment = stack.enter_context(Segment.open("restart"))
        found: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for _ in range(rounds):
            for victim in ("plc", "cell", "grpc"):
                time.sleep(STABLE_S)
                found[victim].append(measure(cell, segment, victim))
    for victim, times in found.items():
        keep(f"{victim} serves again", statistics.median(serving_s for _, serving_s in times), "s", "less")
    rows = [
        [victim, *(f"{figure(column):.2f}" for column in zip(*times, strict=True) for figure in FIGURES)]
        for victim, times in found.items()
    ]
    table(["killed", "running, s: best", "median", "worst", "serving, s: best", "median", "worst"], rows)


if __name__ == "__main__":
    main()
