"""The test fixture that runs mosquitto."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from pathlib import Path

import pytest

from shmio.testing.mosquitto import KILL_WITH_PARENT, missing

TIMEOUT_MS = 30_000
PROGRAM = """
import sys
from pathlib import Path
from shmio.testing.mosquitto import Mosquitto
from shmio.testing.ports import reserved_port
with reserved_port() as address:
    broker = Mosquitto(Path(sys.argv[1]), address)
    broker.start()
    print(broker.pid, flush=True)
    sys.stdin.read()
"""


@pytest.mark.skipif(bool(missing()), reason=missing())
@pytest.mark.skipif(not KILL_WITH_PARENT, reason="setpriv is not installed: it is in util-linux")
def test_it_ends_with_a_killed_test_run(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        watched = os.pidfd_open(int(run.stdout.readline()))
        try:
            run.kill()
            poll = select.poll()
            poll.register(watched, select.POLLIN)
            assert poll.poll(TIMEOUT_MS)
        finally:
            os.close(watched)
