"""How long a write to the controller takes until it is confirmed and until a frame shows it, and where the time goes.

A program attaches to a running instance and calls ``write``. The source records the times of acceptance, outcome and
frame in the segment. For comparison, two clients without an instance write to the same controller and read the block
back: python-snap7, and shmio's own S7 client. They take turns while the source continues to poll. Program,
supervisor, source, controller and link are separate processes.
"""

from __future__ import annotations

import random
import struct
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack

import snap7
from common import HERE, Child, begin, quantiles, report_spread, table
from instance import Polled, started
from plc import NUMBER, SIZE

from shmio import attach
from shmio.config.address import Address
from shmio.connectors.s7 import S7Client, S7Options
from shmio.local.attach import Attachment
from shmio.segment import EventKind, Write

PATH = "cell/Stamp"
OURS = "shmio"
STAGES = ("submit to accepted", "accepted to written", "written to frame")
_VALUE = struct.Struct(">q")

Times = dict[str, list[float]]


class Writer:
    """A program that writes through the instance."""

    def __init__(self, cell: Attachment) -> None:
        self._cell = cell
        self._block = cell.block("cell")
        self.stages: Times = defaultdict(list)

    def write(self, value: int) -> tuple[float, float]:
        """Write, and wait for a frame that shows the value. Return the ms until confirmation and until that frame."""
        frames, events = self._block.cursor(), self._block.events.cursor()
        begun_ns = time.monotonic_ns()
        outcome = self._cell.write({PATH: value})[0]
        taken_ms = (time.monotonic_ns() - begun_ns) / 1e6
        if not outcome.done:
            raise SystemExit(f"the write failed: {outcome.kind}: {outcome.text}")
        told_ns = {}
        while (event := events.poll()) is not None:
            told_ns[event.kind] = event.publish_ns
        for frame in frames:
            if frame.image.startswith(_VALUE.pack(value)):
                break
        marks_ns = begun_ns, told_ns[EventKind.ACCEPTED], told_ns[EventKind.WRITTEN], frame.publish_ns
        for name, before_ns, after_ns in zip(STAGES, marks_ns, marks_ns[1:], strict=False):
            self.stages[name].append((after_ns - before_ns) / 1e6)
        return taken_ms, (frame.publish_ns - begun_ns) / 1e6


def bare(
    write: Callable[[bytes], object], read: Callable[[], bytes | bytearray]
) -> Callable[[int], tuple[float, float]]:
    """Make a function that writes by a client without an instance.

    It returns the ms until confirmation and read-back.
    """

    def sample(value: int) -> tuple[float, float]:
        data = _VALUE.pack(value)
        begun_ns = time.monotonic_ns()
        write(data)
        written_ns = time.monotonic_ns()
        if not read().startswith(data):
            raise SystemExit("the block that was read back differs from the block that was written")
        return (written_ns - begun_ns) / 1e6, (time.monotonic_ns() - begun_ns) / 1e6

    return sample


def measure(period_ms: float, round_trip_ms: float, count: int) -> None:
    """Print three tables for one poll period and one link."""
    with ExitStack() as stack:
        plc = stack.enter_context(Child("plc.py"))
        if round_trip_ms:
            plc = stack.enter_context(Child("link.py", plc.hello, round_trip_ms))
        address = Address.parse(plc.hello)
        source = Polled("cell", address, period_ms, HERE / "stamped.db", ["Stamp"])
        running = stack.enter_context(started([source]))
        writer = Writer(stack.enter_context(attach(running.segment.instance, writable=True)))
        ours = S7Client(S7Options(host=address.host, port=address.port), NUMBER, SIZE)
        ours.connect()
        stack.callback(ours.close)
        peer = snap7.Client()
        peer.connect(address.host, 0, 1, address.port)
        stack.callback(peer.disconnect)
        contenders = {
            OURS: writer.write,
            "python-snap7, without an instance": bare(
                lambda data: peer.db_write(NUMBER, 0, bytearray(data)), lambda: peer.db_read(NUMBER, 0, SIZE)
            ),
            "shmio's S7 client, without an instance": bare(lambda data: ours.write([Write(0, 0, data)]), ours.read),
        }
        confirmed: Times = {name: [] for name in contenders}
        seen: Times = {name: [] for name in contenders}
        value = 0
        for _ in range(count):
            for name, write in contenders.items():
                time.sleep(random.uniform(1, 2) * period_ms / 1000)  # anywhere in the source's cycle
                value += 1
                for times, taken_ms in zip((confirmed, seen), write(value), strict=True):
                    times[name].append(taken_ms)
    link = f", link +{round_trip_ms:g} ms" if round_trip_ms else ""
    title = f"poll each {period_ms:g} ms{link}"
    report_spread(f"{title}, until confirmed", "ms", confirmed, OURS, digits=2)
    report_spread(f"{title}, until seen in the block", "ms", seen, OURS, digits=2)
    rows = [[name, *(f"{cut:.2f}" for cut in quantiles(times))] for name, times in writer.stages.items()]
    table([f"{title}: shmio's stages, ms", "median", "p90", "p99"], rows)


def main() -> None:
    quick = begin("Commands: a value written until it is confirmed and seen")
    count = 10 if quick else 300
    for period_ms, round_trip_ms in ((1, 1),) if quick else ((20, 0), (20, 1), (1, 0), (1, 1)):
        measure(period_ms, round_trip_ms, count)


if __name__ == "__main__":
    main()
