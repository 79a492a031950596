"""Recordings are made as the recorder makes them."""

from tests.unit.recorder.conftest import recording, segment

__all__ = ["recording", "segment"]
