"""Clients that cause the same line repeatedly cannot fill the log."""

from __future__ import annotations

import logging
import sys
from contextlib import suppress
from types import SimpleNamespace
from typing import NoReturn, cast

import pytest

from shmio.connectors import __main__ as source_process
from shmio.logs import MAX_LINES, TURN_S, LogRateLimit, rate_limited
from shmio.worker import Worker


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


def test_the_last_line_of_a_kind_is_written_when_no_other_one_comes(caplog: pytest.LogCaptureFixture) -> None:
    """As for a source whose quality often changes, and then stays bad."""
    now_s = 100.0
    log = logging.getLogger("test.rate_limit")
    rate_limit = LogRateLimit(lambda: now_s)
    log.addFilter(rate_limit)
    try:
        for number in range(MAX_LINES + 5):
            log.warning("bad: %s", number)
            caplog.clear()
        rate_limit.write_last(log)
        assert not caplog.records
        now_s += TURN_S
        for _ in range(2):
            rate_limit.write_last(log)
            assert [record.getMessage() for record in caplog.records] == [
                f"bad: {MAX_LINES + 4} (4 similar lines before this one were left out)"
            ]
        for number in range(MAX_LINES):
            log.warning("bad: %s", number)
        assert len(caplog.records) == MAX_LINES, "it counts in its interval"
        now_s += TURN_S
        log.warning("bad: %s", "again")
        assert caplog.messages[-1] == "bad: again (1 similar lines before this one were left out)"
        caplog.clear()
        now_s += TURN_S
        rate_limit.write_last(log)
        assert not caplog.records, "nothing was left out since"
    finally:
        log.removeFilter(rate_limit)


def test_all_lines_of_another_library_are_of_one_kind(caplog: pytest.LogCaptureFixture) -> None:
    for name, written in (("library", MAX_LINES), ("shmio.test", 2 * MAX_LINES)):
        log = logging.getLogger(name)
        caplog.clear()
        with rate_limited(name, "another"):
            for number in range(MAX_LINES):
                log.warning(f"failure {number}")
                log.warning(f"error {number}")
        assert len(caplog.records) == written
        assert not log.filters


@pytest.mark.parametrize("logger", ["shmio.source", "shmio.source.mqtt", "shmio.fabric", "nats", "asyncio"])
def test_a_device_cannot_fill_the_log_of_its_source(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, logger: str
) -> None:
    def flood(worker: Worker) -> NoReturn:
        for number in range(3 * MAX_LINES):
            logging.getLogger(logger).warning("malformed message %d", number)
        raise EOFError

    monkeypatch.setattr(source_process, "_loop_of", flood)
    monkeypatch.setattr(sys, "setswitchinterval", lambda _: None)
    worker = SimpleNamespace(on_stop=lambda _: None, on_reread=lambda _: None)
    with suppress(EOFError):
        source_process.run(cast("Worker", worker))
    assert len(caplog.records) == MAX_LINES
