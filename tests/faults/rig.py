"""The instance under test and what surrounds it: PLCs, the network to them, the host's clock."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Final, Self

import shmio
from shmio.config import Address
from shmio.segment import Segment
from shmio.supervisor.status import InstanceStatus, read_status
from shmio.testing.ports import reserved_port
from shmio.testing.proxy import FaultProxy
from tests.faults.checker import Description
from tests.faults.checks import Process, Source
from tests.faults.plc import NUMBER
from tests.faults.truth import Truth

ROOT: Final = Path(__file__).parents[2]
HERE: Final = Path(__file__).parent
COMMAND_S: Final = 60.0
MARK: Final = "SHMIO_FAULTS"
"""A variable in the environment of every process of a run: none of them can hide."""
TOLERANCE_MS: Final = 100
"""What a loaded machine and the way through the network may add to an age."""

SIZES: Final = {"fast": 408, "block": 2192, "demo": 408}
PERIODS_MS: Final = {"fast": 5, "block": 20, "demo": 20}
STALE_MS: Final = {"fast": 300, "block": 500, "demo": 500}

_DB = """DATA_BLOCK DB{number}
{{ S7_Optimized_Access := 'FALSE' }}
   STRUCT
      stamp : LWord;
      rest : Array[1..{rest}] of LWord;
      command : LWord;
   END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
_SOURCE = """
[[source]]
name = "{name}"
connector = "s7"
layout = "{name}.db"
host = "127.0.0.1"
port = {port}
dbNumber = {number}
timeout = 400
period_ms = {period_ms}
stale_ms = {stale_ms}
writable = ["command"]
"""
_OTHERS = """
[[emulator]]
name = "plc"
kind = "s7"
layout = "demo.db"
program = "counter"
listen = "{plc}"
[grpc]
listen = ["{grpc}"]
[recorder]
"""


class Device:
    """An emulated PLC in a process of its own, behind a proxy, with the truth about its block."""

    def __init__(self, name: str, folder: Path, address: Address, environment: dict[str, str]) -> None:
        self._file = folder / f"{name}.truth"
        self.truth = Truth(self._file, create=True)
        self.proxy = FaultProxy(address)
        self._landed = folder / f"{name}.landed.truth"
        Truth(self._landed, create=True).close()
        self._command = [str(self._file), str(self._landed), str(address.port), str(SIZES[name]), "2"]
        self._environment = environment
        self.start()

    def start(self) -> None:
        """Start the PLC; returns when it listens."""
        command = [sys.executable, "-P", "-m", "tests.faults.plc", *self._command]
        pipe = subprocess.PIPE
        self._popen = subprocess.Popen(command, stdin=pipe, stdout=pipe, env=self._environment)
        assert self._popen.stdout is not None
        self._popen.stdout.readline()

    @property
    def pid(self) -> int:
        """The present process."""
        return self._popen.pid

    def kill(self) -> None:
        """Cut its power."""
        self._popen.kill()
        self._popen.communicate()
        self.truth.bury(time.monotonic_ns())

    def stop(self) -> None:
        """End it, and the network to it."""
        self._popen.communicate(timeout=COMMAND_S)
        self.proxy.stop()
        self.truth.close()


class Rig:
    """Everything that is not a checker. Use as a context manager; the instance is running inside."""

    def __init__(self, folder: Path, instance: str) -> None:
        self.folder = folder
        self.instance = instance
        self.environment = dict(os.environ) | {
            MARK: instance,
            "PYTHONFAULTHANDLER": "1",
            "PYTHONPATH": f"{Path(shmio.__file__).parents[1]}{os.pathsep}{ROOT}",
        }
        self._clock = folder / "clock"
        self.set_clock(0)
        compile_c(HERE / "clock.c", folder / "clock.so", "-shared", "-fPIC", "-ldl")
        compile_c(ROOT / "examples/reader.c", folder / "reader")
        self.devices: dict[str, Device] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._build(stack)
            stack.callback(self._clear)
            self.up()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _build(self, stack: ExitStack) -> None:
        ports = {name: stack.enter_context(reserved_port()) for name in ("fast", "block", "plc", "grpc")}
        text = f'[instance]\nname = "{self.instance}"\nring_mb = 1\n'
        for name, size in SIZES.items():
            (self.folder / f"{name}.db").write_text(_DB.format(number=NUMBER, rest=size // 8 - 2))
            port = ports["plc"].port
            if name in ports:
                device = self.devices[name] = Device(name, self.folder, ports[name], self.environment)
                stack.callback(device.stop)
                port = device.proxy.address.port
            times = {"period_ms": PERIODS_MS[name], "stale_ms": STALE_MS[name]}
            text += _SOURCE.format(name=name, port=port, number=NUMBER, **times)
        self.grpc = ports["grpc"]
        self.config = self.folder / "supervisor.toml"
        self.config.write_text(text + _OTHERS.format(plc=ports["plc"], grpc=self.grpc))

    def description(self, seed: int) -> Description:
        """What checkers are told."""
        sources = []
        for name, size in SIZES.items():
            period_ns, stale_ns, tolerance_ns = (ms * 10**6 for ms in (PERIODS_MS[name], STALE_MS[name], TOLERANCE_MS))
            source = Source(name, size, period_ns, stale_ns, tolerance_ns, one_pdu=size < 900)
            files = {"truth": f"{name}.truth", "landed": f"{name}.landed.truth"}
            known = name in self.devices
            paths = {field: str(self.folder / file) if known else None for field, file in files.items()}
            sources.append(asdict(source) | paths)
        with Segment.open(self.instance) as segment:
            rings = {name: block.ring.slot_count * block.period_ns for name, block in segment.blocks.items()}
        reader, recordings = str(self.folder / "reader"), str(self.folder / "dumps")
        return Description(self.instance, str(self.grpc), seed, reader, recordings, rings, tuple(sources))

    def supervisor(self, verb: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run ``shmio-supervisor`` on the instance, on a host whose clock can be set."""
        preload = {"LD_PRELOAD": str(self.folder / "clock.so"), "SHMIO_FAULTS_CLOCK": str(self._clock)}
        return subprocess.run(
            [sys.executable, "-P", "-m", "shmio.cli.supervisor", verb, "-c", str(self.config), *arguments],
            env=self.environment | preload | {"XDG_RUNTIME_DIR": str(self.folder)},
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=COMMAND_S,
            check=False,
        )

    def up(self) -> None:
        """Start the instance, or take up what a dead supervisor has left; returns when it runs."""
        done = self.supervisor("up", "--detach")
        if done.returncode:
            raise RuntimeError(f"up failed: {done.stderr}")

    def down(self) -> None:
        """Stop the instance."""
        done = self.supervisor("down")
        if done.returncode:
            raise RuntimeError(f"down failed: {done.stderr}")

    def _clear(self) -> None:
        if self.status().running:
            self.supervisor("down")

    def set_clock(self, offset_ns: int) -> None:
        """Set the clock of the instance's host, relative to the true one."""
        if not self._clock.exists():
            self._clock.write_bytes(bytes(8))
        with self._clock.open("r+b") as clock:
            clock.write(struct.pack("=q", offset_ns))

    def status(self) -> InstanceStatus:
        """The instance as ``status`` tells it."""
        return read_status(self.instance)

    def processes(self) -> dict[str, Process]:
        """The processes that the supervisor started, as ``status`` tells it."""
        return {p.name: Process(p.pid, p.restarts) for p in self.status().processes if p.kind != "guest"}


def compile_c(source: Path, program: Path, *arguments: str) -> None:
    """Compile a C program."""
    subprocess.run(
        ["cc", "-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", str(source), "-o", str(program), *arguments],
        check=True,
    )


def marked(instance: str) -> dict[int, str]:
    """The processes of a run that are alive, whoever started them, by their command lines."""
    found = {}
    mark = f"{MARK}={instance}".encode()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if mark in (entry / "environ").read_bytes().split(b"\0"):
                    found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
    return found
