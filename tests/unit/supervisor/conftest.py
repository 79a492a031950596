"""Fixtures of the supervisor's tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.unit.supervisor.harness import CELL, Job, Launch, Launched


@pytest.fixture
def launch(instance: str, tmp_path: Path, runtime: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Launch]:
    """Return a function that starts an instance with the given jobs and limits."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    launched: list[Launched] = []

    def start(jobs: list[Job] = CELL, **limits: Any) -> Launched:
        launched.append(Launched(instance, tmp_path, jobs, limits))
        return launched[-1]

    yield start
    for one in launched:  # stop all of them before clearing
        one.process.kill()
        one.process.wait()
    for one in launched:
        one.close()
