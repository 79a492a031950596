"""Recordings of what a trigger is about: a file a trigger, with the seconds before."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from shmio.config import Recorder as Settings
from shmio.config import Trigger as TriggerSettings
from shmio.dump.encoding import Place
from shmio.errors import RecordingError
from shmio.recording.attach import Attachments
from shmio.recording.follower import Aside, Entry
from shmio.recording.recorder import CLOSE_S, Counters, of_a_process
from shmio.recording.series import Series
from shmio.recording.tap import TURN_S, Tap
from shmio.recording.trigger import Backlog, Trigger

log = logging.getLogger("shmio.recorder")


class Triggered:
    """As :class:`~shmio.recording.series.Series`, but for the time between triggers. One that comes prolongs a file."""

    def __init__(
        self, tap: Tap, settings: Settings, trigger: TriggerSettings, by: str, attachments: Attachments,
        *, going: bool = False,
    ) -> None:  # fmt: skip
        """``going``: a recorder that died was within such a recording. ConfigError: the condition cannot be."""
        self.counters = Counters()
        self.tap = tap
        self._settings = settings
        self._trigger = Trigger(trigger.when, tap.segment.blocks)
        self._times = trigger
        tap.watch(self._trigger.sources)
        self._by = by
        self._attachments = attachments
        self._series: Series | None = None
        self._ending: list[Series] = []
        self._backlog = self._anew(tap.start.places)
        self._until_ns = 0
        self._came_s = time.monotonic()
        self._problem = ""
        self._held = False  # whether no file could be begun for what of others waits
        if going:
            self._begin(tap.now())

    def turn(self) -> bool:
        """Look what has been published, and record what is to be; whether there is more at once. RecordingError."""
        self._trigger.follow(self.tap.segment.blocks)
        entries, more = self.tap.take()
        if entries:
            self._came_s = time.monotonic()
        batch: list[Entry | Aside] = []
        for entry in entries:
            if self._series and entry.log_ns > self._until_ns and not of_a_process(entry):
                self._end(batch)
                batch = []
            if self._trigger.sees(entry):
                self._begin(entry.log_ns)
            if isinstance(entry, Entry) and not entry.follower.number:
                continue  # it is only watched
            if self._series:
                batch.append(entry)
            else:
                self._backlog.add(entry)
        if self._series:
            self._series.put(batch)
            silent_s = time.monotonic() - self._came_s
            if not self.tap.segment.clock.read().virtual and silent_s > self._times.after_s + TURN_S:
                self._end([])  # nothing comes any more that would tell; a replay's times are not the host's
        return more

    def _begin(self, log_ns: int) -> None:
        """Begin a file with what was before, or have the present one go on."""
        self._until_ns = log_ns + round(self._times.after_s * 1e9)
        if self._series is not None:
            return
        if sum(series.waiting for series in self._ending) > self._settings.buffer_bytes:
            if not self._held:
                log.error("%s: no file is begun while those before wait for the disk", self._trigger.when)
            self._held = True
            return
        self._held = False
        before = self._backlog.before(log_ns)
        about = {"trigger": self._trigger.when, "triggered_ns": str(log_ns)}
        try:
            series = Series(
                self.tap, self._settings, self._by, self._attachments,
                places=self._backlog.places, about=about, counters=self.counters,
            )  # fmt: skip
        except RecordingError as error:  # the seconds before are kept; with the next frame that fires it is tried again
            if not self._problem:
                log.error("%s: %s", self._trigger.when, error)
            self._problem = str(error)
            return
        self._problem = ""
        self._series = series
        series.put(before)
        log.info("%s: recording to %s", self._trigger.when, series.file)

    def _end(self, last: Sequence[Entry | Aside]) -> None:
        if series := self._series:
            series.put(last)
            self._backlog = self._anew(series.end())
            self._ending.append(series)  # before it is the present one no longer: another thread may look
            self._series = None

    def _anew(self, places: Mapping[int, Place]) -> Backlog:
        return Backlog(self._times.before_s, round(self._times.before_mb * 1e6), places)

    @property
    def _all(self) -> list[Series]:
        present = self._series
        return [*self._ending, *([present] if present else [])]

    def tend(self) -> bool:
        """Look after the files; whether a doubtful one was given up."""
        for series in [series for series in self._ending if series.ended]:
            for unclosed in series.close(0):
                log.error("%s", unclosed)
            self._ending.remove(series)
        return bool(self._series and self._series.tend())

    @property
    def problem(self) -> str:
        """What is wrong at present, in words; empty: nothing."""
        return next(filter(None, (series.problem for series in self._all)), self._problem)

    @property
    def file(self) -> Path | None:
        """What is being written; None: it waits for its trigger."""
        return self._series.file if self._series else None

    @property
    def written(self) -> int:
        """Bytes in the present file."""
        return self._series.written if self._series else 0

    def present(self) -> set[Path]:
        """What is being written; asked from another thread."""
        return {path for series in self._all for path in series.present()}

    def close(self, patience_s: float = CLOSE_S) -> list[str]:
        """Take what is there, close all files; what is wrong with those that are not whole."""
        while self.turn():
            pass
        self._end(self.tap.rest())
        until_s = time.monotonic() + patience_s
        return [text for series in self._ending for text in series.close(max(0.1, until_s - time.monotonic()))]
