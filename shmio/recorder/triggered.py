"""Records a file when a trigger fires. The file also has the seconds before the trigger."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from shmio.config import Recorder as Settings
from shmio.config import Trigger as TriggerSettings
from shmio.errors import ConfigError, RecordingError
from shmio.injection.condition import Memory
from shmio.injection.language import Number
from shmio.injection.program import NEVER, Decoder, compile_condition
from shmio.recorder.instance_follower import TURN_S, InstanceEntry, InstanceFollower
from shmio.recorder.recorder import CLOSE_S, AttachedFiles, Counters, RotatingRecorder, is_process_change
from shmio.recording.block_follower import BlockEntry
from shmio.recording.format.encoding import BlockPosition, Gap, Reason
from shmio.segment import Block, Frame, Quality
from shmio.segment.block import Layouts

ENTRY_BYTES: Final = 800
"""Approximate memory in bytes that an entry takes in addition to its images."""

log = logging.getLogger("shmio.recorder")


class Trigger:
    """Evaluates the trigger's condition at each frame of the sources that the condition reads.

    The trigger uses the values that readers see. The values of a bad frame count as unknown.
    """

    def __init__(self, when: str, blocks: Mapping[str, Block]) -> None:
        """Compile the condition.

        Raises:
            ConfigError: The condition is invalid, or reads unknown registers.
        """
        self.when = when
        self._blocks = blocks
        self._bind(blocks)

    def follow(self, blocks: Mapping[str, Block]) -> None:
        """Find the condition's registers in the instance's blocks, for example after a reload.

        While a register is missing, the trigger does not fire.
        """
        if blocks is not self._blocks:
            try:
                self._bind(blocks)
            except ConfigError as error:
                log.warning("the trigger cannot fire until its registers exist again: %s", error)
                self._blocks, self._condition = blocks, NEVER

    def _bind(self, blocks: Mapping[str, Block]) -> None:
        self._condition = compile_condition(self.when, Layouts(blocks))
        self._blocks = blocks
        self._sections = {block.section: name for name, block in blocks.items()}
        self.sources = {source for source, _ in self._condition.reads}
        """The sources that the condition reads."""
        self._images: dict[str, bytes | None] = {}
        self._memory = Memory()

    def sees(self, entry: BlockEntry | InstanceEntry) -> bool:
        """Take the next entry; return whether it is a frame at which the condition is true."""
        if isinstance(entry, InstanceEntry) or not isinstance(entry.item, Frame):
            return False
        source = self._sections.get(entry.follower.block.section, "")
        if source not in self.sources:
            return False
        frame = entry.item
        known = frame.quality is not Quality.BAD and frame.source_ns != 0
        self._images[source] = frame.image if known else None
        return self._condition.expression.holds([self._value(*read) for read in self._condition.reads], self._memory)

    def _value(self, source: str, codec: Decoder) -> Number | None:
        image = self._images.get(source)
        value = None if image is None else codec.decode(image)
        return value if isinstance(value, bool | int | float) else None


class PreTriggerBuffer:
    """Stores the entries of the last seconds, for a trigger that may fire; the memory is limited."""

    def __init__(self, before_s: float, limit_bytes: int, places: Mapping[int, BlockPosition]) -> None:
        """Create the buffer. ``places`` are the positions after which to start, by section."""
        self._before_ns = round(before_s * 1e9)
        self._limit = limit_bytes
        self._entries: deque[BlockEntry | InstanceEntry] = deque()
        self._size = 0
        self._logged = False
        self.places = dict(places)
        """Positions after which the buffer starts now, by section of the block."""

    def add(self, entry: BlockEntry | InstanceEntry) -> None:
        """Add an entry, unless it is a gap from the time before this recorder was started."""
        item = entry.item
        if isinstance(item, Gap) and item.reason is not Reason.OVERTAKEN:
            self._pass(entry)
            return
        self._entries.append(entry)
        self._size += _size(entry)
        self._trim(entry.log_ns)
        if self._size > self._limit and not self._logged:
            self._logged = True
            kept_s = (entry.log_ns - self._entries[0].log_ns) / 1e9
            log.warning(
                "only the last %.1f s before a trigger fit in memory; raise recorder.trigger.before_mb to keep more",
                kept_s,
            )
        while self._size > self._limit:
            self._drop()

    def before(self, log_ns: int) -> list[BlockEntry | InstanceEntry]:
        """Return the stored entries of the last seconds before the log time ``log_ns``, the oldest first."""
        self._trim(log_ns)
        return list(self._entries)

    def _trim(self, now_ns: int) -> None:
        while self._entries and self._entries[0].log_ns < now_ns - self._before_ns:
            self._drop()

    def _drop(self) -> None:
        entry = self._entries.popleft()
        self._size -= _size(entry)
        self._pass(entry)

    def _pass(self, entry: BlockEntry | InstanceEntry) -> None:
        if isinstance(entry, InstanceEntry):
            return
        section, item = entry.follower.block.section, entry.item
        frame, event, _ = self.places.get(section, entry.follower.begin)
        if isinstance(item, Gap):
            frame, event = (item.last, event) if item.what == "frames" else (frame, item.last)
        elif isinstance(item, Frame):
            frame = item.number
        else:
            event = item.number
        self.places[section] = BlockPosition(frame, event, entry.log_ns)


def _size(entry: BlockEntry | InstanceEntry) -> int:
    item = entry.item
    return ENTRY_BYTES + (len(item.raw) + len(item.effective or b"") if isinstance(item, Frame) else 0)


class TriggeredRecorder:
    """Records a file each time the trigger fires, from some seconds before until some seconds after.

    If the trigger fires again while a file is being written, this file becomes longer.
    """

    def __init__(
        self, tap: InstanceFollower, settings: Settings, trigger: TriggerSettings, by: str, attachments: AttachedFiles,
        *, going: bool = False,
    ) -> None:  # fmt: skip
        """Create the recorder, which waits for the trigger.

        If ``going`` is True, it starts a file at once, because the previous recorder died while it
        wrote a triggered recording.

        Raises:
            ConfigError: The condition is invalid.
        """
        self.counters = Counters()
        self.tap = tap
        self._settings = settings
        self._trigger = Trigger(trigger.when, tap.segment.blocks)
        self._times = trigger
        tap.watch(self._trigger.sources)
        self._by = by
        self._attachments = attachments
        self._series: RotatingRecorder | None = None
        self._ending: list[RotatingRecorder] = []
        self._backlog = self._anew(tap.start.places)
        self._until_ns = 0
        self._came_s = time.monotonic()
        self._problem = ""
        self._held = False  # no file was started, because too many bytes of earlier ones wait
        if going:
            self._begin(tap.now())

    def run_once(self) -> bool:
        """Read new entries, and record them if the trigger has fired.

        Return whether further entries are unread.

        Raises:
            RecordingError: The file was removed.
        """
        self._trigger.follow(self.tap.segment.blocks)
        entries, more = self.tap.take()
        if entries:
            self._came_s = time.monotonic()
        batch: list[BlockEntry | InstanceEntry] = []
        for entry in entries:
            if self._series and entry.log_ns > self._until_ns and not is_process_change(entry):
                self._end(batch)
                batch = []
            if self._trigger.sees(entry):
                self._begin(entry.log_ns)
            if isinstance(entry, BlockEntry) and not entry.follower.number:
                continue  # it is read only for the condition
            if self._series:
                batch.append(entry)
            else:
                self._backlog.add(entry)
        if self._series:
            self._series.put(batch)
            silent_s = time.monotonic() - self._came_s
            if not self.tap.segment.clock.read().virtual and silent_s > self._times.after_s + TURN_S:
                self._end([])  # nothing else may end the file; in virtual time, the host's clock does not count
        return more

    def _begin(self, log_ns: int) -> None:
        """Start a file with the buffered entries. If a file is being written, extend it."""
        self._until_ns = log_ns + round(self._times.after_s * 1e9)
        if self._series is not None:
            return
        if sum(series.waiting for series in self._ending) > self._settings.buffer_bytes:
            if not self._held:
                log.error(
                    "the trigger %s has fired, but the recorder starts no new file, because earlier files still "
                    "wait for the disk",
                    self._trigger.when,
                )
            self._held = True
            return
        self._held = False
        before = self._backlog.before(log_ns)
        about = {"trigger": self._trigger.when, "triggered_ns": str(log_ns)}
        try:
            series = RotatingRecorder(
                self.tap, self._settings, self._by, self._attachments,
                places=self._backlog.places, about=about, counters=self.counters,
            )  # fmt: skip
        except RecordingError as error:  # the next frame that fires the trigger retries
            if not self._problem:
                log.error(
                    "the trigger %s has fired, but the recorder cannot start a file: %s", self._trigger.when, error
                )
            self._problem = str(error)
            return
        self._problem = ""
        self._series = series
        series.put(before)
        log.info("the trigger %s has fired; the recorder is recording to %s", self._trigger.when, series.file)

    def _end(self, last: Sequence[BlockEntry | InstanceEntry]) -> None:
        if series := self._series:
            series.put(last)
            self._backlog = self._anew(series.end())
            self._ending.append(series)  # before the next line: another thread may call present()
            self._series = None

    def _anew(self, places: Mapping[int, BlockPosition]) -> PreTriggerBuffer:
        return PreTriggerBuffer(self._times.before_s, round(self._times.before_mb * 1e6), places)

    @property
    def _all(self) -> list[RotatingRecorder]:
        present = self._series
        return [*self._ending, *([present] if present else [])]

    def tend(self) -> bool:
        """Close finished files. Return True if a new file replaces a file whose fsync failed."""
        for series in [series for series in self._ending if series.ended]:
            for unclosed in series.close(0):
                log.error("%s", unclosed)
            self._ending.remove(series)
        return bool(self._series and self._series.tend())

    @property
    def problem(self) -> str:
        """The present problem of a file or its disk; empty if there is none."""
        return next(filter(None, (series.problem for series in self._all)), self._problem)

    @property
    def file(self) -> Path | None:
        """Path of the present file; None while the recorder waits for the trigger."""
        return self._series.file if self._series else None

    @property
    def written(self) -> int:
        """Number of bytes in the present file."""
        return self._series.written if self._series else 0

    def present(self) -> set[Path]:
        """Return the files that are being written. Any thread may call it."""
        return {path for series in self._all for path in series.present()}

    def close(self, patience_s: float = CLOSE_S) -> list[str]:
        """Record all remaining entries, and close all files.

        Return a message for each file that is incomplete.
        """
        while self.run_once():
            pass
        self._end(self.tap.remaining())
        until_s = time.monotonic() + patience_s
        return [text for series in self._ending for text in series.close(max(0.1, until_s - time.monotonic()))]
