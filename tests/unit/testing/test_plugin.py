"""The pytest plugin: what goes wrong with the evidence of a failed test."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

CELL = """
import pytest
from shmio.testing import plugin

class Cell:
    folder = {folder!r}
    def keep(self):
        {keep}

@pytest.fixture
def broken(request):
    request.node.stash[plugin._CELL] = Cell()

def test_one(broken):
    assert 1 == 2

def test_other():
    pass
"""


@pytest.mark.parametrize("keep", ["raise ZeroDivisionError('float division by zero')", "return 'recording: x.mem'"])
def test_evidence_that_cannot_be_kept_costs_no_result(pytester: pytest.Pytester, tmp_path: Path, keep: str) -> None:
    pytester.makepyfile(CELL.format(folder=str(tmp_path / "missing"), keep=keep))
    found = pytester.inline_run("--shmio-keep", "/proc/none")
    found.assertoutcome(passed=1, failed=1)
    (report,) = found.getfailures()
    assert "not kept: " in dict(report.sections)["shmio"]
