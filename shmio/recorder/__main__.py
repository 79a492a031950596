"""The main module of the recorder's process."""

from __future__ import annotations

import time
from pathlib import Path

import msgspec

from shmio import worker
from shmio.config import Recorder as Settings
from shmio.recorder.housekeeping import Housekeeper
from shmio.recorder.instance_follower import InstanceFollower, StartPositions
from shmio.recorder.previous_recordings import last_positions, trigger_interrupted
from shmio.recorder.recorder import ConfigFiles, RotatingRecorder
from shmio.recorder.triggered import TriggeredRecorder
from shmio.recording.format.encoding import SUPERVISED, Reason
from shmio.recording.selection import Selection
from shmio.segment import Report
from shmio.worker import BEAT_S, Worker

NOTE = "to "
"""Start of the recorder's status note while it has no problem; the name of its file follows."""
WAITS = f"{NOTE}a file as soon as its trigger fires"


def run(worker: Worker) -> None:
    """Record until the worker is stopped."""
    settings = msgspec.convert({k: v for k, v in worker.config.items() if k != "config_file"}, Settings)
    directory, segment = Path(settings.directory), worker.segment
    worker.running()  # before the search in the previous recorder's files, which may take a while
    segment.clock.abstain(worker.slot.index)  # steps must not wait for the search; the rings keep new frames
    known = last_positions(directory, segment, SUPERVISED, worker.slot.beat)
    elsewhere = _elsewhere(worker.before, directory)
    start = StartPositions(known, reason=Reason.ELSEWHERE if elsewhere else Reason.NOT_RUNNING)
    selection = Selection(settings.sources or None, settings.registers)
    for missing in selection.unmatched({name: block.layout for name, block in segment.blocks.items()}):
        worker.log.warning("recorder.registers: %s", missing)
    tap, attachments = InstanceFollower(segment, start, selection), ConfigFiles(Path(worker.config["config_file"]))
    series: RotatingRecorder | TriggeredRecorder
    if settings.trigger:
        going = trigger_interrupted(directory, segment, SUPERVISED, worker.slot.beat)
        series = TriggeredRecorder(tap, settings, settings.trigger, SUPERVISED, attachments, going=going)
    else:
        series = RotatingRecorder(tap, settings, SUPERVISED, attachments)
    goes_on = ", continuing where the previous recorder ended" if known else ""
    worker.log.info("the recorder is recording %s%s%s", _note(series), goes_on, elsewhere)
    keeper = Housekeeper(segment.instance, settings, SUPERVISED, series.present)
    keeper.start()
    _record(worker, series)
    keeper.stop()
    for unclosed in series.close():
        worker.log.error("%s", unclosed)
    _report(worker, series, "")
    counters = series.counters
    worker.log.info(
        "the recorder recorded %d frames and %d events; it missed %d", counters.frames, counters.events, counters.missed
    )


def _elsewhere(before: Report, directory: Path) -> str:
    """Return a text for the log if the previous recorder's file is not in this folder.

    The text is empty if that file is in the folder, or if the previous recorder wrote none.
    """
    name = before.note.removeprefix(NOTE)
    if before.note in (name, WAITS) or (directory / name).exists():
        return ""
    return f"; the previous recorder's file {name} is not in this folder: only that file has the older entries"


def _record(worker: Worker, series: RotatingRecorder | TriggeredRecorder) -> None:
    """Record in turns until the worker is stopped.

    In virtual time, each step waits until the recorder has read its frames, so that none is missed.
    """
    clock, slot = worker.segment.clock, worker.slot.index
    bell = clock.slot_bell(slot)
    seen, more, problem, told_s = bell.value(), False, "", 0.0
    clock.deliver(slot, 0)  # from now on, each step waits for the recorder
    while not worker.stopping.is_set():
        if not more:
            seen = bell.wait(seen, round(series.tap.pause_s * 1e9))
        more = series.run_once()
        if (done := series.tap.done) != clock.delivered(slot):
            clock.deliver(slot, done)
        if time.monotonic() - told_s < BEAT_S:
            continue
        told_s = time.monotonic()
        renewed = series.tend()
        before, problem = "" if renewed else problem, series.problem
        if problem and not before:
            worker.log.error("%s", problem)
        elif before and not problem:
            worker.log.info("the recorder writes %s again", series.file)
        _report(worker, series, problem)


def _report(worker: Worker, series: RotatingRecorder | TriggeredRecorder, problem: str) -> None:
    counters = series.counters
    numbers = (counters.frames, counters.events, counters.missed, series.written)
    worker.report(numbers, note=problem or _note(series))
    worker.report_readers((follower.block, follower.last) for follower in series.tap.followers)


def _note(series: RotatingRecorder | TriggeredRecorder) -> str:
    return f"{NOTE}{series.file.name}" if series.file else WAITS


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
