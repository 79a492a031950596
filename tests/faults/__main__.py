"""``scripts/fault-suite``: run the fault suite and write its report."""

from __future__ import annotations

import argparse
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from tests.faults import report
from tests.faults.inflict import OWN_SHM, SHM
from tests.faults.stepping import Stepping
from tests.faults.suite import Record, Suite

SHM_SIZE = "384m"
STEPPED = 0.2
"""Share of a run's duration in which the instance with stepped time is tested."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="fault-suite", description="Break an instance under load; check all values.")
    parser.add_argument(
        "--for", dest="for_s", type=float, default=60.0, metavar="SECONDS",
        help="duration (default: 60); a fifth of it tests an instance with stepped time",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, help="determines the faults and their times (default: a new seed)")
    parser.add_argument("--report", type=Path, metavar="FILE", help="file for the report (default: print it)")
    arguments = parser.parse_args()
    _have_own_shm()
    seed = secrets.randbits(32) if arguments.seed is None else arguments.seed
    folder = Path(tempfile.mkdtemp(prefix="shmio-faults-"))
    print(f"fault suite: seed {seed}, {arguments.for_s:g} s, in {folder}", flush=True)
    record, instance = Record(seed), f"faults-{os.getpid()}"

    def say(line: str) -> None:
        print(line, flush=True)

    suite = Suite(folder, instance, record, say)
    stepping = Stepping(folder / "stepped", f"{instance}-stepped", record, say)
    told = threading.Event()

    def stop() -> None:
        told.set()
        suite.stop()
        stepping.stop()

    for sign in (signal.SIGINT, signal.SIGTERM):
        signal.signal(sign, lambda *_: stop())
    suite.run(arguments.for_s * (1 - STEPPED))
    if not (record.violated or told.is_set()):
        stepping.run(arguments.for_s * STEPPED)
    text = report.write(record)
    if arguments.report:
        arguments.report.write_text(text)
        print(text.splitlines()[2])
    else:
        print(text)
    if record.violated:
        print(f"logs and configuration: {folder}", file=sys.stderr)
        return 1
    shutil.rmtree(folder)
    return 0


def _have_own_shm() -> None:
    """Restart this program in a mount namespace with a small /dev/shm, which faults may fill. This needs root."""
    space = ["unshare", "--mount", "--propagation", "private"]
    if OWN_SHM in os.environ or os.geteuid() or subprocess.run([*space, "true"], check=False).returncode:
        return
    mount = f'mount -t tmpfs -o size={SHM_SIZE} tmpfs {SHM} && exec "$@"'
    command = [*space, "sh", "-c", mount, "sh", sys.executable, "-m", "tests.faults", *sys.argv[1:]]
    os.execvpe(command[0], command, os.environ | {OWN_SHM: "1"})


if __name__ == "__main__":
    raise SystemExit(main())
