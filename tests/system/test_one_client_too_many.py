"""One client with the role read loads each endpoint: ``python -m tests.faults.one_client_too_many`` in short."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.one_client_too_many import ENDPOINTS, run, started

for library in ("uvicorn", "asyncua", "nats"):
    pytest.importorskip(library)


def test_one_client_takes_nothing_from_another(tmp_path: Path, instance: str) -> None:
    with started(tmp_path, instance) as (cell, place):
        found = {name: run(cell, place, name, 1.5, 0.2) for name in ENDPOINTS}
        assert {name: one.faults for name, one in found.items() if one.faults} == {}, cell.logs()
