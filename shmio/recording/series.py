"""Recordings of one recorder, one after the other."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Final

from shmio.config import Recorder as Settings
from shmio.dump.encoding import Reason
from shmio.errors import RecordingError
from shmio.recording.attach import Attachments
from shmio.recording.output import Output, create
from shmio.recording.recorder import Recorder, Start
from shmio.segment import Segment

FIRST_WAIT_S: Final = 1.0
MAX_WAIT_S: Final = 600.0
"""A disk whose fsync fails for good gets a new file so often at last, and twice as often each time before."""

log = logging.getLogger("shmio.recorder")


class Series:
    """Takes a new file when an fsync of the present one has failed: of that nobody can say any more what the disk has.

    The new file begins where the disk had the old one for certain: what the rings still hold of it is recorded again,
    the rest is a gap there.
    """

    def __init__(self, segment: Segment, settings: Settings, by: str, start: Start, attachments: Attachments) -> None:
        """``start``: where the recorder before ended. RecordingError: no file can be made."""
        self._segment = segment
        self._settings = settings
        self._by = by
        self._attachments = attachments
        self._wait_s = FIRST_WAIT_S
        self._again_s = 0.0
        self.recorder = self._begin(start)

    def _begin(self, start: Start) -> Recorder:
        settings = self._settings
        path, fd = create(Path(settings.directory), self._segment.instance)
        output = Output(path, fd, limit_bytes=settings.buffer_bytes, fsync_s=settings.fsync_s)
        return Recorder(self._segment, output, by=self._by, start=start, attachments=self._attachments)

    def renew(self) -> bool:
        """Begin a new file if that is called for; whether it was."""
        old = self.recorder
        if not old.output.doubt:
            if old.output.synced:
                self._wait_s = FIRST_WAIT_S
            return False
        if time.monotonic() < self._again_s:
            return False
        self._again_s = time.monotonic() + self._wait_s
        self._wait_s = min(2 * self._wait_s, MAX_WAIT_S)
        about = {"doubtful": old.output.path.name, "doubtful_from": str(old.output.synced)}
        try:
            self.recorder = self._begin(Start(old.confirmed, True, Reason.UNSURE, about, old.counters))
        except RecordingError as error:
            log.error("%s; %s", old.output.problem, error)
            return False
        log.error("%s; going on in %s", old.output.problem, self.recorder.output.path)
        old.close()
        return True
