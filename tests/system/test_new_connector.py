"""``shmio-supervisor new-connector``: the package that it writes works as it is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from shmio.cli.supervisor import main
from tests.system.plugin import Environment


def test_the_new_package_passes_its_tests_and_check_finds_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new-connector", "acme-bus_2", "-o", str(tmp_path / "new")]) == 0
    assert "pip install" in capsys.readouterr().out
    texts = [file.read_text() for file in (tmp_path / "new").rglob("*") if file.is_file()]
    assert texts
    assert not [text for text in texts if "fieldbus" in text.lower()]

    environment = Environment(tmp_path / "environment", tmp_path / "new")
    checked = json.loads(environment.run("-m", "shmio.cli.supervisor", "check", "--json"))
    assert "127.0.0.1:7007" in checked["sources"][0].values()
    tests = environment.run("-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "2")
    assert "23 passed, 5 skipped" in tests, "a reload restarts its sources, so that 5 tests do not apply"


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("modbus", "'modbus' is a connector of shmio; choose another name"),
        ("../bus", "is not a name for a connector"),
        ("Bus", "lower-case letters"),
        ("a" * 41, "at most 40"),
        ("bus-", "is not a name for a connector"),
        ("ärger", "is not a name for a connector"),
    ],
)
def test_names_that_cannot_be(
    name: str, error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new-connector", name]) == 1
    assert error in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_there_is_left_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("shmio-my-bus").mkdir()
    assert main(["new-connector", "my_bus"]) == 1
    assert "shmio-my-bus exists already" in capsys.readouterr().err
    assert not list(Path("shmio-my-bus").iterdir())
