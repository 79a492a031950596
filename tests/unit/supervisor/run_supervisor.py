"""A supervisor of fake workers, in a process of its own: ``run_supervisor.py INSTANCE FOLDER JOBS LIMITS``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from shmio import logs
from shmio.errors import ShmioError
from shmio.layout.model import Layout, Register
from shmio.segment import BlockSpec, State
from shmio.supervisor.main import Supervisor
from shmio.supervisor.plan import Job, Plan
from shmio.supervisor.policy import Limits

instance, folder, jobs, limits = sys.argv[1], Path(sys.argv[2]), json.loads(sys.argv[3]), json.loads(sys.argv[4])
layout = Layout("DB1", 1, 2, False, (Register("a", "INT", (), 0, None, 2, 1),))
plan = Plan(
    instance=instance,
    mode="live",
    group=None,
    config_file=folder / "supervisor.toml",
    log_dir=folder,
    blocks=tuple(
        BlockSpec(name, layout, 20_000_000, 500_000_000, 1 << 20) for name, kind, _ in jobs if kind == "source"
    ),
    jobs=tuple(
        Job(name, kind, folder / f"{name}.log", {"behaviour": behaviour, "ends": str(folder / "ends")})
        for name, kind, behaviour in jobs
    ),
)
logs.setup(folder / "supervisor.log", "supervisor")
modules = dict.fromkeys(("source", "emulator", "grpc"), "fake_worker")


def tell(state: State) -> None:
    sys.stdout.write(f"{state}\n")
    sys.stdout.flush()


try:
    Supervisor(plan, limits=Limits(**limits), modules=modules, on_state=tell).run()
except ShmioError as error:
    sys.exit(str(error))
