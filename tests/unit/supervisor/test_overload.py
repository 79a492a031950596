"""The supervisor on a host with too few processors."""

from __future__ import annotations

import subprocess
import sys
from contextlib import ExitStack

from tests.unit.supervisor.harness import Launch, until

BUSY_LOOPS = 20
COMPUTES_S = 0.5
"""Processor time that the process needs without a heartbeat: less than the limit, and much longer beside others."""


def test_a_process_beside_busy_loops_is_not_killed(launch: Launch) -> None:
    cell = launch([("cell", "source", ["compute"])], hang_s=2.0)
    cell.wait_state("running")
    pid = cell.pid("cell")
    asked = cell.folder / "compute"
    with ExitStack() as stack:
        for _ in range(BUSY_LOOPS):
            loop = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(loop.kill)
        (cell.folder / "computing").write_text(str(COMPUTES_S))
        (cell.folder / "computing").rename(asked)
        until(lambda: not asked.exists())
        assert (cell.pid("cell"), cell.of("cell").restarts) == (pid, 0), cell.log()
