"""How connectors are found: the built-in ones, and those of installed packages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shmio.cli.supervisor import main
from shmio.connectors import registry
from shmio.connectors.base import Connector
from shmio.errors import ConfigError

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "cell"
connector = "{connector}"
layout = "tags.toml"
{keys}
"""
Offer = Callable[[str, str], None]
Check = Callable[..., str]


@pytest.fixture
def offer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Offer:
    """Install the metadata of a package that offers a connector."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)

    def install(package: str, name: str) -> None:
        info = folder / f"{package}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        points = f"[shmio.connectors]\n{name} = shmio.connectors.modbus.connector:ModbusConnector\n"
        (info / "entry_points.txt").write_text(points)

    return install


@pytest.fixture
def check(tmp_path: Path, instance: str, capsys: pytest.CaptureFixture[str]) -> Check:
    """Check a configuration with one source; return the errors."""

    def run(connector: str, keys: str) -> str:
        (tmp_path / "tags.toml").write_text('registers.speed = { type = "REAL", address = "holding 0" }')
        config = tmp_path / "supervisor.toml"
        config.write_text(CONFIG.format(instance=instance, connector=connector, keys=keys))
        status = main(["check", "-c", str(config)])
        errors = capsys.readouterr().err
        assert (status == 0) == (not errors)
        return errors

    return run


def test_a_package_offers_a_connector(offer: Offer, check: Check) -> None:
    offer("alpha", "fieldbus")
    assert "fieldbus" in registry.names()
    assert check("fieldbus", 'host = "127.0.0.1"') == ""
    assert "did you mean" in check("fieldbuss", "")


def test_a_package_with_the_name_of_a_built_in_connector(offer: Offer, check: Check) -> None:
    """The package never replaces the built-in connector, and ``check`` reports that."""
    offer("alpha", "modbus")
    error = check("modbus", 'host = "127.0.0.1"')
    assert "source[0].connector: 'modbus' is a connector of shmio, and alpha offers another one" in error
    assert "pip uninstall alpha" in error
    assert registry.load("modbus").__module__ == "shmio.connectors.modbus.connector"
    assert check("memory", "") == "", "other connectors are not concerned"


def test_a_connector_that_needs_a_package_of_its_own(check: Check) -> None:
    errors = check("mtconnect", "")
    assert "source[0].connector: connector 'mtconnect' is a separate package" in errors
    assert "pip install ./examples/mtconnect" in errors
    with pytest.raises(ConfigError, match=r"pip install \./examples/mtconnect"):
        registry.load("mtconnect")


def test_two_packages_with_the_same_connector(offer: Offer, check: Check) -> None:
    offer("beta", "fieldbus")
    offer("alpha", "fieldbus")
    assert "alpha and beta each offer a connector 'fieldbus'" in check("fieldbus", 'host = "127.0.0.1"')
    with pytest.raises(ConfigError, match="alpha and beta"):
        registry.load("fieldbus")


@pytest.mark.parametrize("name", ["modbus", "mqtt", "opcua", "ros2", "rosbridge", "s7"])
def test_each_connector_to_a_device_keeps_its_connection_in_a_reload(name: str) -> None:
    found = registry.load(name)
    assert issubclass(found, Connector)
    assert found.register_options is not None
    assert found.register_options <= set(found.Options.__struct_fields__)
    assert found.take_over is not Connector.take_over


@pytest.mark.parametrize(
    ("name", "keys", "words"),
    [
        ("opcua", {"url": "opc.tcp://plc", "mode": "pol"}, "mode: unknown mode 'pol'; did you mean 'poll'"),
        ("mqtt", {"url": "mqtt://broker", "version": "7"}, "version: unknown version '7'; valid: auto, 5, 3.1.1"),
        ("ros2", {"qos": {"reliability": "firm"}}, "qos.reliability: .*best_effort"),
    ],
)
def test_a_wrong_word_is_reported_with_the_valid_ones(name: str, keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        registry.convert_options(name, keys)
