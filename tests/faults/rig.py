"""The instance under test and its environment: PLCs, the network to them, the host's clock."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final, Self

import shmio
from shmio.config import Address
from shmio.local.status import InstanceStatus, read_status
from shmio.segment import Segment
from shmio.testing.ports import reserved_port
from shmio.testing.proxy import FaultProxy
from tests.faults.checker import NOTES, Description
from tests.faults.checks import Process, Source
from tests.faults.configuration import EXTRA, PERIODS_MS, SIZES, STALE_MS, Configuration
from tests.faults.truth import Truth

ROOT: Final = Path(__file__).parents[2]
HERE: Final = Path(__file__).parent
COMMAND_S: Final = 180.0
OTHERS: Final = ("plc", "grpc", "mqtt")
"""Listeners other than the devices of :data:`~tests.faults.schedule.SOURCES`."""
MARK: Final = "SHMIO_FAULTS"
"""Environment variable that identifies every process of a run."""
TOLERANCE_MS: Final = 100
"""Time in ms that a loaded machine and the network may add to the age of a value."""


class Device:
    """An emulated PLC in a separate process behind a proxy. ``truth`` records what its block had."""

    def __init__(self, name: str, folder: Path, address: Address, environment: dict[str, str]) -> None:
        self._file = folder / f"{name}.truth"
        self.truth = Truth(self._file, create=True)
        self.proxy = FaultProxy(address)
        notes = [folder / f"{name}.{part}.truth" for part in NOTES]
        for note in notes:
            Truth(note, create=True).close()
        self._command = [str(self._file), *map(str, notes[:2]), str(address.port), str(SIZES[name]), "2"]
        self._environment = environment
        self.start()

    def start(self) -> None:
        """Start the PLC, and wait until it listens."""
        command = [sys.executable, "-P", "-m", "tests.faults.plc", *self._command]
        pipe = subprocess.PIPE
        self._popen = subprocess.Popen(command, stdin=pipe, stdout=pipe, env=self._environment)
        assert self._popen.stdout is not None
        self._popen.stdout.readline()

    @property
    def pid(self) -> int:
        """Pid of the present process."""
        return self._popen.pid

    def kill(self) -> None:
        """Kill the PLC, as a power failure does."""
        self._popen.kill()
        self._popen.communicate()
        self.truth.bury(time.monotonic_ns())

    def stop(self) -> None:
        """End the PLC and the network to it."""
        self._popen.communicate(timeout=COMMAND_S)
        self.proxy.stop()
        self.truth.close()


class Instance:
    """An instance, controlled by its commands. ``file``: its configuration."""

    def __init__(self, folder: Path, instance: str, file: Path) -> None:
        self.folder = folder
        self.instance = instance
        self.environment = dict(os.environ) | {
            MARK: instance,
            "PYTHONFAULTHANDLER": "1",
            "PYTHONPATH": f"{Path(shmio.__file__).parents[1]}{os.pathsep}{ROOT}",
        }
        self._file = file
        self._preload: dict[str, str] = {}

    def supervisor(self, verb: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run ``shmio-supervisor`` on the instance."""
        return subprocess.run(
            [sys.executable, "-P", "-m", "shmio.cli.supervisor", verb, "-c", str(self._file), *arguments],
            env=self.environment | self._preload | {"XDG_RUNTIME_DIR": str(self.folder)},
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=COMMAND_S,
            check=False,
        )

    def up(self) -> None:
        """Start the instance, or take it over from a dead supervisor; wait until it runs."""
        done = self.supervisor("up", "--detach")
        if done.returncode:
            raise RuntimeError(f"up failed: {done.stderr}")

    def ask(self, verb: str, *arguments: str) -> None:
        """Run a supervisor command. Repeat it while a change is in progress or /dev/shm is full."""
        until_s = time.monotonic() + COMMAND_S
        while (done := self.supervisor(verb, *arguments)).returncode:
            passing = "try again" in done.stderr or "/dev/shm has no room" in done.stderr
            if not passing or time.monotonic() > until_s:
                raise RuntimeError(f"{verb} {' '.join(arguments)} failed: {done.stderr}")

    def down(self) -> None:
        done = self.supervisor("down")
        if done.returncode:
            raise RuntimeError(f"down failed: {done.stderr}")

    def clear(self) -> None:
        """Stop the instance if it is running."""
        if self.status().running:
            self.supervisor("down")

    def status(self) -> InstanceStatus:
        return read_status(self.instance)

    def processes(self) -> dict[str, Process]:
        """Return the processes in the status, except guests and the source that reloads add."""
        processes = [p for p in self.status().processes if p.kind != "guest" and p.name != EXTRA]
        return {p.name: Process(p.pid, p.restarts) for p in processes}


class Rig(Instance):
    """The whole setup except the checkers. A context manager; the instance runs inside."""

    def __init__(self, folder: Path, instance: str) -> None:
        super().__init__(folder, instance, folder / "supervisor.toml")
        self._clock = folder / "clock"
        self._preload = {"LD_PRELOAD": str(folder / "clock.so"), "SHMIO_FAULTS_CLOCK": str(self._clock)}
        self.set_clock(0)
        compile_c(HERE / "clock.c", folder / "clock.so", "-shared", "-fPIC", "-ldl")
        compile_c(ROOT / "examples/reader.c", folder / "reader")
        self.devices: dict[str, Device] = {}
        self._lock = threading.Lock()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._build(stack)
            stack.callback(self.clear)
            self.up()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _build(self, stack: ExitStack) -> None:
        reserved = {name: stack.enter_context(reserved_port()) for name in ("fast", "block", *OTHERS)}
        ports = {name: reserved[name] for name in OTHERS}
        for name in ("fast", "block"):
            device = self.devices[name] = Device(name, self.folder, reserved[name], self.environment)
            stack.callback(device.stop)
            ports[name] = device.proxy.address
        self.grpc, self.mqtt = ports["grpc"], ports["mqtt"]
        self.configuration = Configuration(self.folder, self.instance, ports)

    def description(self, seed: int) -> Description:
        """Return the description that the checkers get."""
        sources = []
        for source in self.sources():
            name = source.name
            files = {"truth": f"{name}.truth"} | {part: f"{name}.{part}.truth" for part in NOTES}
            known = name in self.devices
            paths = {field: str(self.folder / file) if known else None for field, file in files.items()}
            sources.append(asdict(replace(source, truth=None)) | paths)
        with Segment.open(self.instance) as segment:
            rings = {name: block.ring.slot_count * block.period_ns for name, block in segment.blocks.items()}
        reader, recordings = str(self.folder / "reader"), str(self.folder / "dumps")
        return Description(
            self.instance, str(self.grpc), str(self.mqtt), seed, reader, recordings, rings, tuple(sources)
        )

    def sources(self) -> list[Source]:
        """Return the permanent sources, with the truth of those whose PLC belongs to the suite."""
        found = []
        for name, size in SIZES.items():
            period_ns, stale_ns, tolerance_ns = (ms * 10**6 for ms in (PERIODS_MS[name], STALE_MS[name], TOLERANCE_MS))
            truth = self.devices[name].truth if name in self.devices else None
            found.append(Source(name, size, period_ns, stale_ns, tolerance_ns, one_pdu=size < 900, truth=truth))
        return found

    def reload(self, change: Callable[[Configuration], None]) -> None:
        """Change the configuration, and reload the instance."""
        with self._lock:
            change(self.configuration)
            self.ask("reload")

    def set_clock(self, offset_ns: int) -> None:
        """Set the host's clock, as the instance sees it, to this offset from the real one."""
        if not self._clock.exists():
            self._clock.write_bytes(bytes(8))
        with self._clock.open("r+b") as clock:
            clock.write(struct.pack("=q", offset_ns))


def compile_c(source: Path, program: Path, *arguments: str) -> None:
    subprocess.run(
        ["cc", "-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", str(source), "-o", str(program), *arguments],
        check=True,
    )


def marked(instance: str) -> dict[int, str]:
    """Return the living processes of a run with their command lines, whoever started them."""
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
