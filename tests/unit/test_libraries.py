from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.libraries import skip_package_code


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Yield the name of a package whose own code fails, and that has the module ``part``."""
    name = "a_package_that_fails"
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text("raise RuntimeError('the code of the package')")
    (tmp_path / name / "part.py").write_text("from . import other\nVALUE = other.VALUE")
    (tmp_path / name / "other.py").write_text("VALUE = 5")
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    for module in [one for one in sys.modules if one.partition(".")[0] == name]:
        del sys.modules[module]


def test_modules_of_a_package_are_imported_without_its_code(package: str) -> None:
    with pytest.raises(RuntimeError):
        importlib.import_module(package)
    skip_package_code(package)
    assert importlib.import_module(f"{package}.part").VALUE == 5


def test_an_imported_or_missing_package_stays_as_it_is() -> None:
    before = sys.modules["json"]
    skip_package_code("json")
    skip_package_code("there_is_no_such_package")
    assert sys.modules["json"] is before
    assert "there_is_no_such_package" not in sys.modules
