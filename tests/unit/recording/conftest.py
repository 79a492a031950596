"""Fixtures of the recorder's tests: recordings are made by the recorder."""

from tests.unit.recorder.conftest import recording, segment

__all__ = ["recording", "segment"]
