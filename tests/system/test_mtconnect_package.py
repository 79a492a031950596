"""The package of the connector mtconnect installs, is found by its entry point, and passes its tests."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.system.plugin import Environment

PACKAGE = Path(__file__).parents[2] / "examples" / "mtconnect"


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_the_package_works_where_it_is_installed(tmp_path: Path) -> None:
    environment = Environment(tmp_path / "environment", PACKAGE)
    checked = json.loads(environment.run("-m", "shmio.cli.supervisor", "check", "--json"))
    assert "http://127.0.0.1:5000" in checked["sources"][0].values()
    tests = environment.run("-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "2")
    assert " passed" in tests
    assert "failed" not in tests
