"""A whole instance for a benchmark: ``shmio-supervisor up`` with a configuration in a temporary folder."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from common import DB201

from shmio.config.address import Address
from shmio.errors import NotRunningError
from shmio.segment import Segment, State
from shmio.testing.ports import reserved_port

START_S = 20.0

_SOURCE = """
[instance]
name = "{name}"
[[source]]
name = "cell"
connector = "s7"
layout = "{layout}"
host = "{plc.host}"
port = {plc.port}
dbNumber = 201
period_ms = {period_ms}
[grpc]
listen = ["{grpc}"]
"""
_EMULATOR = """
[[emulator]]
name = "plc"
kind = "s7"
layout = "{layout}"
program = "a50"
listen = "{plc}"
"""


@dataclass(frozen=True)
class Instance:
    """A running instance: a source ``cell``, the gRPC endpoint, and maybe an emulated controller ``plc``."""

    segment: Segment
    grpc: Address
    pids: dict[str, int]
    """Of each process by its name; the supervisor's is ``supervisor``."""


@contextmanager
def instance(
    period_ms: float, *, plc: Address | None = None, layout: Path = DB201, more: str = ""
) -> Iterator[Instance]:
    """Run an instance that polls ``plc``, or an emulated controller of its own with the program of the A50 cell.

    ``more``: further sections of the configuration.
    """
    name = f"bench-{os.getpid()}"
    with ExitStack() as stack:
        grpc = stack.enter_context(reserved_port())
        controller = plc or stack.enter_context(reserved_port())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        text = _SOURCE if plc else _SOURCE + _EMULATOR
        config = folder / "supervisor.toml"
        values = {"name": name, "layout": layout, "plc": controller, "period_ms": period_ms, "grpc": grpc}
        config.write_text(text.format(**values) + more)
        output = stack.enter_context((folder / "output").open("w+"))
        supervisor = subprocess.Popen(
            [sys.executable, "-m", "shmio.cli.supervisor", "up", "-c", str(config)],
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        stack.callback(_stop, supervisor)
        segment = _when_running(name, supervisor)
        if segment is None:
            output.seek(0)
            raise SystemExit(f"the instance does not start:\n{output.read()}")
        stack.enter_context(segment)
        pids = {"supervisor": supervisor.pid} | {slot.name: slot.report.pid for slot in segment.processes}
        yield Instance(segment, grpc, pids)


def _stop(supervisor: subprocess.Popen[bytes]) -> None:
    supervisor.terminate()
    supervisor.wait(30)


def _when_running(name: str, supervisor: subprocess.Popen[bytes]) -> Segment | None:
    """Wait until all processes run and the source's first frame is there; None if that does not come."""
    deadline_s = time.monotonic() + START_S
    while time.monotonic() < deadline_s and supervisor.poll() is None:
        with contextlib.suppress(NotRunningError):
            segment = Segment.open(name)
            if segment.supervisor[1] is State.RUNNING:
                return segment
            segment.close()
        time.sleep(0.05)
    return None
