"""A replay: how far from its due time each frame arrives, and the frames a second of a replay without waits.

The recording is made for the purpose: DB201, whose 20 REALs move with every frame. *Arrival* is the difference
between the recorded time, at speed 1, and the time at which a waiting reader of the shared memory has the frame. For
the rate, a client makes steps of a second one after the other, and a reader takes every frame.
"""

from __future__ import annotations

import os
import struct
import tempfile
import threading
import time
from pathlib import Path

from common import begin, db201, keep, quantiles, table

from shmio.config import Address
from shmio.local.attach import attach
from shmio.recorder.file_output import Output, create
from shmio.recorder.instance_follower import FROM_THE_FIRST, InstanceFollower
from shmio.recorder.recorder import Recorder
from shmio.segment import BlockSpec, Origin, Quality, Segment, Stamp
from shmio.testing.cell import Cell

CONFIG = '[instance]\nname = "{name}"\nclock = "{clock}"\n'
FIRST_NS = 5_000_000_000
"""The instance time of the first frame."""
SETTLE_NS = 1_000_000_000
"""Time at the beginning that does not count, because the processes are just starting."""
PATIENCE_S = 60.0


def record(folder: Path, period_ns: int, frames: int) -> Path:
    """Make a recording of so many frames at exact intervals."""
    layout = db201()
    places = [register.offset for register in layout.registers if register.type == "REAL"]
    image = bytearray(layout.size)
    spec = BlockSpec("cell", layout, period_ns, 500_000_000, 16 << 20)
    with Segment.create(f"bench-{os.getpid()}-recorded", [spec], [], origin=Origin(0, time.time_ns())) as segment:
        try:
            path, fd = create(folder, "bench")
            recorder = Recorder(
                InstanceFollower(segment, FROM_THE_FIRST), Output(path, fd, limit_bytes=1 << 26), by="benchmark"
            )
            started_ns = segment.header.started_ns
            writer = segment.writer("cell", Stamp(started_ns + FIRST_NS, FIRST_NS))
            for number in range(frames):
                clock_ns = FIRST_NS + number * period_ns
                for at, place in enumerate(places):
                    struct.pack_into(">f", image, place, number * (at + 1) * 0.001)
                writer.publish(image, cycle=number, at=Stamp(started_ns + clock_ns, clock_ns))
                if number % 64 == 0:
                    recorder.run_once()
            recorder.close(PATIENCE_S)
        finally:
            segment.unlink()
    return path


def cell(folder: Path, clock: str) -> Cell:
    """Start an instance without sources."""
    name = f"bench-{os.getpid()}"
    (folder / "supervisor.toml").write_text(CONFIG.format(name=name, clock=clock))
    return Cell(folder, name, Address("127.0.0.1", 0))


def up(instance: Cell, file: Path) -> None:
    done = instance.supervisor("up", "--detach", "--mode", "replay", "--from", str(file))
    if done.returncode:
        raise SystemExit(done.stderr)


def arrivals_us(folder: Path, file: Path) -> list[float]:
    """Return how late each frame arrived at a reader, in µs."""
    instance = cell(folder, "wall")
    up(instance, file)
    late_us: list[float] = []
    try:
        with Segment.open(instance.instance) as segment:
            block, started_ns = segment.blocks["cell"], segment.header.started_ns
            cursor = block.cursor()
            while (frame := cursor.next(PATIENCE_S)) is not None and frame.quality is Quality.GOOD:
                now_ns = time.monotonic_ns()
                if frame.clock_ns > FIRST_NS + SETTLE_NS:
                    late_us.append((now_ns - started_ns - frame.clock_ns) / 1e3)
    finally:
        instance.down()
    return late_us


def frames_per_s(folder: Path, file: Path, seconds: int) -> tuple[float, int]:
    """Step a replay without waits. Return the frames a second, and how many frames a reader missed."""
    instance = cell(folder, "stepped")
    up(instance, file)
    taken = missed = 0
    try:
        with attach(instance.instance, writable=True) as attached:
            cursor = attached.block("cell").cursor()

            def read() -> None:
                nonlocal taken, missed
                while (frame := cursor.next(PATIENCE_S)) is not None and frame.quality is Quality.GOOD:
                    taken += 1
                missed = cursor.missed

            reader = threading.Thread(target=read)
            reader.start()
            begun_s = time.perf_counter()
            for _ in range(seconds + 1):
                attached.step(1.0)
            reader.join()
            passed_s = time.perf_counter() - begun_s
    finally:
        instance.down()
    return taken / passed_s, missed


def main() -> None:
    quick = begin("Replay: timing, and as fast as it goes")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for hz, seconds in ((50, 3 if quick else 60), (1000, 3 if quick else 30)):
            file = record(Path(folder), 1_000_000_000 // hz, hz * seconds)
            late_us = arrivals_us(Path(folder), file)
            keep(f"{hz} Hz: arrival after its time, median", quantiles(late_us)[0], "µs", "less")
            cuts = [f"{late:.0f}" for late in (*quantiles(late_us), max(late_us))]
            rows.append([f"{hz} Hz", f"{len(late_us)}", *cuts])
        table(["arrival after its time, us", "frames", "median", "p90", "p99", "most"], rows)
        seconds = 20 if quick else 600
        file = record(Path(folder), 20_000_000, 50 * seconds)
        rate, missed = frames_per_s(Path(folder), file, seconds)
        keep("50 Hz, as fast as it goes", rate, "frames/s", "more")
        titles = ["as fast as it goes", "frames/s", "times real time", "missed"]
        table(titles, [["50 Hz", f"{rate:.0f}", f"{rate / 50:.0f}", f"{missed}"]])


if __name__ == "__main__":
    main()
