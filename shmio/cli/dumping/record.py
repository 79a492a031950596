"""``shmio-dump record``: record a running instance from outside."""

from __future__ import annotations

import argparse
import logging
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

from shmio.cli.interrupt import told_to_stop
from shmio.cli.target import instance_name
from shmio.errors import ControlError, PathError, RecordingError
from shmio.logs import printable
from shmio.recording.attach import Attachments, ConfigFiles, no_attachments
from shmio.recording.output import Output, create
from shmio.recording.recorder import Recorder
from shmio.recording.selection import Selection
from shmio.recording.tap import Start, Tap
from shmio.segment import Segment
from shmio.supervisor import control

BY = "shmio-dump"
BUFFER_BYTES = 16_000_000
WHERE_S = 2.0
LOOK_S = 0.5
"""How often it is looked whether the instance still is, and the disk well."""


def execute(arguments: argparse.Namespace) -> int:
    """Record until Ctrl-C, the time is over, or the instance ends."""
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(message)s")
    with Segment.open(instance_name(arguments)) as segment, told_to_stop() as stopping:
        sources = arguments.sources
        selection = Selection(sources, arguments.registers or ())
        for missing in selection.nothing(segment.blocks):
            raise PathError(missing)
        path, fd = create(arguments.directory, segment.instance)
        recorder = Recorder(
            Tap(segment, Start(first=False), selection),
            Output(path, fd, limit_bytes=BUFFER_BYTES),
            by=BY,
            attachments=_attachments(segment),
        )
        _say(f"recording {', '.join(sources or segment.blocks)} of {segment.instance} to {path}; Ctrl-C ends it")
        try:
            whole = _record(segment, recorder, stopping, arguments.duration_s)
        finally:
            closed = recorder.close()
        _sum_up(recorder, path)
        if not closed:
            output = recorder.output
            raise RecordingError(
                output.problem if output.doubt else f"{output.problem or path}; the file was not closed"
            )
        return 0 if whole else 1


def _record(segment: Segment, recorder: Recorder, stopping: threading.Event, duration_s: float | None) -> bool:
    """Whether it went on as long as was asked."""
    until_s = None if duration_s is None else time.monotonic() + duration_s
    look_s, more, problem = 0.0, False, ""
    while True:
        rest_s = recorder.tap.pause_s if until_s is None else min(recorder.tap.pause_s, until_s - time.monotonic())
        if rest_s <= 0 or stopping.wait(0 if more else rest_s):
            return True
        more = recorder.turn()
        if time.monotonic() - look_s < LOOK_S:
            continue
        look_s = time.monotonic()
        before, problem = problem, recorder.problem
        if bool(problem) != bool(before):
            _say(problem or f"{recorder.output.path} is being written again")
        if not segment.shared.current():
            _say(f"instance {segment.instance!r} has stopped")
            return until_s is None


def _attachments(segment: Segment) -> Attachments:
    """The files of the configuration, if the supervisor says where that is."""
    try:
        return ConfigFiles(Path(control.request(segment.header.control, control.Where(), WHERE_S)["config"]))
    except (ControlError, KeyError) as error:
        _say(f"the configuration is not attached: {error}")
        return no_attachments


def _sum_up(recorder: Recorder, path: Path) -> None:
    counters = recorder.counters
    size = f"{recorder.output.written / 1e6:.2f} MB"
    _say(f"{path}: {counters.frames} frames, {counters.events} events, {counters.missed} missed, {size}")


def _say(line: str) -> None:
    """Print; a terminal that has gone away must not end the recording."""
    with suppress(OSError):
        print(printable(line), file=sys.stderr, flush=True)
