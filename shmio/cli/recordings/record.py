"""``shmio-dump record``: records a running instance, from outside the instance."""

from __future__ import annotations

import argparse
import logging
import sys
import threading
import time
from pathlib import Path
from typing import Any

from shmio import control
from shmio.cli.common import say, say_json, stop_on_signals
from shmio.cli.target import target
from shmio.config import Recorder as Settings
from shmio.config import Trigger
from shmio.errors import ControlError, PathError, RecordingError
from shmio.recorder.instance_follower import InstanceFollower, StartPositions
from shmio.recorder.recorder import AttachedFiles, ConfigFiles, RotatingRecorder, no_attachments
from shmio.recorder.triggered import TriggeredRecorder
from shmio.recording.selection import Selection
from shmio.segment import Segment

BY = "shmio-dump"
WHERE_S = 2.0
LOOK_S = 0.5
"""Interval in s at which the instance and the output are checked."""


def record(arguments: argparse.Namespace) -> int:
    """Record until Ctrl-C, the end of the given time, or the end of the instance."""
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(message)s")
    with target(arguments).open() as segment, stop_on_signals() as stopping:
        sources = arguments.sources
        selection = Selection(sources, arguments.registers or ())
        for missing in selection.unmatched({name: block.layout for name, block in segment.blocks.items()}):
            raise PathError(missing)
        tap = InstanceFollower(segment, StartPositions(first=False), selection)
        reporter = Reporter(as_json=arguments.json)
        work = _work(arguments, tap, _attachments(segment, reporter))
        chosen = list(sources or segment.blocks)
        place = work.file or f"{arguments.directory} whenever {arguments.when}"
        reporter.report(
            "recording",
            f"recording {', '.join(chosen)} of {segment.instance} to {place}; Ctrl-C ends it",
            instance=segment.instance,
            sources=chosen,
            file=_name(work.file),
        )
        try:
            whole = _record(segment, work, stopping, arguments.duration_s, reporter)
        finally:
            file = work.file
            unclosed = work.close()
        _sum_up(work, file, arguments.directory, reporter, whole=whole and not unclosed)
        for text in unclosed:
            raise RecordingError(text)
        return 0 if whole else 1


def _work(
    arguments: argparse.Namespace, tap: InstanceFollower, attachments: AttachedFiles
) -> RotatingRecorder | TriggeredRecorder:
    settings = Settings(directory=str(arguments.directory), rotate_min=0, rotate_mb=0)
    if arguments.when is None:
        return RotatingRecorder(tap, settings, BY, attachments)
    seconds = {name: value for name in ("before_s", "after_s") if (value := getattr(arguments, name)) is not None}
    trigger = Trigger(arguments.when, **seconds)
    return TriggeredRecorder(tap, settings, trigger, BY, attachments)


def _record(
    segment: Segment,
    work: RotatingRecorder | TriggeredRecorder,
    stopping: threading.Event,
    duration_s: float | None,
    reporter: Reporter,
) -> bool:
    """Record; return False if the instance ended before the requested time."""
    until_s = None if duration_s is None else time.monotonic() + duration_s
    look_s, more, problem, file = 0.0, False, "", work.file
    while True:
        rest_s = work.tap.pause_s if until_s is None else min(work.tap.pause_s, until_s - time.monotonic())
        if rest_s <= 0 or stopping.wait(0 if more else rest_s):
            return True
        more = work.run_once()
        if work.file != file:
            file = work.file
            reporter.report("file", f"recording to {file}" if file else "waiting for the next time", file=_name(file))
        if time.monotonic() - look_s < LOOK_S:
            continue
        look_s = time.monotonic()
        work.tend()
        before, problem = problem, work.problem
        if bool(problem) != bool(before):
            reporter.report("problem", problem or f"{file} is being written again", text=problem or None)
        if not segment.shared.current():
            reporter.report("stopped", f"instance {segment.instance!r} has stopped")
            return until_s is None


def _attachments(segment: Segment, reporter: Reporter) -> AttachedFiles:
    """Return a function that attaches the files of the configuration, if its path is known."""
    try:
        return ConfigFiles(Path(control.request(segment.header.control, control.Where(), WHERE_S)["config"]))
    except (ControlError, KeyError) as error:
        text = f"the configuration is not attached: {error}"
        reporter.report("problem", text, text=text)
        return no_attachments


def _sum_up(
    work: RotatingRecorder | TriggeredRecorder, file: Path | None, directory: Path, reporter: Reporter, *, whole: bool
) -> None:
    counters = work.counters
    counts = {"frames": counters.frames, "events": counters.events, "missed": counters.missed}
    size = f", {work.written / 1e6:.2f} MB" if work.written else ""
    line = f"{file or directory}: {', '.join(f'{count} {what}' for what, count in counts.items())}{size}"
    reporter.report("ended", line, file=_name(file), **counts, bytes=work.written, whole=whole)


def _name(file: Path | None) -> str | None:
    return None if file is None else str(file)


class Reporter:
    """Reports what happens to the recording: as text on standard error, or as JSON on standard output."""

    def __init__(self, *, as_json: bool) -> None:
        self._as_json = as_json

    def report(self, what: str, line: str, **fields: Any) -> None:
        """Report what has happened. A closed terminal does not end the recording.

        Args:
            what: The kind of event, for JSON.
            line: The text.
            fields: Further keys, for JSON.
        """
        if self._as_json:
            say_json({"what": what, **fields})
        else:
            say(line, sys.stderr)
