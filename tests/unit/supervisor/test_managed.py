"""What the supervisor hears from a process that runs, and says of it."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest

from shmio.plan.processes import Job
from shmio.segment import Activity, ProcessSpec, Report, Segment
from shmio.supervisor import policy
from shmio.supervisor.managed import ManagedProcess


def test_the_log_tells_what_a_recorder_lost_while_it_was_in_trouble(
    instance: str, caplog: pytest.LogCaptureFixture
) -> None:
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
    """A process that is told to read anew."""

    def __init__(self) -> None:
        self.times = 0

    def reread(self) -> None:
        self.times += 1


@pytest.mark.parametrize(
    ("before", "rules", "told", "known"),
    [
        (None, None, False, False),  # a kind of process that has no rules
        ({}, {}, False, False),
        ({}, {"token": [1]}, True, True),
        ({"token": [1]}, {"token": [1]}, True, True),  # the token's file may be another
        ({"token": [1]}, {}, True, True),
        ("another supervisor's", {}, True, False),
    ],
)
def test_a_process_that_is_kept_is_told_of_rules(
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
