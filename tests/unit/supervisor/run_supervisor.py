"""Runs a supervisor of fake workers: ``run_supervisor.py INSTANCE FOLDER JOBS LIMITS``."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from shmio import logs
from shmio.backoff import Backoff
from shmio.errors import ConfigError, ShmioError
from shmio.layout.model import Layout, Register
from shmio.plan.processes import Job, Plan
from shmio.segment import BlockSpec, State, stale_segment
from shmio.supervisor import health
from shmio.supervisor.main import Supervisor
from shmio.supervisor.policy import Limits
from shmio.supervisor.process import ChildProcess

instance, folder, jobs, limits = sys.argv[1], Path(sys.argv[2]), json.loads(sys.argv[3]), json.loads(sys.argv[4])
LAYOUTS = {
    "old": Layout("DB1", 1, 2, False, (Register("a", "INT", (), 0, None, 2, 1),)),
    "new": Layout(
        "DB1", 1, 4, False, (Register("b", "INT", (), 0, None, 2, 1), Register("a", "INT", (), 2, None, 2, 1))
    ),
}


listening = {"listen": (folder / "listen").read_text()} if (folder / "listen").exists() else {}


def block(name: str, layout: Layout, ring_bytes: int) -> BlockSpec:
    return BlockSpec(name, layout, 20_000_000, 500_000_000, ring_bytes)


def make(settings: dict[str, Any]) -> Plan:
    """Return a plan.

    ``settings`` has the jobs as (name, kind, behaviour[, layout]), and other changes to the default plan.
    """
    return Plan(
        instance=settings.get("instance", instance),
        mode=settings.get("mode", "live"),
        group=None,
        config_file=folder / "supervisor.toml",
        log_dir=Path(settings.get("log_dir", folder)),
        blocks=tuple(
            block(name, LAYOUTS[layout[0] if layout else "old"], settings.get("ring", 1 << 20))
            for name, kind, _, *layout in settings["jobs"]
            if kind == "source"
        ),
        jobs=tuple(
            Job(name, kind, folder / f"{name}.log", {"behaviour": behaviour, "ends": str(folder / "ends"), **listening})
            for name, kind, behaviour, *_ in settings["jobs"]
        ),
        warnings=tuple(settings.get("warnings", ())),
        stepped=settings.get("stepped", False),
    )


def replan() -> Plan:
    """Read the plan from its file. If the pipe exists, first wait until a test writes to it."""
    if (pipe := folder / "slow").exists():
        pipe.read_bytes()
    try:
        return make(json.loads((folder / "plan.json").read_text()))
    except ValueError:
        raise ConfigError("plan.json: no JSON") from None


def kill(child: ChildProcess, end: Callable[[ChildProcess], None] = ChildProcess.kill) -> None:
    """Kill a process. If the file ``held`` exists, do nothing, as if the process could not be ended."""
    if not (folder / "held").exists():
        end(child)


def send(pidfd: int, sign: int, really: Callable[[int, int], None] = signal.pidfd_send_signal) -> None:
    """Send a signal to a process that is not a child. If the file ``held`` exists, do nothing."""
    if not (folder / "held").exists():
        really(pidfd, sign)


ChildProcess.kill = kill  # type: ignore[method-assign,assignment]
signal.pidfd_send_signal = send  # type: ignore[assignment]
logs.setup(folder / "supervisor.log", "supervisor")
if first_s := limits.pop("backoff_first_s", None):
    limits["backoff"] = Backoff(first_s, 10.0)
health.LOOK_S = limits.pop("look_s", health.LOOK_S)  # type: ignore[misc]
stale_segment.GRACE_S = limits.get("grace_s", stale_segment.GRACE_S)
modules = dict.fromkeys(("source", "emulator", "grpc"), "fake_worker")


def tell(state: State) -> None:
    os.write(1, f"{state}\n".encode())


try:
    Supervisor(make({"jobs": jobs}), replan=replan, limits=Limits(**limits), modules=modules, on_state=tell).run()
except ShmioError as error:
    sys.exit(str(error))
