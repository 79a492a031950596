"""Times as text."""

from __future__ import annotations

import time

import pytest

from shmio.times import local_text, utc_text

TIME_S = 1_795_795_393.833717


def test_utc_and_local_time(monkeypatch: pytest.MonkeyPatch) -> None:
    assert utc_text(TIME_S) == "2026-11-27T16:03:13.833717Z"
    assert utc_text(TIME_S, "seconds") == "2026-11-27T16:03:13Z"
    try:
        with monkeypatch.context() as context:
            context.setenv("TZ", "UTC-5:30")  # as POSIX writes it: east of Greenwich
            time.tzset()
            assert local_text(TIME_S) == "2026-11-27 21:33:13.833"
            assert local_text(TIME_S, "seconds") == "2026-11-27 21:33:13"
    finally:
        time.tzset()
