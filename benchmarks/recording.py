"""Recording: the size of a minute, and its CPU cost.

Sizes are of a minute at 50 Hz, in the chunks of a recorder. There are three kinds of data: the emulated A50 cell,
whose axes move by sines; the same with noise on all 20 REALs, as analog inputs have it; and the cell at rest. They
are compared with the same frames without compression, and with a file of the mcap library by its defaults. For the
data with noise, a second table has the size of the chunks under other layouts of frames. CPU is that of a recorder's
process beside a source that publishes on schedule.
"""

from __future__ import annotations

import json
import os
import random
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, cast

import mcap.writer
import zstandard
from common import CpuTime, begin, db201, keep, table

from shmio.emulators.programs import A50
from shmio.layout.model import Layout
from shmio.recorder.file_output import Output, create
from shmio.recorder.recorder import CHUNK_S
from shmio.recording.format import _frames
from shmio.recording.format.encoding import FRAME, encode_frame
from shmio.recording.writer import Writer
from shmio.segment import Block, BlockSpec, BlockWriter, Frame, ProcessSpec, Provenance, Quality, Segment
from shmio.segment.processes import Activity

HZ = 50
START_NS = 1_700_000_000_000_000_000
JITTER_NS = 60_000
SEED_MB = 7.0
"""Size in MB of a minute in the dumps of the program that shmio replaces."""
LEVELS = (1, 3, 9, 19)
"""Compression levels of zstd. The recorder uses 3."""

Image = Callable[[int], bytes]
"""Returns the block at a cycle."""


# -- data --------------------------------------------------------------------------------------------------------------


def cell(layout: Layout, *, noise: float = 0.0, moving: bool = True) -> Image:
    """Return the images of the A50 cell. ``noise`` is the standard deviation of the noise added to each REAL."""
    program, chance = A50(layout), random.Random(1)
    image = bytearray(layout.size)
    axes = [register.offset for register in layout.registers if register.type == "REAL"]

    def at(cycle: int) -> bytes:
        program.step(cycle / HZ if moving else 0.0, image)
        for offset in axes if noise else ():
            (value,) = struct.unpack_from(">f", image, offset)
            struct.pack_into(">f", image, offset, value + chance.gauss(0, noise))
        return bytes(image)

    return at


def frames(image: Image, count: int) -> Iterator[Frame]:
    """Yield frames as a source publishes them: each a little late."""
    chance = random.Random(2)
    for cycle in range(1, count + 1):
        clock_ns = cycle * 10**9 // HZ + int(chance.expovariate(1 / JITTER_NS))
        yield Frame(
            cycle, cycle, 10**12 + clock_ns, clock_ns, START_NS + clock_ns - 400_000, 1, Quality.GOOD, Provenance.LIVE,
            0, 380 + chance.randrange(60), "", image(cycle), None,
        )  # fmt: skip


# -- sizes -------------------------------------------------------------------------------------------------------------


class _Block:
    """The attributes of a block that a writer of recordings needs."""

    source, section, period_ns, stale_ns = "cell", 1, 10**9 // HZ, 10**9

    def __init__(self, layout: Layout) -> None:
        self.layout = layout


def ours(folder: Path, layout: Layout, some: Sequence[Frame]) -> int:
    """Return the size in bytes of the file that a recorder writes, with index and layout."""
    path, fd = create(folder, "bench")
    output = Output(path, fd, limit_bytes=1 << 30)
    writer = Writer(output, {"instance": "bench"})
    writer.attach(f"layouts/{layout.hash.hex()}.json", "application/json", layout.to_json(), START_NS)
    channels = writer.open_block(cast("Block", _Block(layout)), 1, 0, 0)
    for frame in some:
        writer.frame(channels, frame, START_NS + frame.clock_ns)
        if frame.number % round(CHUNK_S * HZ) == 0:
            writer.flush()
    writer.finish()
    if not output.close(60):
        raise SystemExit(output.problem)
    return path.stat().st_size


def library(folder: Path, some: Sequence[Frame], **options: object) -> int:
    """Return the size in bytes of the file that the mcap library writes by its defaults: zstd, chunks of 1 MiB."""
    file = folder / "library.mcap"
    with file.open("wb") as stream:
        writer = mcap.writer.Writer(cast("IO[bytes]", stream), **options)  # type: ignore[arg-type]
        writer.start()
        channel = writer.register_channel("cell/frames", FRAME, writer.register_schema(FRAME, "", b""))
        for frame in some:
            log_ns = START_NS + frame.clock_ns
            writer.add_message(channel, log_ns, encode_frame(frame), log_ns)
        writer.finish()
    return file.stat().st_size


def sizes(minutes: int) -> None:
    """Print the MB of one minute of recording."""
    layout = db201()
    data = {
        "emulated cell": cell(layout),
        "with noise": cell(layout, noise=0.01),
        "at rest": cell(layout, moving=False),
    }
    rows = []
    for name, image in data.items():
        some = list(frames(image, minutes * 60 * HZ))
        with tempfile.TemporaryDirectory() as folder:
            contenders = [
                sum(len(encode_frame(frame)) for frame in some),
                library(Path(folder), some),
                ours(Path(folder), layout, some),
            ]
        keep(f"{name}, {HZ} Hz", contenders[-1] / minutes / 1e6, "MB/min", "less")
        rows.append([name, *(f"{size / minutes / 1e6:.3f}" for size in contenders), f"{SEED_MB:g}"])
    table([f"MB a minute at {HZ} Hz", "raw frames", "mcap defaults", "shmio", "the seed"], rows)


# -- other ways to lay out a chunk -------------------------------------------------------------------------------------


def packed(messages: Sequence[bytes], pack: Callable[[bytes], bytes], *, turned: bool = False) -> int:
    """Return the compressed size of the messages' chunks in bytes.

    ``turned``: a chunk has the first bytes of all messages, then all second bytes, and so on.
    """
    each, size = round(CHUNK_S * HZ), 0
    for at in range(0, len(messages), each):
        some = messages[at : at + each]
        size += len(pack(b"".join(map(bytes, zip(*some, strict=True)) if turned else some)))
    return size


def layouts() -> None:
    """Print the MB a minute of the chunks' data alone, with noise. The rest of the file is the same for all layouts."""
    layout = db201()
    some = list(frames(cell(layout, noise=0.01), 60 * HZ))
    low = [register.offset + byte for byte in (3, 2, 1, 0) for register in layout.registers if register.type == "REAL"]
    order = low + sorted(set(range(layout.size)) - set(low))

    def message(frame: Frame, *, once: bool = True, sort: bool = False) -> bytes:
        """Return a frame's record.

        ``once``: times are differences to the record's header, as the recorder writes them. ``sort``: the bytes of
        all REALs come first, the least significant bytes before the others.
        """
        header = frame.number & 0xFFFFFFFF, START_NS + frame.clock_ns, frame.source_ns
        frame = frame._replace(raw=bytes(map(frame.raw.__getitem__, order))) if sort else frame
        if once:
            parts: list[bytes] = []
            _frames.add(parts, [], 1, [(START_NS + frame.clock_ns, frame)], 0, 0, 0)
            return b"".join(parts)
        data = encode_frame(frame)
        return struct.pack("<BQHIQQ", 5, 22 + len(data), 1, *header) + data

    plain = [message(frame) for frame in some]
    default = zstandard.ZstdCompressor().compress
    rows = [(f"as it is, zstd {level}", packed(plain, zstandard.ZstdCompressor(level).compress)) for level in LEVELS]
    rows += [
        ("times whole, as of shmio.frame.v1", packed([message(frame, once=False) for frame in some], default)),
        ("bytes of the REALs side by side", packed([message(frame, sort=True) for frame in some], default)),
        ("byte columns: no messages of MCAP", packed(plain, default, turned=True)),
    ]
    table([f"MB a minute at {HZ} Hz, chunks alone", ""], [[name, f"{size / 1e6:.3f}"] for name, size in rows])


# -- CPU ---------------------------------------------------------------------------------------------------------------


@contextmanager
def recorder(segment: Segment, folder: Path) -> Iterator[int]:
    """Start a recorder's process, and return its pid."""
    description = {
        "instance": segment.instance,
        "epoch": segment.header.epoch,
        "name": "recorder",
        "kind": "recorder",
        "log_file": str(folder / "recorder.log"),
        "config": {"directory": str(folder / "dumps"), "config_file": str(folder / "supervisor.toml")},
    }
    process = subprocess.Popen([sys.executable, "-m", "shmio.recorder"], stdin=subprocess.PIPE, text=True)
    try:
        assert process.stdin is not None
        process.stdin.write(json.dumps(description))
        process.stdin.close()
        report = segment.processes.find("recorder")
        while report.report.pid != process.pid or report.report.activity is not Activity.RUNNING:
            time.sleep(0.05)
        time.sleep(1)
        yield process.pid
    finally:
        process.terminate()
        process.wait()


def publish(writer: BlockWriter, image: Image, hertz: int, duration_s: float) -> None:
    """Publish frames on schedule for a duration."""
    images = [image(cycle) for cycle in range(HZ * 4)]
    begun_s = time.monotonic()
    for cycle in range(round(duration_s * hertz)):
        time.sleep(max(0.0, begun_s + cycle / hertz - time.monotonic()))
        writer.publish(images[cycle % len(images)], cycle=cycle, source_ns=time.time_ns())


def cpu(duration_s: float) -> None:
    """Print the percentage of a core that a recorder uses."""
    layout = db201()
    rows = []
    for hertz in (50, 1000):
        blocks = [BlockSpec("cell", layout, 10**9 // hertz, 10**9, 64 << 20)]
        processes = [ProcessSpec("cell", "source"), ProcessSpec("recorder", "recorder")]
        with (
            tempfile.TemporaryDirectory() as folder,
            Segment.create(f"bench-{os.getpid()}-{hertz}", blocks, processes) as segment,
        ):
            try:
                with recorder(segment, Path(folder)) as pid:
                    writer = segment.writer("cell")
                    before, begun_s = CpuTime.of(pid), time.monotonic()
                    publish(writer, cell(layout, noise=0.01), hertz, duration_s)
                    used, taken_s = CpuTime.of(pid).since(before), time.monotonic() - begun_s
                    counters = segment.processes.find("recorder").counters
                parts = [used.user_s, used.system_s, used.user_s + used.system_s]
                rows.append(
                    [f"{hertz} Hz", *(f"{100 * part / taken_s:.2f}" for part in parts), str(counters["missed"])]
                )
            finally:
                segment.unlink()
    table(["recorder, % of a core", "user", "system", "sum", "missed"], rows)


def main() -> None:
    quick = begin("Recording: a minute's size, and CPU")
    sizes(1 if quick else 10)
    layouts()
    cpu(2.0 if quick else 30.0)


if __name__ == "__main__":
    main()
