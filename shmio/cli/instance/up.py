"""``shmio-supervisor up``: start an instance, in the foreground or detached.

The module ``start`` starts it; a process that only waits for a detached supervisor does not import
that module.
"""

from __future__ import annotations

import argparse
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from shmio.cli.instance.start_messages import Failed, Started, StartMessage, headline
from shmio.cli.run import ended_by_interrupt, say
from shmio.cli.target import config_file, option_for
from shmio.errors import ControlError
from shmio.local.status import InstanceStatus, SourceStatus, read_status
from shmio.plan.replay import given, options
from shmio.supervisor.process import child_environment

DETACH_S = 120.0
"""The longest time that the start of a detached instance is waited for."""


def execute(arguments: argparse.Namespace) -> int:
    """Start the instance; return when it has stopped, or with ``--detach`` when it runs."""
    file, keys = config_file(arguments), given(arguments)
    if arguments.detach:
        return _detach(file, arguments.mode, options(keys))
    with ended_by_interrupt():
        from shmio.cli.instance import start  # noqa: PLC0415

    if arguments.report is not None:
        return start.detached(file, arguments.mode, keys, arguments.report)
    return start.foreground(file, arguments.mode, keys)


def _detach(file: Path, mode: str, words: Sequence[str]) -> int:
    command = (sys.executable, "-P", "-m", "shmio.cli.supervisor", "up")
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as answers:
        child = subprocess.Popen(
            [*command, "-c", str(file), "--mode", mode, "--report", str(writer), *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,  # it shares our standard error until it has its log file
            pass_fds=(writer,),
            env=child_environment(),
            start_new_session=True,
        )
        os.close(writer)
        try:
            log_file, started = _await(answers.fileno())
        except BaseException:
            child.terminate()
            child.wait()
            raise
    child.returncode = 0  # keeps Popen from warning that the child still runs
    for line in started.history:
        say(line)
    status = read_status(started.instance)
    say(headline(started.instance, mode, status.segment_bytes, Path(log_file).parent))
    for line in started.processes:
        say(line)
    _tell_how(status, option_for(file))
    return 0


def _await(fd: int) -> tuple[str, Started]:
    """Wait for the start; return the log file and the message, or raise ControlError."""
    log_file = ""
    for line in _lines(fd):
        told = msgspec.json.decode(line, type=StartMessage)
        if isinstance(told, Started):
            return log_file, told
        if isinstance(told, Failed):
            raise ControlError(told.error)
        log_file = told.log_file
        for warning in told.warnings:
            say(warning, sys.stderr)
    raise ControlError(f"the supervisor died while it started; see {log_file or 'above'}")


def _lines(fd: int) -> Iterator[bytes]:
    """Yield the lines that come through the pipe, until its end or the time-out."""
    deadline = time.monotonic() + DETACH_S
    received = b""
    while True:
        ready, _, _ = select.select([fd], [], [], max(0.0, deadline - time.monotonic()))
        if not ready:
            raise ControlError(f"the instance is not running after {DETACH_S:g} s and is stopped again")
        data = os.read(fd, 65536)
        if not data:
            return
        *lines, received = (received + data).split(b"\n")
        yield from lines


def _tell_how(status: InstanceStatus, option: str) -> None:
    for process in status.processes:
        if isinstance(process, SourceStatus) and process.quality == "bad":
            say(f"warning: source {process.name} is bad: {process.reason}", sys.stderr)
    pid = status.supervisor.pid if status.supervisor else None
    down = f"shmio-supervisor down {option}".rstrip()
    say(f"{status.state}, supervisor pid {pid}; {down} stops it")
