"""Starts a cell with 96,000 registers in six blocks of 48 kB, and measures how long programs take to use it.

The instance has 16 processes: an S7 source and an emulated controller for each block, the gRPC endpoint, the MQTT
bridge with its broker, and a recorder. It polls at 10 Hz.

``up``: from the start of the command to its return. ``good``: until all six sources have good values. ``attach``:
until a program has attached and read one register. ``get`` and ``list``: the whole commands, for one register and for
all of them.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from common import begin, keep, table

from shmio.testing.cell import BIN, Cell, until
from shmio.testing.ports import reserved_port

BLOCKS = 6
AXES = 4000
ROUNDS = 5
PATH = "s1/Axes/7/Pos"
FIGURES = (min, statistics.median, max)
KEPT = {"up": "up", "attach": "attach, and read a register", "get": "shmio get", "list": "shmio list"}
"""Titles of what the history keeps."""

LAYOUT = """DATA_BLOCK DB{number}
{{ S7_Optimized_Access := 'FALSE' }}
STRUCT
    Axes : Array[1..{axes}] of Struct
        Pos : Real; Vel : Real; Mode : Int; Flags : Word;
    END_STRUCT;
END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
BLOCK = """
[[emulator]]
name = "plc{number}"
kind = "s7"
layout = "{number}.db"
listen = "{plc}"
[[source]]
name = "s{number}"
connector = "s7"
layout = "{number}.db"
host = "127.0.0.1"
port = {plc.port}
period_ms = 100
"""
HEAD = """
[instance]
name = "{name}"
[grpc]
listen = ["{grpc}"]
[mqtt]
broker = "embedded"
listen = "{mqtt}"
[recorder]
directory = "dumps"
"""
ATTACH = """
import time
import shmio
begin = time.perf_counter()
shmio.attach({name!r}).get({path!r})
print(time.perf_counter() - begin)
"""


PLAIN = {name: os.environ[name] for name in os.environ if not name.startswith("PYTHON")}
"""The environment of a user's shell: what a command prints is buffered, and Python keeps the code that it compiles."""


def timed(*command: str | Path, cwd: Path) -> float:
    """Run a command, and return the s until it ended."""
    begin_s = time.monotonic()
    subprocess.run(command, cwd=cwd, env=PLAIN, stdout=subprocess.DEVNULL, check=True)
    return time.monotonic() - begin_s


def measure(cell: Cell) -> dict[str, float]:
    """Start the cell, use it once in each way, and stop it. Return the s of each."""
    begin_s = time.monotonic()
    up_s = timed(BIN / "shmio-supervisor", "up", "--detach", cwd=cell.folder)
    until(lambda: all(cell.processes()[f"s{n}"]["quality"] == "good" for n in range(1, BLOCKS + 1)), "good values")
    good_s = time.monotonic() - begin_s
    try:
        time.sleep(3)  # the bridge publishes each register once
        program = ATTACH.format(name=cell.instance, path=PATH)
        attach = subprocess.run([sys.executable, "-c", program], env=PLAIN, capture_output=True, text=True, check=True)
        get_s = timed(BIN / "shmio", "get", PATH, cwd=cell.folder)
        list_s = timed(BIN / "shmio", "list", cwd=cell.folder)
    finally:
        cell.down()
    return {"up": up_s, "good": good_s, "attach": float(attach.stdout), "get": get_s, "list": list_s}


def main() -> None:
    quick = begin("Large cell: the time to start and use 96,000 registers in six sources, in s")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        grpc, mqtt = (stack.enter_context(reserved_port()) for _ in range(2))
        name = f"large-{os.getpid()}"
        parts = [HEAD.format(name=name, grpc=grpc, mqtt=mqtt)]
        for number in range(1, BLOCKS + 1):
            (folder / f"{number}.db").write_text(LAYOUT.format(number=number, axes=100 if quick else AXES))
            parts.append(BLOCK.format(number=number, plc=stack.enter_context(reserved_port())))
        (folder / "supervisor.toml").write_text("".join(parts))
        cell = Cell(folder, name, grpc)
        found = [measure(cell) for _ in range(1 if quick else ROUNDS)]
    for what, title in KEPT.items():
        keep(title, statistics.median(one[what] for one in found), "s", "less")
    rows = [(what, *(f"{figure([one[what] for one in found]):.2f}" for figure in FIGURES)) for what in found[0]]
    table(["", "best", "median", "worst"], rows)


if __name__ == "__main__":
    main()
