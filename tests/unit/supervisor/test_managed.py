"""What the supervisor hears from a process that runs, and says of it."""

from __future__ import annotations

import logging

import pytest

from shmio.segment import Activity, ProcessSpec, Report, Segment
from shmio.supervisor import policy
from shmio.supervisor.managed import Managed


def test_the_log_tells_what_a_recorder_lost_while_it_was_in_trouble(
    instance: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "shmio.supervisor")
    with Segment.create(instance, [], [ProcessSpec("recorder", "recorder")]) as segment:
        slot = segment.processes.find("recorder")
        managed = Managed(slot)
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
    assert caplog.messages == ["recorder is well again; 8 frames and events were lost"]
