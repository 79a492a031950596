"""Record to a sequence of files, with rotation by size and age."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from shmio.backoff import Backoff
from shmio.config import Recorder as Settings
from shmio.errors import RecordingError
from shmio.recorder.attached_files import AttachedFiles
from shmio.recorder.block_follower import BlockEntry, InstanceEntry
from shmio.recorder.instance_follower import InstanceFollower, StartPositions
from shmio.recorder.output import Output, create
from shmio.recorder.recorder import CLOSE_S, Counters, Recorder
from shmio.recording.format.encoding import BlockPosition, Reason

RENEWAL: Final = Backoff(1.0, 600.0)
"""Waits between new files for a disk whose fsync keeps failing."""

log = logging.getLogger("shmio.recorder")


class RotatingRecorder:
    """Records to a new file whenever the present one is large or old enough; nothing is lost in between.

    It also starts a new file after a failed fsync, when it is unknown what the disk has of the old one. The
    new file begins where the old one is certainly on the disk: it records again what the rings still hold,
    and a gap for the rest.
    """

    def __init__(
        self,
        tap: InstanceFollower,
        settings: Settings,
        by: str,
        attachments: AttachedFiles,
        *,
        places: Mapping[int, BlockPosition] | None = None,
        about: Mapping[str, str] | None = None,
        counters: Counters | None = None,
    ) -> None:
        """Start the first file.

        Args:
            tap: Follows the instance.
            settings: Settings of the recorder.
            by: Kind of recorder.
            attachments: Returns the files to attach.
            places: Positions by section where the recording begins. With them the caller reads from
                ``tap`` and calls :meth:`put`.
            about: Further metadata about the recording.
            counters: Counters to continue; None: new ones.

        Raises:
            RecordingError: No file can be created.
        """
        self._settings = settings
        self._by = by
        self._attachments = attachments
        self._renewals = 0
        self._again_s = 0.0
        self._ending: list[Recorder] = []
        """Recorders of earlier files that still wait for the disk."""
        self.counters = counters or Counters()
        self._takes = places is None
        self._why = dict(about or {})
        self.recorder = self._begin(tap, places, {})

    def _begin(
        self,
        tap: InstanceFollower,
        places: Mapping[int, BlockPosition] | None,
        about: Mapping[str, str],
        after: Output | None = None,
    ) -> Recorder:
        settings = self._settings
        path, fd = create(Path(settings.directory), tap.segment.instance)
        output = Output(
            path,
            fd,
            limit_bytes=settings.buffer_bytes,
            fsync_s=settings.fsync_s,
            after=after,
        )
        self._begun_s = time.monotonic()
        return Recorder(
            tap, output, by=self._by, places=places, about={**self._why, **about}, counters=self.counters,
            attachments=self._attachments,
        )  # fmt: skip

    def turn(self) -> bool:
        """Record what has been published; returns whether there is more. RecordingError: the file was removed."""
        return self.recorder.turn()

    def put(self, entries: Iterable[BlockEntry | InstanceEntry]) -> None:
        """Record entries. RecordingError: the file was removed."""
        self.recorder.put(entries)

    def end(self) -> Mapping[int, BlockPosition]:
        """End the recording, without waiting for the disk; returns the last positions by section."""
        self.recorder.end()
        return self.recorder.places

    @property
    def ended(self) -> bool:
        """Whether the disk has everything, after :meth:`end`."""
        return all(recorder.output.ended for recorder in (*self._ending, self.recorder))

    @property
    def tap(self) -> InstanceFollower:
        """The follower of the instance; it is replaced when a file is given up."""
        return self.recorder.tap

    @property
    def file(self) -> Path:
        """Path of the present file."""
        return self.recorder.output.path

    @property
    def written(self) -> int:
        """Number of bytes in the present file."""
        return self.recorder.output.written

    @property
    def waiting(self) -> int:
        """Number of bytes that wait for the disk."""
        return sum(recorder.output.waiting for recorder in (*self._ending, self.recorder))

    @property
    def problem(self) -> str:
        """Description of the present problem; empty: none."""
        return next(filter(None, (recorder.problem for recorder in (*self._ending, self.recorder))), "")

    def tend(self) -> bool:
        """Start a new file if one is due; returns whether a doubtful file was given up."""
        for old in [old for old in self._ending if old.output.ended and not old.output.doubt]:
            old.output.close(0)
            self._ending.remove(old)
        doubtful = next((old for old in (*self._ending, self.recorder) if old.output.doubt), None)
        if doubtful is not None:
            return self._renew(doubtful)
        if self.recorder.output.synced:
            self._renewals = 0
        if self._due and time.monotonic() >= self._again_s:
            self._rotate()
        return False

    def present(self) -> set[Path]:
        """Return the files being written. Another thread may call it."""
        return {recorder.output.path for recorder in (*self._ending, self.recorder)}

    @property
    def _due(self) -> bool:
        """Whether rotation is due; never while the disk has a problem, which a new file would not solve."""
        settings, recorder = self._settings, self.recorder
        old = bool(settings.rotate_min) and time.monotonic() - self._begun_s >= settings.rotate_min * 60
        large = bool(settings.rotate_mb) and recorder.output.tell() >= settings.rotate_mb * 1e6
        return (old or large) and not (recorder.empty or self._ending or recorder.problem or recorder.losing)

    def _rotate(self) -> None:
        old = self.recorder
        old.settle()
        try:
            self.recorder = self._begin(self.tap, old.places, {}, after=old.output)
        except RecordingError as error:
            log.error("%s; continuing in %s", error, old.output.path)
            self._again_s = time.monotonic() + RENEWAL.most_s
            return
        old.end()
        self._ending.append(old)
        log.info("recording to %s, continuing where %s ends", self.recorder.output.path, old.output.path.name)

    def _renew(self, doubtful: Recorder) -> bool:
        if time.monotonic() < self._again_s:
            return False
        self._again_s = time.monotonic() + RENEWAL.wait_s(self._renewals)
        self._renewals += 1
        output = doubtful.output
        about = {"doubtful": output.path.name, "doubtful_from": str(output.synced)}
        tap, places = self.tap, None
        if self._takes:
            tap = tap.again(StartPositions(doubtful.confirmed, True, Reason.UNSURE))
        else:  # the caller reads the instance, and cannot repeat the doubtful entries
            self.recorder.settle()
            places = self.recorder.places
        try:
            recorder = self._begin(tap, places, about)
        except RecordingError as error:
            log.error("%s; %s", output.problem, error)
            return False
        log.error("%s; continuing in %s", output.problem, recorder.output.path)
        if self.recorder is not doubtful:
            self._ending.remove(doubtful)
            output.close(0)
        self._finish(CLOSE_S)
        self.recorder = recorder
        return True

    def _finish(self, patience_s: float) -> bool:
        if self._takes:
            return self.recorder.close(patience_s)
        self.recorder.end()
        return self.recorder.output.close(patience_s)

    def close(self, patience_s: float = CLOSE_S) -> list[str]:
        """Record what is there, and close all files; returns a problem for each incomplete one."""
        until_s = time.monotonic() + patience_s
        files = [*self._ending, self.recorder]
        closed = [old.output.close(max(0.0, until_s - time.monotonic())) for old in self._ending]
        closed.append(self._finish(max(0.1, until_s - time.monotonic())))
        return [_unclosed(recorder.output) for recorder, whole in zip(files, closed, strict=True) if not whole]


def _unclosed(output: Output) -> str:
    return f"{output.problem or output.path}{'' if output.doubt else '; it was not closed'}"
