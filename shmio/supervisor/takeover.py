"""Takes over the segment and the running processes of a dead supervisor."""

from __future__ import annotations

import grp
import os
import stat
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from shmio.control import remove_socket
from shmio.errors import FormatError, SegmentError, UnfinishedError
from shmio.plan.processes import Plan
from shmio.segment import Activity, ProcessSlot, Segment, shm, stale_segment
from shmio.segment.shm import SharedObject
from shmio.supervisor.policy import Limits
from shmio.supervisor.process import AdoptedProcess

_START_AGAIN: Final = "stopping the old processes, and starting the instance again"


@dataclass
class TakenOver:
    """The segment of a dead supervisor, which this supervisor has locked, and the processes that continue."""

    segment: Segment
    children: list[tuple[ProcessSlot, AdoptedProcess]] = field(default_factory=list)


def take_over(plan: Plan, control: str, limits: Limits) -> tuple[TakenOver | None, list[str]]:
    """Take over a dead supervisor's segment, and its processes that run properly; end all other processes.

    If the plan cannot use the segment, remove it, and end all of its processes.

    Args:
        plan: The plan of the instance.
        control: The path of the new control socket, which is written into the segment.
        limits: Time-outs for the processes.

    Returns:
        What was taken over, or None if there was no segment that the plan can use; and a line about
        each thing that was done.

    Raises:
        AlreadyRunningError: A supervisor is alive.
        SegmentError: Permission is missing, or a process cannot be identified or does not end.
        WrongInstanceError: The running processes were started from another configuration file.

    """
    shared = stale_segment.claim(plan.instance)
    if shared is None:
        return None, []
    try:
        segment, done = _usable_segment(shared, plan)
        if segment is not None:
            children, lines = _adopt_or_end(segment, shared, limits)
            if segment.header.control != control:
                remove_socket(segment.header.control)
            segment.lead_to(control, plan.config_file)
            segment.end_replaced()
            return TakenOver(segment, children), [*done, *lines]
        done += stale_segment.clear_claimed(shared, plan.instance)
    except BaseException:
        shared.close()
        raise
    shared.close()
    return None, done


def _usable_segment(shared: SharedObject, plan: Plan) -> tuple[Segment | None, list[str]]:
    """Return the segment, or None if the plan cannot use it; and lines that say why."""
    try:
        segment = stale_segment.read(shared, plan.instance)
    except (FormatError, UnfinishedError):  # reported when the segment is cleared
        return None, []
    if not any(slot.alive() for slot in segment.processes):
        return None, []
    segment.require_config(plan.config_file)
    if segment.header.mode != plan.mode:
        return None, [f"{plan.instance} ran in mode {segment.header.mode}, not {plan.mode}; {_START_AGAIN}"]
    if plan.stepped != segment.clock.stepped:
        began, wanted = ("stepped", "wall") if segment.clock.stepped else ("wall", "stepped")
        return None, [f"{plan.instance} was started with instance.clock {began}, not {wanted}; {_START_AGAIN}"]
    if plan.origin and segment.header.started_utc_ns != plan.origin.started_utc_ns:
        return None, [f"{plan.instance} played another recording; {_START_AGAIN}"]
    status = Path(shm.DIRECTORY, shared.name).stat()
    if status.st_uid != os.geteuid():
        return None, [f"segment {shared.name} belongs to another user; {_START_AGAIN}"]
    if stat.S_IMODE(status.st_mode) & 0o040 != (0o040 if plan.group else 0) or (
        plan.group and status.st_gid != grp.getgrnam(plan.group).gr_gid
    ):
        return None, [f"instance.group has changed; {_START_AGAIN}"]
    return segment, []


def _adopt_or_end(
    segment: Segment, shared: SharedObject, limits: Limits
) -> tuple[list[tuple[ProcessSlot, AdoptedProcess]], list[str]]:
    """Adopt the processes that run properly, and end the others.

    Raises:
        SegmentError: A process cannot be identified, or does not end.

    """
    living = {slot.name: slot for slot in segment.processes if slot.alive()}
    fit: list[tuple[ProcessSlot, AdoptedProcess]] = []
    done, unfit = [], []
    deadline = time.monotonic() + stale_segment.GRACE_S
    while living:
        for name, slot in list(living.items()):
            worker = stale_segment.holder(slot, shared)
            if worker is not None and (reason := _unfit_reason(slot, limits)):
                unfit.append(worker)
                done.append(f"replacing {name}, pid {worker.pid}, which {reason}")
            elif worker is not None:
                fit.append((slot, AdoptedProcess(worker.pid, worker.pidfd)))
                done.append(f"took over {name}, pid {worker.pid}, which had lost its supervisor")
            if worker is not None or not slot.alive():
                del living[name]
        if living and time.monotonic() > deadline:
            for pidfd in (*(worker.pidfd for worker in unfit), *(child.pidfd for _, child in fit)):
                os.close(pidfd)
            raise SegmentError(
                f"instance {segment.instance!r} has processes whose pids shmio cannot find, so shmio does not end "
                f"them: {', '.join(living)}; end them, and try again"
            )
        time.sleep(0.01 if living else 0)
    try:
        stale_segment.end(segment.instance, unfit)
    except SegmentError:
        for _, child in fit:
            os.close(child.pidfd)
        raise
    finally:
        for worker in unfit:
            os.close(worker.pidfd)
    return fit, done


def _unfit_reason(slot: ProcessSlot, limits: Limits) -> str | None:
    """Return why a living process cannot be adopted; None if it can."""
    if slot.report.activity is not Activity.RUNNING:
        return f"was {slot.report.activity.name.lower()}"
    quiet_s = (time.monotonic_ns() - slot.heartbeat_ns) / 1e9
    return f"has given no heartbeat for {quiet_s:.0f} s" if quiet_s >= limits.hang_s else None
