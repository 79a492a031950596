"""A whole instance for a benchmark: ``shmio-supervisor up`` with a configuration in a temporary folder."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from common import DB201

from shmio.config.address import Address
from shmio.errors import NotRunningError
from shmio.segment import Segment, State
from shmio.testing.ports import reserved_port

START_S = 60.0

_HEAD = """
[instance]
name = "{name}"
clock = "{clock}"
{settings}
"""
_GRPC = """
[grpc]
listen = ["{grpc}"]
"""
_SOURCE = """
[[source]]
name = "{name}"
connector = "s7"
layout = "{layout}"
host = "{plc.host}"
port = {plc.port}
dbNumber = 201
period_ms = {period_ms}
writable = {writable}
"""
_EMULATOR = """
[[emulator]]
name = "plc"
kind = "s7"
layout = "{layout}"
program = "a50"
listen = "{plc}"
"""


def _prioritised(priority: int | None) -> str:
    return "" if priority is None else f"realtime_priority = {priority}\n"


@dataclass(frozen=True)
class Polled:
    """A source, with the controller that it polls and its period."""

    name: str
    plc: Address
    period_ms: float
    layout: Path = DB201
    writable: Sequence[str] = ()
    priority: int | None = None
    """The source's real-time priority; None for an ordinary process."""

    def text(self) -> str:
        """Return the source's section of the configuration."""
        return _SOURCE.format(
            name=self.name,
            layout=self.layout,
            plc=self.plc,
            period_ms=self.period_ms,
            writable=json.dumps(list(self.writable)),
        ) + _prioritised(self.priority)


@dataclass(frozen=True)
class Instance:
    """A running instance: its sources, the gRPC endpoint and, in some benchmarks, an emulated controller ``plc``."""

    segment: Segment
    grpc: Address
    pids: dict[str, int]
    """The pid of each process by its name. The supervisor's name is ``supervisor``."""


@contextmanager
def instance(period_ms: float, *, more: str = "", priority: int | None = None) -> Iterator[Instance]:
    """Run a source ``cell`` that polls an emulated controller with the program of the A50 cell.

    ``more`` holds further sections of the configuration. ``priority`` is the real-time priority of source and
    controller.
    """
    with reserved_port() as plc:
        emulator = _EMULATOR.format(layout=DB201, plc=plc) + _prioritised(priority)
        with started([Polled("cell", plc, period_ms, priority=priority)], more=emulator + more) as running:
            yield running


@contextmanager
def started(
    sources: Sequence[Polled],
    *,
    more: str = "",
    clock: str = "wall",
    settings: str = "",
    until: State = State.RUNNING,
    endpoint: bool = True,
) -> Iterator[Instance]:
    """Run an instance with these sources until the block ends.

    ``more`` holds further sections of the configuration, and ``settings`` further keys of ``[instance]``. The instance
    is ready when the supervisor is in the state ``until``. Without ``endpoint``, it has no gRPC endpoint.
    """
    name = f"bench-{os.getpid()}{'' if endpoint else '-alone'}"
    with ExitStack() as stack:
        grpc = stack.enter_context(reserved_port())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        config = folder / "supervisor.toml"
        parts = [
            _HEAD.format(name=name, clock=clock, settings=settings),
            _GRPC.format(grpc=grpc) if endpoint else "",
            *(source.text() for source in sources),
            more,
        ]
        config.write_text("".join(parts))
        output = stack.enter_context((folder / "output").open("w+"))
        supervisor = subprocess.Popen(
            [sys.executable, "-m", "shmio.cli.supervisor", "up", "-c", str(config)],
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        stack.callback(_stop, supervisor)
        segment = _when(until, name, supervisor)
        if segment is None:
            output.seek(0)
            raise SystemExit(f"the instance did not start. Its output:\n{output.read()}")
        stack.enter_context(segment)
        pids = {"supervisor": supervisor.pid} | {slot.name: slot.report.pid for slot in segment.processes}
        yield Instance(segment, grpc, pids)


def _stop(supervisor: subprocess.Popen[bytes]) -> None:
    supervisor.terminate()
    supervisor.wait(30)


def _when(state: State, name: str, supervisor: subprocess.Popen[bytes]) -> Segment | None:
    """Open the instance once its supervisor is in this state.

    None if that takes too long, or if the supervisor ends.
    """
    deadline_s = time.monotonic() + START_S
    while time.monotonic() < deadline_s and supervisor.poll() is None:
        with contextlib.suppress(NotRunningError):
            segment = Segment.open(name)
            if segment.supervisor[1] is state:
                return segment
            segment.close()
        time.sleep(0.05)
    return None
