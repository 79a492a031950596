"""Supervise the processes of a segment."""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import time

import pytest

from shmio.segment import Activity, ProcessSpec, Report, Segment, stale_segment
from shmio.segment.processes import ProcessSlot
from shmio.segment.shm import SharedObject
from shmio.supervisor.fleet import Fleet
from shmio.supervisor.policy import Life, Limits
from shmio.supervisor.process import AdoptedProcess
from shmio.supervisor.states import State


@pytest.mark.parametrize("holder_is_child", [True, False])
def test_only_a_stranger_is_evicted_from_a_slot(
    instance: str, monkeypatch: pytest.MonkeyPatch, holder_is_child: bool
) -> None:
    """The child may take its slot in the moment between the look at the slot's pid and the search for its holder."""
    killed: list[int] = []

    def holder(slot: ProcessSlot, _shared: SharedObject) -> stale_segment.Worker:
        slot.report = Report(child.pid if holder_is_child else other.pid, Activity.STARTING, 0, (), "")
        pid = slot.report.pid
        return stale_segment.Worker(slot.name, pid, os.pidfd_open(pid))

    monkeypatch.setattr(stale_segment, "holder", holder)
    monkeypatch.setattr(signal, "pidfd_send_signal", lambda fd, _signal: killed.append(fd))
    with (
        Segment.create(instance, [], [ProcessSpec("plc", "emulator")]) as segment,
        selectors.DefaultSelector() as selector,
        subprocess.Popen(["sleep", "60"]) as child,
        subprocess.Popen(["sleep", "60"]) as other,
    ):
        try:
            fleet = Fleet(segment, selector, Limits(), {})
            managed = fleet.named("plc")
            managed.child = AdoptedProcess(child.pid, os.pidfd_open(child.pid))
            managed.life = Life(State.STARTING)
            managed.slot.report = Report(1, Activity.STOPPING, 0, (), "")  # of the process before
            fleet.look(time.monotonic_ns())
            assert bool(killed) is not holder_is_child
            os.close(managed.child.pidfd)
        finally:
            child.kill()
            other.kill()
            segment.unlink()
