"""Clients that cause the same line repeatedly cannot fill the log."""

from __future__ import annotations

import logging

import pytest

from shmio.logs import MAX_LINES, TURN_S, LogRateLimit


def test_lines_of_a_kind_are_rate_limited_and_the_rest_is_counted(caplog: pytest.LogCaptureFixture) -> None:
    now_s = 100.0
    log = logging.getLogger("test.rate_limit")
    rate_limit = LogRateLimit(lambda: now_s)
    log.addFilter(rate_limit)
    try:
        for number in range(MAX_LINES + 5):
            log.warning("step failed: %s", number)
        log.warning("another kind: %s", 1)
        assert [record.getMessage() for record in caplog.records] == [
            *(f"step failed: {number}" for number in range(MAX_LINES)), "another kind: 1",
        ]  # fmt: skip
        caplog.clear()
        now_s += TURN_S
        for text in ("a", "b"):
            log.warning("step failed: %s", text)
        log.warning("another kind: %s", 2)
        assert [record.getMessage() for record in caplog.records] == [
            "step failed: a (5 similar lines before this one were left out)", "step failed: b", "another kind: 2",
        ]  # fmt: skip
    finally:
        log.removeFilter(rate_limit)
