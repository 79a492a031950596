"""Stores what a version of shmio writes and reads, for the tests of later versions: scripts/store-baseline."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from shmio.emulators.ports import reserved_port
from tests.compatibility import reading

BASELINES = Path(__file__).parent / "baselines"
LAYOUT = """DATA_BLOCK "notes"
{ S7_Optimized_Access := 'FALSE' }
   STRUCT
      level : Real := 1.5; count : DInt; on : Bool; word : Word := 16#BEEF; text : String[20] := 'a';
      row : Array[1..3] of Int; big : LReal; at : Time := T#1s;
   END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
CONFIG = """[instance]
name = "{instance}"

[[source]]
name = "cell"
connector = "s7"
layout = "db201.db"
host = "127.0.0.1"
port = {plc.port}
period_ms = 20
writable = ["Outputs"]

[[source]]
name = "notes"
connector = "memory"
layout = "notes.db"
period_ms = 50
writable = ["**"]

[[emulator]]
name = "plc"
kind = "s7"
layout = "db201.db"
program = "a50"
listen = "{plc}"

[[injection]]
name = "drift"
target = "notes/level"
operation = "offset"
value = 0.25
start_s = 0

[recorder]
directory = "dumps"
"""
WIRE = """
import sys
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from shmio.wire import shmio_v1_pb2, simlog_v1_pb2, simlog_v2_pb2, simserver_pb2, sparkplug_b_pb2
found = FileDescriptorSet()
for module in (shmio_v1_pb2, simlog_v1_pb2, simlog_v2_pb2, simserver_pb2, sparkplug_b_pb2):
    module.DESCRIPTOR.CopyToProto(found.file.add())
sys.stdout.buffer.write(found.SerializeToString(deterministic=True))
"""
KEYS = """
import json, sys
import msgspec
from shmio.config.model import Config
from shmio.connectors.registry import BUILT_IN, options_type
kinds = {name: options_type(name) for name in sorted(BUILT_IN)}
found = {"supervisor.toml": Config, **kinds}
json.dump({name: msgspec.json.schema(kind) for name, kind in found.items()}, sys.stdout)
"""


def store(version: str, tree: Path, python: Path) -> None:
    """Write ``baselines/VERSION``: wire, keys, recordings and what it reads in them, reader of segments.

    Args:
        version: The name of the folder.
        tree: The source tree of that version.
        python: The Python of an environment in which that version is installed.

    """
    folder = BASELINES / version
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as elsewhere:  # where the tree's sources are not on the path
        work = Path(elsewhere)
        (folder / "wire.binpb").write_bytes(_output(work, python, "-c", WIRE))
        keys = json.loads(_output(work, python, "-c", KEYS))
        (folder / "keys.json").write_text(json.dumps(keys, indent=1) + "\n")
        shutil.copy(tree / "db201.db", work)
        (work / "notes.db").write_text(LAYOUT)
        _record(work, python.parent, folder)
        files = [str(folder / f"{name}.mem") for name in ("closed", "killed")]
        read = json.loads(_output(work, python, reading.__file__, *files))
    (folder / "reading.json").write_text(json.dumps(read, indent=1) + "\n")
    for name in ("reader.c", "clock.h"):
        shutil.copy(tree / "examples" / name, folder)
    for file in (tree / "supervisor.toml", *sorted((tree / "examples").rglob("supervisor.toml"))):
        name = "-".join(file.relative_to(tree).parent.parts) or "demo"
        shutil.copy(file, folder / f"{name}.toml")


def _record(work: Path, commands: Path, folder: Path) -> None:
    """Run an instance, and keep two recordings: one that was closed, and one whose recorder was killed."""
    instance = f"baseline-{os.getpid()}"
    dumps = work / "dumps"

    def run(command: str, *arguments: str) -> str:
        return _output(work, commands / command, *arguments).decode()

    def recorder() -> dict[str, Any]:
        found: dict[str, Any] = json.loads(run("shmio-supervisor", "status", "--json", "--instance", instance))
        return next(one for one in found["processes"] if one["name"] == "recorder")

    with reserved_port() as plc:
        (work / "supervisor.toml").write_text(CONFIG.format(instance=instance, plc=plc))
        run("shmio-supervisor", "up", "--detach")
    try:
        run("shmio", "set", "notes/count", "-7")
        run("shmio", "set", "notes/row", "[1, 2, 3]")
        run("shmio", "set", "notes/text", '"old"')
        run("shmio", "set", "cell/Outputs/13", "1")
        run("shmio", "inject", "--for", "0.3", "cell/Robot_800/Axs1_Pos", "90")
        run("shmio-dump", "note", "a note", "--source", "notes")
        before = recorder()
        [first] = dumps.iterdir()
        os.kill(before["pid"], signal.SIGKILL)
        shutil.copy(first, folder / "killed.mem")  # before the next recorder closes it
        _until(lambda: (now := recorder())["state"] == "running" and now["pid"] != before["pid"])
        run("shmio", "set", "notes/level", "2.5")
        _until(lambda: recorder()["counters"]["frames"] > 300)
    finally:
        run("shmio-supervisor", "down")
    [second] = set(dumps.iterdir()) - {first}
    shutil.copy(second, folder / "closed.mem")


def _output(folder: Path, program: Path, *arguments: str) -> bytes:
    return subprocess.run([program, *arguments], cwd=folder, check=True, stdout=subprocess.PIPE, timeout=120).stdout


def _until(condition: Callable[[], bool], patience_s: float = 60) -> None:
    end = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError("the recorder does not record")
        time.sleep(0.1)


if __name__ == "__main__":
    store(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
