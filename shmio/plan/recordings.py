"""The recordings that a configuration plays: each is opened, and measured, once for all of its sources."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shmio.connectors.replay.recording import Recording


class Recordings:
    """The one that was asked for last stays open. A context manager."""

    def __init__(self) -> None:
        self._files: Sequence[str] = ()
        self._recording: Recording | None = None

    def get(self, files: Sequence[str]) -> Recording:
        """The recording of these files, until another is asked for. RecordingError: there is none."""
        from shmio.connectors.replay.recording import Recording  # noqa: PLC0415  most configurations play none

        if self._recording is None or files != self._files:
            self.close()
            self._recording, self._files = Recording(files), files
        return self._recording

    def close(self) -> None:
        """Close the one that is open."""
        if self._recording is not None:
            self._recording.close()
            self._recording = None

    def __enter__(self) -> Recordings:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
