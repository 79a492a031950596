"""A flood of calls to unknown methods: the short form of ``python -m tests.faults.flood``."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from shmio.testing.ports import reserved_port
from tests.faults import flood


def test_a_flood_of_unknown_calls_does_not_disturb_clients(tmp_path: Path, instance: str) -> None:
    with ExitStack() as stack:
        plc, plain, secure = (stack.enter_context(reserved_port()) for _ in range(3))
        cell, context = flood.prepare(tmp_path, instance, plc, plain, secure)
        stack.callback(cell.supervisor, "down")
        cell.up()
        seen = flood.run(cell, plain, secure, context, 2.0)
        assert seen.faults == [], f"{seen}\n{cell.logs()}"
