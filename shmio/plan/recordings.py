"""Open each recording that a configuration plays once for all of its sources."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shmio.connectors.replay.recording import Recording


class Recordings:
    """A context manager that keeps the recording requested last open."""

    def __init__(self) -> None:
        self._files: Sequence[str] = ()
        self._recording: Recording | None = None

    def get(self, files: Sequence[str]) -> Recording:
        """Return the recording of these files, valid until another is requested; RecordingError."""
        from shmio.connectors.replay.recording import Recording  # noqa: PLC0415  most configurations play none

        if self._recording is None or files != self._files:
            self.close()
            self._recording, self._files = Recording(files), files
        return self._recording

    def close(self) -> None:
        """Close the open recording, if any."""
        if self._recording is not None:
            self._recording.close()
            self._recording = None

    def __enter__(self) -> Recordings:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
