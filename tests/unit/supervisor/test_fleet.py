"""The processes of a segment: their reports, and the supervisor's actions and log lines."""

from __future__ import annotations

import logging
import os
import selectors
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from shmio.plan.processes import Job
from shmio.realtime import ProcessorTime
from shmio.segment import Activity, ProcessSpec, Report, Segment, stale_segment
from shmio.segment.processes import ProcessSlot
from shmio.segment.shm import SharedObject
from shmio.supervisor import policy
from shmio.supervisor.fleet import Fleet, ManagedProcess
from shmio.supervisor.policy import Life, Limits, State
from shmio.supervisor.process import AdoptedProcess


@pytest.mark.parametrize(("share", "state"), [(0.6, State.RUNNING), (0.3, State.HUNG)])
def test_a_quiet_process_is_not_killed_while_it_waits_for_a_processor(
    instance: str, share: float, state: State, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """What the process had waited before its last heartbeat does not count. The log says why it is killed."""
    begun_ns = now_ns = time.monotonic_ns()

    def scheduled(_: object) -> ProcessorTime:
        passed_ns = now_ns - begun_ns
        return ProcessorTime(10**11 + passed_ns // 2, 10**12 + round(passed_ns * share))

    monkeypatch.setattr(AdoptedProcess, "processor_time", scheduled)
    with (
        Segment.create(instance, [], [ProcessSpec("plc", "emulator")]) as segment,
        selectors.DefaultSelector() as selector,
        subprocess.Popen(["sleep", "60"]) as child,
    ):
        try:
            fleet = Fleet(segment, selector, Limits(), {})
            managed = fleet.named("plc")
            managed.child = AdoptedProcess(child.pid, os.pidfd_open(child.pid))
            managed.life = Life(State.RUNNING)
            while now_ns < begun_ns + 8 * 10**9 and managed.life.state is State.RUNNING:
                now_ns += 100_000_000
                fleet.check(now_ns)
            assert managed.life.state is state
            killed = state is State.HUNG
            evidence = "no heartbeat for 5 s; meanwhile its threads ran for 3.2 s and waited 1.9 s for a processor"
            assert [evidence in line for line in caplog.messages] == [True] * killed
            os.close(managed.child.pidfd)
        finally:
            child.kill()
            segment.unlink()


@pytest.mark.parametrize("holder_is_child", [True, False])
def test_only_an_unknown_process_is_evicted_from_a_slot(
    instance: str, monkeypatch: pytest.MonkeyPatch, holder_is_child: bool
) -> None:
    """The child may take its slot just before the supervisor looks for the slot's holder."""
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
            managed.slot.report = Report(1, Activity.STOPPING, 0, (), "")  # report of the previous process
            fleet.check(time.monotonic_ns())
            assert bool(killed) is not holder_is_child
            os.close(managed.child.pidfd)
        finally:
            child.kill()
            other.kill()
            segment.unlink()


def test_the_log_says_how_many_frames_a_recorder_lost(instance: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "shmio.supervisor")
    with Segment.create(instance, [], [ProcessSpec("recorder", "recorder")]) as segment:
        slot = segment.processes.find("recorder")
        managed = ManagedProcess(slot)
        managed.life = policy.adopted(0, 0)
        for missed, note, complaint in (
            (7, "to a.mem", ""),
            (7, "a.mem: disk full", "a.mem: disk full"),
            (12, "a.mem: disk full; 5 lost", "a.mem: disk full; 5 lost"),
            (15, "to a.mem", ""),
            (15, "to a.mem", ""),
        ):
            slot.report = Report(1, Activity.RUNNING, 0, (100, 0, missed, 0), note)
            managed.listen()
            assert managed.complaint == complaint
        segment.unlink()
    assert caplog.messages == ["recorder has recovered; 8 frames and events were lost"]


class Told:
    """A process that counts how often it is told to read its access rules again."""

    def __init__(self) -> None:
        self.times = 0

    def reread(self) -> None:
        self.times += 1


@pytest.mark.parametrize(
    ("before", "rules", "told", "known"),
    [
        (None, None, False, False),  # this kind of process has no rules
        ({}, {}, False, False),
        ({}, {"token": [1]}, True, True),
        ({"token": [1]}, {"token": [1]}, True, True),  # the token's file may have changed
        ({"token": [1]}, {}, True, True),
        ("another supervisor's", {}, True, False),
    ],
)
def test_a_process_that_is_kept_is_told_to_read_changed_rules(
    instance: str, tmp_path: Path, before: Any, rules: Any, told: bool, known: bool
) -> None:
    with Segment.create(instance, [], [ProcessSpec("grpc", "grpc")]) as segment:
        managed, child = ManagedProcess(segment.processes.find("grpc")), Told()
        managed.child = child  # type: ignore[assignment]
        jobs = [Job("grpc", "grpc", tmp_path / "log", {}, given) for given in (before, rules)]
        if not isinstance(before, str):
            managed.renew(jobs[0])
        assert managed.keep(jobs[1]) is known
        assert child.times == told
        segment.unlink()
