"""Reading recordings: all values of a register, single frames, seeks and exports, compared with the mcap library.

The recording has three hours of the reference load at 50 Hz, in chunks of 0.85 s, as a recorder writes it. Before
anything is timed, all contenders must find the same values and frames.
"""

from __future__ import annotations

import math
import os
import random
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import mcap.reader
import numpy as np
from common import begin, db201, interleave, report, report_spread, table

import shmio
from shmio.cli.dump import main as shmio_dump
from shmio.recorder.file_output import Output
from shmio.recording.dump import Dump
from shmio.recording.writer import Writer
from shmio.segment import Block, Frame, Provenance, Quality

OURS = "shmio columns"
HZ = 50
CHUNK_FRAMES = 43
START_NS = 1_700_000_000_000_000_000
HEAD_BYTES = 68


def record(file: Path, seconds: int) -> str:
    """Write the recording, in which 20 REALs move as axes do, and return the path of one of them."""
    layout = db201()
    axes = [register for register in layout.registers if register.type == "REAL"]
    fd = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    output = Output(file, fd, limit_bytes=1 << 30)
    writer = Writer(output, {"instance": "bench", "epoch": "0" * 16, "started_utc_ns": str(START_NS)})
    writer.attach(f"layouts/{layout.hash.hex()}.json", "application/json", layout.to_json(), START_NS)
    block = SimpleNamespace(source="cell", section=1, layout=layout, period_ns=10**9 // HZ, stale_ns=10**9)
    channels = writer.open_block(cast("Block", block), 1, 0, 0)
    image = bytearray(layout.size)
    for number in range(1, seconds * HZ + 1):
        clock_ns = number * 10**9 // HZ
        for place, axis in enumerate(axes):
            struct.pack_into(">f", image, axis.offset, 90 * math.sin(clock_ns / 1e9 * (place + 1) / 20))
        frame = Frame(
            number, number, clock_ns, clock_ns, START_NS + clock_ns, 1, Quality.GOOD, Provenance.LIVE, 0, 300, "",
            bytes(image), None,
        )  # fmt: skip
        writer.frame(channels, frame, START_NS + clock_ns)
        if number % CHUNK_FRAMES == 0:
            writer.flush()
            output.flush()
    writer.finish()
    if not output.close(60):
        raise SystemExit(output.problem)
    return axes[0].path


# -- contenders --------------------------------------------------------------------------------------------------------


def columns(dump: Dump, path: str) -> np.ndarray[Any, Any]:
    """Read a register with shmio, chunk by chunk."""
    return dump.columns(f"cell/{path}")[path]


def frame_by_frame(dump: Dump, path: str) -> np.ndarray[Any, Any]:
    """Read a register with shmio, as a Python object for each frame."""
    offset = dump.blocks[0].register(path).offset
    unpack = struct.Struct(">f").unpack_from
    return np.array([unpack(entry.item.raw, offset)[0] for entry in dump.frames("cell")], np.float32)


def by_library(file: Path, offset: int) -> np.ndarray[Any, Any]:
    """Read a register with the mcap library in the file's order, as docs/reference/dump-format.md shows it."""
    unpack = struct.Struct(">f").unpack_from
    with file.open("rb") as stream:
        messages = mcap.reader.make_reader(stream).iter_messages(topics=["cell/frames"], log_time_order=False)
        return np.array([unpack(message.data, HEAD_BYTES + offset)[0] for _, _, message in messages], np.float32)


@contextmanager
def library_reader(file: Path) -> Iterator[mcap.reader.McapReader]:
    """Open the recording with the mcap library, and read its summary."""
    with file.open("rb") as stream:
        reader = mcap.reader.make_reader(stream)
        reader.get_summary()
        yield reader


def seek_by_library(reader: mcap.reader.McapReader, time_ns: int) -> int:
    """Let the mcap library find the first frame at or after a time; return its log time in ns."""
    return int(next(iter(reader.iter_messages(topics=["cell/frames"], starting_at=time_ns)))[2].log_time)


def timed(function: Callable[[], object]) -> float:
    """Return the duration of one call in s."""
    begun_s = time.perf_counter()
    function()
    return time.perf_counter() - begun_s


# -- what is measured --------------------------------------------------------------------------------------------------


def scans(file: Path, path: str, rounds: int) -> None:
    """Print how many frames a second each contender reads, including the time to open the file."""

    def with_dump(read: Callable[[Dump, str], np.ndarray[Any, Any]]) -> np.ndarray[Any, Any]:
        with shmio.open_dump(file) as dump:
            return read(dump, path)

    with shmio.open_dump(file) as dump:
        offset = dump.blocks[0].register(path).offset
    ways: dict[str, Callable[[], np.ndarray[Any, Any]]] = {
        OURS: lambda: with_dump(columns),
        "shmio, frame by frame": lambda: with_dump(frame_by_frame),
        "mcap library and struct": lambda: by_library(file, offset),
    }
    expected = ways[OURS]()
    assert all(np.array_equal(way(), expected) for way in ways.values())
    samples = {name: (lambda way=way: len(expected) / timed(way)) for name, way in ways.items()}
    title = f"scan of one register, {len(expected)} frames"
    report(title, "frames/s", interleave(samples, rounds), OURS, "more", "mcap library and struct")


def seeks(file: Path, count: int) -> None:
    """Print the time in ms to open the file, and to find the first frame after a random time."""
    chance = random.Random(1)
    with shmio.open_dump(file) as dump, library_reader(file) as reader:
        times = [chance.randrange(dump.begin_ns, dump.end_ns) for _ in range(count)]
        ours: list[float] = []
        others: list[float] = []
        for time_ns in times:
            begun_s = time.perf_counter()
            found = next(dump.frames("cell", time_ns)).time_ns
            ours.append((time.perf_counter() - begun_s) * 1e3)
            begun_s = time.perf_counter()
            other = seek_by_library(reader, time_ns)
            others.append((time.perf_counter() - begun_s) * 1e3)
            assert found == other >= time_ns
    report_spread("seek", "ms", {"shmio": ours, "mcap library, its summary read": others}, "shmio", digits=2)

    def opened() -> None:
        with shmio.open_dump(file):
            pass

    def opened_by_library() -> None:
        with library_reader(file):
            pass

    opening: dict[str, Callable[[], float]] = {
        "shmio": lambda: timed(opened) * 1e3,
        "mcap library, get_summary": lambda: timed(opened_by_library) * 1e3,
    }
    report_spread("opening", "ms", interleave(opening, max(3, count // 40)), "shmio", digits=1)


def exports(file: Path, folder: Path, frames: int) -> None:
    """Print how long exports of all 22 registers of each frame take."""
    rows = []
    for form in ("parquet", "csv", "mcap"):
        out = folder / f"out.{form}"
        command = ["export", str(file), "-o", str(out), "--format", form]
        with redirect_stdout(StringIO()):
            taken_s = timed(partial(shmio_dump, command))
        written = out if out.is_file() else next(out.iterdir())
        rows.append([form, f"{frames / taken_s:.0f}", f"{written.stat().st_size / 1e6:.1f}"])
    table(["export", "frames/s", "MB"], rows)


def main() -> None:
    quick = begin("Reading recordings")
    seconds = 60 if quick else 3 * 3600
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / "three-hours.mem"
        path = record(file, seconds)
        print(f"{seconds} s at {HZ} Hz, {file.stat().st_size / 1e6:.1f} MB")
        scans(file, path, 1 if quick else 3)
        seeks(file, 20 if quick else 200)
        few = file
        if not quick:  # a tenth of it tells as much
            few = folder / "some.mem"
            record(few, seconds // 10)
        exports(few, folder, (seconds if quick else seconds // 10) * HZ)


if __name__ == "__main__":
    main()
