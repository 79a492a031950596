from __future__ import annotations

import ast
import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from shmio.connectors.mqtt.link import PRIVATE_NAMES as SOURCE_NAMES
from shmio.endpoints.mqtt.connection.broker_client import PRIVATE_NAMES as BRIDGE_NAMES
from shmio.errors import ConfigError
from shmio.libraries import TESTED_PAHO, check_paho, skip_package_code

ROOT: Final = Path(__file__).parents[2]


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


PAHO: Final = {
    "shmio/endpoints/mqtt/connection/broker_client.py": BRIDGE_NAMES,
    "shmio/connectors/mqtt/link.py": SOURCE_NAMES,
}


def test_all_private_names_of_paho_are_listed() -> None:
    client = Client(CallbackAPIVersion.VERSION2)
    for file, names in PAHO.items():
        classes = [one for one in ast.parse((ROOT / file).read_text()).body if isinstance(one, ast.ClassDef)]
        (subclass,) = (one for one in classes if "Client" in map(ast.unparse, one.bases))
        used = {one.attr for one in ast.walk(subclass) if isinstance(one, ast.Attribute)}
        used |= {one.name for one in subclass.body if isinstance(one, ast.FunctionDef)}
        private = {name for name in used if re.match("_[a-z]", name) and hasattr(client, name)}
        assert sorted(private) == list(names), file
        check_paho(names)


def test_a_paho_without_a_private_name_is_refused_with_the_version_that_was_tested(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        patch.delattr(Client, "_packet_queue")
        with pytest.raises(ConfigError, match=r"^paho-mqtt 2\S+ does not have _packet_queue, .*==2\.2\.0$"):
            check_paho(BRIDGE_NAMES)


def test_the_tested_version_of_paho_is_the_locked_one() -> None:
    assert f"paho-mqtt=={TESTED_PAHO} " in (ROOT / "packaging" / "requirements.txt").read_text()
