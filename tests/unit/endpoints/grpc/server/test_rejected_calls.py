"""A client at fault does not fill the log, and nothing is forgotten."""

from __future__ import annotations

import asyncio
import logging

import pytest

from shmio.endpoints.grpc.server.rejected_calls import LINES, Refusals


def test_a_turn_has_few_lines_and_the_rest_is_told_at_its_end(caplog: pytest.LogCaptureFixture) -> None:
    async def test() -> None:
        refusals = Refusals(turn_s=0.01)
        for number in range(3 * LINES):
            refusals.add(f"reason {number}", "cell/a", "ipv4:127.0.0.1:5")
        assert refusals.count == 3 * LINES
        assert [record.getMessage() for record in caplog.records] == [
            f"publish refused: reason {number}" for number in range(LINES)
        ]
        async with asyncio.timeout(20):
            while len(caplog.records) <= LINES:  # noqa: ASYNC110  the log is what is waited for
                await asyncio.sleep(0)
        assert caplog.records[-1].getMessage() == f"publish refused: {2 * LINES} more in 0.01 s"
        refusals.add("once more", "cell/a", "ipv4:127.0.0.1:5")
        assert caplog.records[-1].getMessage() == "publish refused: once more"

    with caplog.at_level(logging.WARNING):
        asyncio.run(test())
