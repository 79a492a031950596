"""The process of the recorder."""

from __future__ import annotations

import time
from pathlib import Path

import msgspec

from shmio import worker
from shmio.config import Recorder as Settings
from shmio.recording.attach import ConfigFiles
from shmio.recording.output import Output, create
from shmio.recording.predecessor import places
from shmio.recording.recorder import Recorder, Start
from shmio.worker import BEAT_S, Worker

BY = "supervised"


def run(worker: Worker) -> None:
    """Record until told to stop."""
    settings = msgspec.convert({k: v for k, v in worker.config.items() if k != "config_file"}, Settings)
    directory, segment = Path(settings.directory), worker.segment
    worker.running()  # its search for what its predecessor has may take a while
    known = places(directory, segment, BY, worker.slot.beat)
    path, fd = create(directory, segment.instance)
    output = Output(path, fd, limit_bytes=settings.buffer_bytes, fsync_s=settings.fsync_s)
    files = ConfigFiles(Path(worker.config["config_file"]))
    recorder = Recorder(segment, output, by=BY, start=Start(known), attachments=files)
    worker.log.info("recording to %s%s", path, ", going on where its predecessor ended" if known else "")
    _record(worker, recorder)
    if not recorder.close():
        worker.log.error("%s; it was not closed", output.problem or path)
    _report(worker, recorder, "")
    counters = recorder.counters
    worker.log.info("%d frames, %d events, %d missed", counters.frames, counters.events, counters.missed)


def _record(worker: Worker, recorder: Recorder) -> None:
    more, problem, told_s = False, "", 0.0
    while not worker.stopping.wait(0 if more else recorder.pause_s):
        more = recorder.turn()
        if time.monotonic() - told_s < BEAT_S:
            continue
        told_s = time.monotonic()
        before, problem = problem, recorder.problem
        if problem and not before:
            worker.log.error("%s", problem)
        elif before and not problem:
            worker.log.info("%s is being written again", recorder.output.path)
        _report(worker, recorder, problem)


def _report(worker: Worker, recorder: Recorder, problem: str) -> None:
    counters = recorder.counters
    numbers = (counters.frames, counters.events, counters.missed, recorder.output.written)
    worker.report(numbers, note=problem or f"to {recorder.output.path.name}")


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
