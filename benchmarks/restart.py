"""Kills each process of a whole cell with SIGKILL, under load, and says how long it is gone.

python benchmarks/restart.py [--rounds N]

``running``: the successor has reported that it runs. ``serving``: its data flows again, seen from outside: a good frame
in the segment for source and emulator, a value by a new gRPC call for the endpoint.
"""

from __future__ import annotations

import argparse
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

from shmio.segment import Activity, Quality, Segment
from shmio.testing.cell import CONFIG, Cell, kill, until
from shmio.testing.ports import reserved_port
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub

ROOT = Path(__file__).parents[1]
AXIS = "cell/Robot_800/Axs1_Pos"
STABLE_S = 6.0  # a process that ran this long is restarted at once; sooner, it would wait its turn


def one_value(address: str) -> None:
    """A value by a new call on a new connection."""
    with grpc.insecure_channel(address, options=[("grpc.initial_reconnect_backoff_ms", 20)]) as channel:
        stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        stream = stub.Subscribe(TopicDescriptor(path=AXIS), timeout=20, wait_for_ready=True)
        next(stream)
        stream.cancel()


def measure(cell: Cell, segment: Segment, victim: str) -> tuple[float, float]:
    """Kill one; (s until it runs, s until its data flows)."""
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
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
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
    print(f"{'killed':8} {'running, s':>24} {'serving, s':>24}   (min, median, max of {rounds})")
    for victim, times in found.items():
        columns = [
            f"{min(column):.2f} {statistics.median(column):.2f} {max(column):.2f}"
            for column in zip(*times, strict=True)
        ]
        print(f"{victim:8} {columns[0]:>24} {columns[1]:>24}")


if __name__ == "__main__":
    main()
