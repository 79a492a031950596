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
from shmio.cli.target import target
from shmio.config import Recorder as Settings
from shmio.config import Trigger
from shmio.errors import ControlError, PathError, RecordingError
from shmio.logs import printable
from shmio.recording.attach import Attachments, ConfigFiles, no_attachments
from shmio.recording.selection import Selection
from shmio.recording.series import Series
from shmio.recording.tap import Start, Tap
from shmio.recording.triggered import Triggered
from shmio.segment import Segment
from shmio.supervisor import control

BY = "shmio-dump"
WHERE_S = 2.0
LOOK_S = 0.5
"""How often it is looked whether the instance still is, and the disk well."""


def execute(arguments: argparse.Namespace) -> int:
    """Record until Ctrl-C, the time is over, or the instance ends."""
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(message)s")
    with target(arguments).open() as segment, told_to_stop() as stopping:
        sources = arguments.sources
        selection = Selection(sources, arguments.registers or ())
        for missing in selection.nothing({name: block.layout for name, block in segment.blocks.items()}):
            raise PathError(missing)
        tap = Tap(segment, Start(first=False), selection)
        work = _work(arguments, tap, _attachments(segment))
        what = f"{', '.join(sources or segment.blocks)} of {segment.instance}"
        if work.file:
            _say(f"recording {what} to {work.file}; Ctrl-C ends it")
        else:
            _say(f"recording {what} to {arguments.directory} whenever {arguments.when}; Ctrl-C ends it")
        try:
            whole = _record(segment, work, stopping, arguments.duration_s)
        finally:
            file = work.file
            unclosed = work.close()
        _sum_up(work, file or arguments.directory)
        for text in unclosed:
            raise RecordingError(text)
        return 0 if whole else 1


def _work(arguments: argparse.Namespace, tap: Tap, attachments: Attachments) -> Series | Triggered:
    settings = Settings(directory=str(arguments.directory), rotate_min=0, rotate_mb=0)
    if arguments.when is None:
        return Series(tap, settings, BY, attachments)
    seconds = {name: value for name in ("before_s", "after_s") if (value := getattr(arguments, name)) is not None}
    trigger = Trigger(arguments.when, **seconds)
    return Triggered(tap, settings, trigger, BY, attachments)


def _record(segment: Segment, work: Series | Triggered, stopping: threading.Event, duration_s: float | None) -> bool:
    """Whether it went on as long as was asked."""
    until_s = None if duration_s is None else time.monotonic() + duration_s
    look_s, more, problem, file = 0.0, False, "", work.file
    while True:
        rest_s = work.tap.pause_s if until_s is None else min(work.tap.pause_s, until_s - time.monotonic())
        if rest_s <= 0 or stopping.wait(0 if more else rest_s):
            return True
        more = work.turn()
        if work.file != file:
            file = work.file
            _say(f"recording to {file}" if file else "waiting for the next time")
        if time.monotonic() - look_s < LOOK_S:
            continue
        look_s = time.monotonic()
        work.tend()
        before, problem = problem, work.problem
        if bool(problem) != bool(before):
            _say(problem or f"{file} is being written again")
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


def _sum_up(work: Series | Triggered, path: Path) -> None:
    counters = work.counters
    size = f", {work.written / 1e6:.2f} MB" if work.written else ""
    _say(f"{path}: {counters.frames} frames, {counters.events} events, {counters.missed} missed{size}")


def _say(line: str) -> None:
    """Print; a terminal that has gone away must not end the recording."""
    with suppress(OSError):
        print(printable(line), file=sys.stderr, flush=True)
