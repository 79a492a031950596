"""Recordings are made as the recorder makes them."""

from tests.unit.recording.conftest import recording, segment

__all__ = ["recording", "segment"]
