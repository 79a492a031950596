"""Instances of fake workers under a supervisor in a separate process."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from shmio import control
from shmio.local.status import InstanceStatus, ProcessStatus, read_status
from shmio.segment import Segment, stale_segment

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
DEADLINE_S = 100.0

Job = tuple[str, str, list[str]]
CELL: list[Job] = [("plc", "emulator", ["good"]), ("cell", "source", ["good"]), ("grpc", "grpc", ["good"])]


def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition that no doorbell signals, such as one on a line of the process table."""
    deadline = time.monotonic() + DEADLINE_S
    pause = threading.Event()
    while not condition():
        assert time.monotonic() < deadline, "the condition did not become true in time"
        pause.wait(0.005)


class Launched:
    """A running ``run_supervisor.py``."""

    def __init__(self, instance: str, folder: Path, jobs: list[Job], limits: dict[str, Any]) -> None:
        self.instance = instance
        self.folder = folder
        self.process = subprocess.Popen(
            [
                *(sys.executable, str(HERE / "run_supervisor.py"), instance),
                *(str(folder), json.dumps(jobs), json.dumps(limits)),
            ],
            bufsize=0,  # select must see every line that has not been read
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": f"{ROOT}:{HERE}"},
        )
        self.states: list[str] = []

    def wait_state(self, state: str) -> None:
        """Read the supervisor's states until it reports this one."""
        assert self.process.stdout is not None
        deadline = time.monotonic() + DEADLINE_S
        while state not in self.states:
            ready, _, _ = select.select([self.process.stdout], [], [], deadline - time.monotonic())
            assert ready, f"no state {state!r}, only {self.states}"
            line = self.process.stdout.readline()
            assert line, f"ended: {self.errors()}"
            self.states.append(line.decode().strip())
        self.states.clear()

    def wait_end(self) -> int:
        return self.process.wait(DEADLINE_S)

    def errors(self) -> str:
        assert self.process.stderr is not None
        return self.process.stderr.read().decode()

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.wait_end()

    def status(self) -> InstanceStatus:
        return read_status(self.instance)

    def of(self, name: str) -> ProcessStatus:
        return next(process for process in self.status().processes if process.name == name)

    def pid(self, name: str) -> int:
        pid = self.of(name).pid
        assert pid is not None
        return pid

    def pids(self) -> dict[str, int | None]:
        return {process.name: process.pid for process in self.status().processes}

    def request(self, message: control.Request) -> dict[str, Any]:
        with Segment.open(self.instance) as segment:
            path = segment.header.control
        return control.request(path, message, DEADLINE_S)

    def plan(self, jobs: list[Any], **others: Any) -> None:
        """Write the plan that the next reload reads."""
        (self.folder / "plan.json").write_text(json.dumps({"jobs": jobs, **others}))

    def reload(self, jobs: list[Any], **others: Any) -> dict[str, Any]:
        self.plan(jobs, **others)
        return self.request(control.Reload())

    def log(self, name: str = "supervisor") -> str:
        return (self.folder / f"{name}.log").read_text()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()
        stale_segment.clear(self.instance)


Launch = Callable[..., Launched]
