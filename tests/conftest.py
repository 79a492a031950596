"""What holds for every test: nothing is left behind, and each instance has a name of its own."""

from __future__ import annotations

import gc
import os
import secrets
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from xdist.scheduler import LoadScopeScheduling

from shmio.testing.mosquitto import missing

# Tests interrupt themselves and others; who runs in the background, or beside others, begins with SIGINT ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)

# No deadline: the machine may be busy with other things. Each run has the same examples; --hypothesis-profile=search
# looks for others.
settings.register_profile("repeat", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None, max_examples=1000)
settings.load_profile("repeat")

SHM = Path("/dev/shm")
PREFIX = f"test-{os.getpid()}-"


ONE_AFTER_THE_OTHER = (
    # the ports of the README
    (
        "tests/system/test_docs.py",
        "tests/unit/cli/test_supervisor_cell.py::test_what_init_writes_for_a_block",
    ),
    # an instance that all of a module use
    ("tests/system/test_inject.py",),
    ("tests/system/test_inject_grpc.py",),
    ("tests/system/test_running.py",),
    ("tests/system/test_step.py",),
    ("tests/system/test_write.py",),
)
"""Beginnings of the names of tests that share something, of which one process has to run all."""


class Scheduling(LoadScopeScheduling):  # type: ignore[misc]
    """Of the processes that run tests each gets one whenever it has time, or a whole group."""

    def _split_scope(self, nodeid: str) -> str:
        """The group of a test. (The mark for that, xdist_group, has no effect with pytest 9.2.)"""
        return next((group[0] for group in ONE_AFTER_THE_OTHER if nodeid.startswith(group)), nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Scheduling:
    """Instead of those that --dist names."""
    return Scheduling(config, log)


def pytest_collection_finish() -> None:
    """Have the garbage of each test found without going through all that there is before the first."""
    gc.collect()
    gc.freeze()


def segments() -> set[str]:
    """Those of this run: other instances on this host are none of our business."""
    return {entry.name for entry in SHM.iterdir() if entry.name.startswith(f"shmio-{PREFIX}")}


def children() -> set[int]:
    found: set[int] = set()
    for task in Path("/proc/self/task").iterdir():
        try:
            found.update(int(pid) for pid in (task / "children").read_text().split())
        except OSError:
            continue  # a thread that has just ended
    return found


def sockets() -> set[str]:
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        try:
            target = str(entry.readlink())
        except OSError:
            continue
        if target.startswith("socket:"):
            found.add(target)
    return found


def handlers() -> dict[signal.Signals, Any]:
    return {sign: signal.getsignal(sign) for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}


def left_over(before: tuple[set[str], set[int], set[str]]) -> tuple[set[str], set[int], set[str]]:
    return segments() - before[0], children() - before[1], sockets() - before[2]


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    """Fail a test that leaves a segment, a process, a socket, or a signal in other hands."""
    before = segments(), children(), sockets()
    heeded = handlers()
    yield
    deadline = time.monotonic() + 2.0
    while any(left := left_over(before)) and time.monotonic() < deadline:  # what is just ending may end
        if not gc.collect():
            time.sleep(0.005)
    now = handlers()
    for sign, handler in heeded.items():
        signal.signal(sign, handler)  # the next test is not to suffer
    assert now == heeded, f"signals go elsewhere now: {now}"
    assert not any(left), f"left behind: segments {left[0]}, processes {left[1]}, sockets {left[2]}"


def _named() -> Iterator[str]:
    name = PREFIX + secrets.token_hex(4)
    yield name
    (SHM / f"shmio-{name}").unlink(missing_ok=True)


@pytest.fixture
def instance() -> Iterator[str]:
    """A name that no other instance has; whatever a failing test leaves of it is cleared."""
    yield from _named()


@pytest.fixture
def runtime() -> Iterator[Path]:
    """A folder for ``XDG_RUNTIME_DIR``: a socket's path is at most 107 bytes long, and ``tmp_path`` may be longer."""
    with tempfile.TemporaryDirectory(prefix="shmio-run-") as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def shared_instance() -> Iterator[str]:
    """The same for an instance that several tests of a module use."""
    yield from _named()


@pytest.fixture(params=["mosquitto", "embedded"])
def program(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """What our own broker is asked to be: with mosquitto on the machine, and without."""
    if request.param == "mosquitto":
        if reason := missing():
            pytest.skip(reason)
    else:
        monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    return str(request.param)
