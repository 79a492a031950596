"""A process that publishes frames on request, as a source without a device, with the gRPC endpoint in a second process.

It prints the endpoint's address, its pid and the instance's start. For each line {"hz", "seconds"} that it reads, it
publishes so many frames a second, and then prints their number. Every register changes with each frame. An argument
sets the number of registers.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import ROOT, tell

from shmio.layout.model import Layout, Register
from shmio.segment import Activity, Attributes, BlockSpec, ProcessSpec, Segment
from shmio.testing.ports import reserved_port

REGISTERS = 100
TICK_S = 0.001


def publish(segment: Segment, hz: float, seconds: float, registers: int) -> int:
    """Publish frames at evenly spaced times; at more than 1 kHz, publish those that are due once a ms.

    Return the count.
    """
    writer = segment.writer("cell")
    packer = struct.Struct(f">{registers}f")
    begun_s, count = time.monotonic(), 0
    first = writer.block.ring.head()
    while (elapsed_s := time.monotonic() - begun_s) < seconds:
        while count < elapsed_s * hz:
            count += 1
            writer.publish(packer.pack(*(((first + count) % 100_000 + 0.5,) * registers)), cycle=first + count)
        next_s = max(count / hz, elapsed_s + TICK_S if hz > 1 / TICK_S else 0)
        time.sleep(max(0.0, begun_s + next_s - time.monotonic()))
    return count


def main() -> None:
    registers = int(sys.argv[1]) if sys.argv[1:] else REGISTERS
    layout = Layout(
        "DB1",
        1,
        4 * registers,
        False,
        tuple(Register(f"r{i}", "REAL", (), 4 * i, None, 4, 1) for i in range(registers)),
    )
    block = BlockSpec("cell", layout, 1_000_000, 60_000_000_000, 8 << 20, Attributes("bench", ()))
    processes = [ProcessSpec("cell", "source"), ProcessSpec("grpc", "grpc")]
    with (
        tempfile.TemporaryDirectory() as folder,
        reserved_port() as address,
        Segment.create(f"bench-{os.getpid()}", [block], processes) as segment,
    ):
        description = {
            "instance": segment.instance,
            "epoch": segment.header.epoch,
            "name": "grpc",
            "kind": "grpc",
            "log_file": str(Path(folder) / "grpc.log"),
            "config": {"listen": [str(address)]},
        }
        endpoint = subprocess.Popen([sys.executable, "-m", "shmio.endpoints.grpc"], stdin=subprocess.PIPE, cwd=ROOT)
        try:
            assert endpoint.stdin is not None
            endpoint.stdin.write(json.dumps(description).encode())
            endpoint.stdin.close()
            slot = segment.processes.find("grpc")
            while slot.report.activity is not Activity.RUNNING:
                if endpoint.poll() is not None:
                    raise SystemExit(slot.report.note or "the endpoint ended")
                time.sleep(0.01)
            publish(segment, 100, 0.1, registers)
            tell({"address": str(address), "pid": endpoint.pid, "started_ns": segment.header.started_ns})
            for line in sys.stdin:
                wanted = json.loads(line)
                tell(publish(segment, wanted["hz"], wanted["seconds"], registers))
        finally:
            endpoint.terminate()
            endpoint.wait(20)
            segment.unlink()


if __name__ == "__main__":
    main()
