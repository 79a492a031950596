"""Runs a campaign on a running instance of this host, and judges it at the same time."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import groupby
from math import ceil
from pathlib import Path
from typing import Final, cast

import numpy as np

from shmio.config import Declaration, Expectation
from shmio.config.declaration import shifted
from shmio.errors import ConfigError, NotRunningError, RecordingError, ShmioError
from shmio.judging.judge import Judge
from shmio.judging.source import Frames, Rows
from shmio.local.attach import Attachment
from shmio.model.snapshot import SnapshotInfo
from shmio.recorder.file_output import Output
from shmio.recorder.instance_follower import InstanceEntry, InstanceFollower, StartPositions
from shmio.recorder.recorder import CLOSE_S, AttachedFiles, Recorder, frame_of, no_attachments
from shmio.recording.block_follower import BlockEntry
from shmio.recording.injection_times import InjectionTimes
from shmio.recording.judge import GoldenRecordings
from shmio.segment import Block, Event, Frame, Segment
from shmio.segment.block import Layouts

MAX_STEPS: Final = 256
"""In virtual time, the frames of the steps are read after at most this many steps."""
STOP_STEPS: Final = 64
"""As :data:`MAX_STEPS`, if the run stops at the first failure.

The judge then also takes a turn after these steps, so it is the maximum number of steps after the failure.
"""
TURN_FRAMES: Final = 1024
"""In virtual time, the judge takes a turn when this many frames wait. A turn costs nearly the same for any number."""
GOOD_S: Final = 10.0
"""Maximum time in s to wait at the start until all sources that the expectations read have good quality."""
LOOK_S: Final = 0.02
BUFFER_BYTES: Final = 256 << 20
"""Maximum number of bytes of the recording that may wait for the disk."""
BY: Final = "shmio-campaign"


@dataclass(frozen=True)
class Plan:
    """The settings of one run of a campaign.

    Attributes:
        injections: The declared injections, with their seeds; their times count from the run's
            start.
        expectations: The expectations.
        duration_s: Duration of the run in s, on the instance's clock.
        folder: Folder of the campaign file; paths in the campaign are relative to this folder.
        step_s: Length of a step in s; None for the shortest period of the sources.
        real_time: Whether to run in real time, even if all sources could be stepped.
        stop: Whether to stop at the first failure.
        record: The file to create for a recording; None to record nothing.
        start: Name of a snapshot to restore before the run; None to start in the present state.
    """

    injections: Sequence[Declaration]
    expectations: Sequence[Expectation]
    duration_s: float
    folder: Path = Path()
    step_s: float | None = None
    real_time: bool = False
    stop: bool = False
    record: Path | None = None
    start: str | None = None


class LiveRun:
    """Runs a campaign once, judges it and records it. The judge and the recording get the same frames."""

    def __init__(
        self,
        segment: Segment,
        plan: Plan,
        attachments: AttachedFiles = no_attachments,
        seen: Callable[[Mapping[str, Rows]], None] = lambda _rows: None,
        attach: Callable[[Segment], Attachment] = Attachment,
    ) -> None:
        """Prepare a run.

        Args:
            segment: The instance's segment, writable.
            plan: What to do.
            attachments: Returns the files to attach to the recording.
            seen: Called with the new values of the signals, by source, in order of time.
            attach: Attaches to the instance by its segment.

        Raises:
            ConfigError: An expectation is invalid.
        """
        self._segment = segment
        self._plan = plan
        self._attachments = attachments
        self._seen = seen
        self._attach = attach
        blocks = segment.blocks
        stale_ns = {source: block.stale_ns for source, block in blocks.items()}
        self.judge = Judge(plan.expectations, Layouts(blocks), stale_ns, GoldenRecordings(plan.folder))
        self.injections = InjectionTimes()
        """When injections were active."""
        self.virtual = False
        """True if the run is in virtual time."""
        self.step_s = 0.0
        """Length of a step of virtual time, in s."""
        self.start: SnapshotInfo | None = None
        """The snapshot from which the run has started; None if it started in the present state."""
        self.problem: ShmioError | None = None
        """The error that ended the run early, or with which its end failed; None if there was no such error."""
        self.ended_early = False
        """True if :attr:`problem` ended the run early."""
        self.recorded = False
        """True if the recording is complete."""
        self._unrecorded: RecordingError | None = None
        self._supervised = segment.supervised
        self._blocks: dict[str, Block] = {source: blocks[source] for source in self.judge.sources}

    def run(self, over: threading.Event, begun: Callable[[], None] = lambda: None) -> None:
        """Run to the end, or until ``over`` is set; with :attr:`Plan.stop`, stop also at the first failure.

        After the start, no error is raised: :attr:`problem` has it, and the judge judges what was seen until then.

        Args:
            over: Set this event to end the run.
            begun: Called when the run has started.

        Raises:
            ConfigError: An injection is invalid, or the instance does not allow the plan's
                ``step_s``, ``real_time`` or ``start``.
            CommandError: A source refused an injection.
            RecordingError: The file of the recording cannot be created.
            SnapshotError: The snapshot cannot be restored.
        """
        started = False

        def start() -> None:
            nonlocal started
            started = True
            begun()

        try:
            self._run(over, start)
        except ShmioError as error:
            if not started:
                raise
            self.problem = self.problem or error

    def _run(self, over: threading.Event, begun: Callable[[], None]) -> None:
        plan = self._plan
        with ExitStack() as stack:
            cell = stack.enter_context(self._attach(self._segment))
            was_virtual = cell.clock.virtual
            self.virtual = not plan.real_time and (was_virtual or not cell.real_sources())
            if plan.real_time and was_virtual:
                raise ConfigError(
                    "--real-time: this instance runs in virtual time; leave out --real-time, or return the instance to "
                    "real time with shmio step --release"
                )
            if plan.step_s is not None and not self.virtual:
                why = "--real-time" if plan.real_time else ", ".join(cell.real_sources())
                raise ConfigError(
                    f"step_ms and --step-ms need virtual time, but this run is in real time, because of {why}; leave "
                    "out both"
                )
            if plan.start is not None and not self.virtual:
                why = "--real-time" if plan.real_time else ", ".join(cell.real_sources())
                raise ConfigError(f"start: snapshots need virtual time, but this run is in real time, because of {why}")
            self.step_s = plan.step_s or min(block.period_ns for block in self._segment.blocks.values()) / 1e9
            self._await_good(over)
            if self.virtual:
                cell.pause()
                if not was_virtual:
                    stack.callback(cell.release)
            if plan.start is not None:
                self.start = cell.restore_snapshot(plan.start)
            tap = InstanceFollower(self._segment, StartPositions(first=False))
            recorder = stack.enter_context(self._recording(tap))
            now_s = cell.clock.present_ns / 1e9
            if plan.injections:
                stack.enter_context(cell.declare([shifted(one, now_s) for one in plan.injections]))
            begun()
            try:
                turn = self._turns(tap, recorder)
                for _ in self._steps(cell, over) if self.virtual else self._waits(tap, over):
                    next(turn)
                    if recorder is not None:
                        self._check_recording(recorder)
                    if plan.stop and self.judge.failed:
                        break
            except ShmioError as error:
                self.problem, self.ended_early = error, True
            next(turn)
            self._seen(self.judge.finish())

    def _await_good(self, over: threading.Event) -> None:
        """Wait up to ``GOOD_S`` until the judged sources are good. If they are not, the verdicts will show it."""
        until_s = time.monotonic() + GOOD_S
        while True:
            frames = [(block, block.latest()) for block in self._blocks.values()]
            if all(frame is not None and block.assess(frame)[0] for block, frame in frames):
                return
            if over.wait(LOOK_S) or time.monotonic() > until_s:
                return

    @contextmanager
    def _recording(self, tap: InstanceFollower) -> Iterator[Recorder | None]:
        """Record while the ``with`` block runs, if the plan says so."""
        file = self._plan.record
        if file is None:
            yield None
            return
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            fd = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise RecordingError(f"--record {file}: {error.strerror}") from None
        output = Output(file, fd, limit_bytes=BUFFER_BYTES)
        recorder = Recorder(tap, output, by=BY, attachments=self._attachments)
        try:
            yield recorder
        finally:
            recorder.end()  # not close(), which would read frames that are not judged
            closed = output.close(CLOSE_S)
        if not closed:
            raise RecordingError(f"--record {file}: {output.error or output.doubt or 'it is not complete yet'}")
        self.recorded = self._unrecorded is None

    def _record(self, recorder: Recorder, entries: Sequence[BlockEntry | InstanceEntry]) -> None:
        """Record entries, unless the file was removed."""
        if self._unrecorded is None:
            try:
                recorder.put(entries)
            except RecordingError as error:
                self._unrecorded = RecordingError(f"--record {error}")

    def _check_recording(self, recorder: Recorder) -> None:
        """Raise RecordingError if the last write failed, as on a full disk, or if the file was removed."""
        if self._unrecorded is not None:
            raise self._unrecorded
        if error := recorder.output.error:
            raise RecordingError(f"--record {recorder.output.path}: {error}")

    def _check_running(self) -> None:
        """Raise NotRunningError if the instance has stopped, or if its supervisor has died."""
        self._segment.require_running()
        if self._supervised and not self._segment.supervised:
            raise NotRunningError(f"the supervisor of instance {self._segment.instance!r} has died")

    def _steps(self, cell: Attachment, over: threading.Event) -> Iterator[None]:
        """Step virtual time to the end of the run, and yield after each batch of steps."""
        left = ceil(self._plan.duration_s / self.step_s - 1e-9)
        room = min(block.ring.slot_count for block in self._segment.blocks.values()) // 2
        most = STOP_STEPS if self._plan.stop else MAX_STEPS
        while left and not over.is_set():
            count = max(1, min(left, most, room))
            self._check_running()
            cell.step(self.step_s, count)
            left -= count
            yield

    def _waits(self, tap: InstanceFollower, over: threading.Event) -> Iterator[None]:
        """Wait in real time until the end of the run, and yield after each pause."""
        until_s = time.monotonic() + self._plan.duration_s
        while (rest_s := until_s - time.monotonic()) > 0 and not over.wait(min(tap.pause_s, rest_s)):
            self._check_running()
            yield

    def _turns(self, tap: InstanceFollower, recorder: Recorder | None) -> Iterator[None]:
        """In each iteration, record the new entries, and judge them if enough wait for a turn."""
        enough = TURN_FRAMES if self.virtual and not self._plan.stop else 1
        waiting = 0  # for the judge's next turn
        while True:
            more = True
            while more:
                entries, more = tap.take()
                if recorder is not None:
                    self._record(recorder, entries)
                self._judge(entries)
                waiting += len(entries)
            if waiting >= enough:
                self._seen(self.judge.turn())
                waiting = 0
            yield

    def _judge(self, entries: Sequence[BlockEntry | InstanceEntry]) -> None:
        frames: dict[int, tuple[Block, list[Frame]]] = {}
        for follower, group in groupby(entries, frame_of):
            if follower is None:
                for entry in group:
                    if isinstance(entry.item, Event) and isinstance(entry, BlockEntry):
                        self.injections.follow(entry.follower.block.source, entry.item)
            elif (block := follower.block).source in self._blocks:
                new = cast("list[Frame]", [entry.item for entry in group])
                frames.setdefault(block.section, (block, []))[1].extend(new)
        for block, some in frames.values():
            source = block.source
            if block is not self._blocks[source]:
                self._blocks[source] = block
                self.judge.follow(source, block.layout, block.stale_ns)
            self.judge.add(source, frames_of(some, block.layout.size, raws=self.judge.needs_raw(source)))


def frames_of(frames: Sequence[Frame], size: int, *, raws: bool) -> Frames:
    """Return frames as arrays, as :meth:`Judge.add` expects them.

    Args:
        frames: Frames of one block.
        size: Size of an image in bytes.
        raws: Whether the judge also needs the images that the source delivered, without injections.
    """
    fields = tuple(zip(*frames, strict=True)) or ((),) * len(Frame._fields)
    number, _, _, clock_ns, _, _, quality, _, _, delay_us, _, raw, effective = fields
    shown = [one if other is None else other for one, other in zip(raw, effective, strict=True)]

    def images(some: Sequence[bytes]) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        return np.frombuffer(b"".join(some), np.uint8).reshape(len(frames), size)

    return Frames(
        np.array(number, np.uint64), np.array(clock_ns, np.int64), np.frombuffer(bytes(quality), np.uint8),
        np.array(delay_us, np.uint32), images(shown), images(raw) if raws else None,
    )  # fmt: skip
