"""The places that programs from outside take when they write."""

from __future__ import annotations

import os
import time

from shmio.errors import SegmentError
from shmio.segment.processes import Activity, Report
from shmio.segment.segment import Segment


def take_guest(segment: Segment) -> int:
    """Take a free guest's place for life; the number of its command queue. SegmentError: none is free."""
    places = segment.processes.guests
    for slot in places:
        if slot.writer is not None and slot.take():
            slot.report = Report(os.getpid(), Activity.RUNNING, time.monotonic_ns())
            return slot.writer
    pids = ", ".join(str(slot.report.pid) for slot in places)
    raise SegmentError(
        f"instance {segment.instance!r} has places for {len(places)} writing programs; end one of pids {pids}"
    )
