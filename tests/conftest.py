"""What holds for every test: nothing is left behind, and each instance has a name of its own."""

from __future__ import annotations

import gc
import os
import secrets
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# Tests interrupt themselves and others; who runs in the background, or beside others, begins with SIGINT ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("unhurried", deadline=None)  # the machine may be busy with other things
settings.load_profile("unhurried")

SHM = Path("/dev/shm")
PREFIX = f"test-{os.getpid()}-"


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
    left = left_over(before)
    deadline = time.monotonic() + 2.0
    while any(left) and time.monotonic() < deadline:  # what is just ending may end
        gc.collect()
        time.sleep(0.01)
        left = left_over(before)
    now = handlers()
    for sign, handler in heeded.items():
        signal.signal(sign, handler)  # the next test is not to suffer
    assert now == heeded, f"signals go elsewhere now: {now}"
    assert not any(left), f"left behind: segments {left[0]}, processes {left[1]}, sockets {left[2]}"


@pytest.fixture
def instance() -> Iterator[str]:
    """A name that no other instance has; whatever a failing test leaves of it is cleared."""
    name = PREFIX + secrets.token_hex(4)
    yield name
    (SHM / f"shmio-{name}").unlink(missing_ok=True)
