"""Clearing the segment and the processes of a killed supervisor."""

from __future__ import annotations

import os
import pwd
import signal
import subprocess
import sys
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from shmio.errors import AlreadyRunningError, NotRunningError, SegmentError
from shmio.segment import ProcessSpec, Report, Segment, instances
from shmio.segment.stale_segment import clear, holder, living

SUPERVISOR = """
import subprocess, sys
from shmio.segment import ProcessSpec, Segment
segment = Segment.create(sys.argv[1], [], [ProcessSpec("cell", "source")])
child = subprocess.Popen([sys.executable, "-c", sys.argv[2], sys.argv[1]], stdout=sys.stdout)
child.wait()
"""
ORPHAN = """
import os, signal, sys
from shmio.segment import Report, Segment
segment = Segment.open(sys.argv[1], writable=True)
slot = segment.processes.find("cell")
assert slot.take()
slot.report = Report(os.getpid())
if {stubborn}:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
print(os.getpid(), flush=True)
signal.pause()
"""


def test_no_segment_to_clear_is_not_an_error(instance: str) -> None:
    assert clear(instance) == []


def test_the_segment_of_a_running_supervisor_is_not_cleared(instance: str) -> None:
    with Segment.create(instance, [], [ProcessSpec("cell", "source")]) as segment:
        with pytest.raises(AlreadyRunningError, match=f"pid {os.getpid()}"):
            clear(instance)
        segment.unlink()


def test_a_pid_reused_by_a_thread_is_not_a_process(instance: str) -> None:
    over = threading.Event()
    thread = threading.Thread(target=over.wait)
    thread.start()
    try:
        with Segment.create(instance, [], [ProcessSpec("cell", "source")]) as segment:
            slot = segment.processes.find("cell")
            assert slot.take()
            assert thread.native_id is not None
            slot.report = Report(thread.native_id)
            assert holder(slot, segment.shared) is None
            segment.unlink()
    finally:
        over.set()
        thread.join()


WORKER = """
import os, signal, sys
from shmio.segment.shm import SharedObject
shared = SharedObject.open(f"shmio-{sys.argv[1]}", writable=True)
memory = shared.map()
print(os.getpid(), flush=True)
signal.pause()
"""


@pytest.mark.parametrize("field", ["abi", "version"])
def test_processes_of_another_version_are_found_without_its_format(instance: str, field: str) -> None:
    """Such processes run a module of shmio and have mapped the segment for writing. Other processes are left alone."""
    with Segment.create(instance, [], [ProcessSpec("cell", "source")]) as segment:
        if field == "abi":
            segment.memory[8:12] = (7).to_bytes(4, "little")
        else:
            segment.memory[176:182] = b"0.0.7\0"
    modules = {"workers": "shmio.connectors_of_another_version", "others": "not_ours"}
    commands = {name: [sys.executable, "-c", WORKER, instance, "-m", module] for name, module in modules.items()}
    with ExitStack() as stack:
        running = {}
        for name, command in commands.items():
            process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            stack.callback(process.kill)
            assert process.stdout is not None
            assert int(process.stdout.readline()) == process.pid
            running[name] = process
        assert living(instance) is (field == "abi")
        assert clear(instance) == [
            f"segment shmio-{instance} is of another version of shmio",
            f"stopped {modules['workers']}, pid {running['workers'].pid}, which had lost its supervisor",
            f"removed the left-over segment shmio-{instance}",
        ]
        assert running["workers"].wait(10) == -signal.SIGTERM
        assert running["others"].poll() is None
    assert instance not in instances()


def test_a_process_that_does_not_end_is_named_and_keeps_the_segment(
    instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even SIGKILL ends a process that waits in the kernel."""
    monkeypatch.setattr("shmio.segment.stale_segment.GRACE_S", 0.2)
    command = [sys.executable, "-c", SUPERVISOR, instance, ORPHAN.format(stubborn=False)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as supervisor:
        assert supervisor.stdout is not None
        orphan = int(supervisor.stdout.readline())
        supervisor.kill()
        supervisor.wait()
        with monkeypatch.context() as held:
            held.setattr("shmio.segment.stale_segment.signal.pidfd_send_signal", lambda *_: None)
            with pytest.raises(SegmentError) as caught:
                clear(instance)
        assert str(caught.value) == (
            f"instance {instance!r} has processes that do not end: cell: pid {orphan} was killed and still runs; "
            "remove the cause, or restart the host; then try again"
        )
        assert instance in instances()
        assert clear(instance)[0].startswith(f"stopped cell, pid {orphan}")
    assert instance not in instances()


def test_a_process_of_another_user_is_reported_with_its_owner(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    command = [sys.executable, "-c", SUPERVISOR, instance, ORPHAN.format(stubborn=False)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as supervisor:
        assert supervisor.stdout is not None
        orphan = int(supervisor.stdout.readline())
        supervisor.kill()
        supervisor.wait()

        def refuse(*_: object) -> None:
            raise PermissionError

        owner = pwd.getpwuid(os.getuid()).pw_name
        with monkeypatch.context() as held:
            held.setattr("shmio.segment.stale_segment.signal.pidfd_send_signal", refuse)
            with pytest.raises(SegmentError) as caught:
                clear(instance)
        assert str(caught.value) == (
            f"instance {instance!r} has processes that do not end: cell: pid {orphan} belongs to user {owner}, so only "
            f"{owner} or root can end it: sudo kill {orphan}; then try again"
        )
        assert instance in instances()
        assert clear(instance)[0].startswith(f"stopped cell, pid {orphan}")


def test_an_unfinished_segment_is_removed(instance: str) -> None:
    (Path("/dev/shm") / f"shmio-{instance}").touch()
    assert not living(instance)
    assert clear(instance) == [f"removed the left-over segment shmio-{instance}"]


@pytest.mark.parametrize("stubborn", [False, True])
def test_orphans_of_a_killed_supervisor_are_stopped(
    instance: str, stubborn: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.segment.stale_segment.GRACE_S", 0.2)
    command = [sys.executable, "-c", SUPERVISOR, instance, ORPHAN.format(stubborn=stubborn)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as supervisor:
        assert supervisor.stdout is not None
        orphan = int(supervisor.stdout.readline())
        handle = os.pidfd_open(orphan)
        supervisor.kill()
        supervisor.wait()
        done = clear(instance)
    os.close(handle)
    assert done == [
        f"stopped cell, pid {orphan}, which had lost its supervisor",
        f"removed the left-over segment shmio-{instance}",
    ]
    assert not Path(f"/proc/{orphan}").exists() or "Z" in Path(f"/proc/{orphan}/stat").read_text().split()[2]
    assert instance not in instances()
    with pytest.raises(NotRunningError):
        Segment.open(instance)
