"""The copy of a configuration that a test runs."""

from __future__ import annotations

import tomllib
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from shmio.errors import ConfigError
from shmio.testing.own_configuration import OwnConfiguration

PLANT = """
[instance]
name = "a-name-of-forty-characters-is-the-longest"
log_dir = "/var/log/plant"

[[source]]
name = "cell"
connector = "s7"
layout = "../shared/door \\"1\\".db"
host = "localhost"
port = 1102

[[source]]
name = "press"
connector = "opcua"
url = "opc.tcp://127.0.0.1:4840/path"

[[source]]
name = "other"
connector = "opcua"
url = "opc.tcp://127.0.0.1:48401"

[[emulator]]
name = "plc"
kind = "s7"
listen = "127.0.0.1:1102"

[[emulator]]
name = "server"
kind = "opcua"
listen = "127.0.0.1:4840"

[grpc]
listen = ["0.0.0.0:8089", "unix:grpc.sock"]

[recorder]
directory = "/plant/dumps"

[[alert]]
name = "call"
"""


def copied(tmp_path: Path, text: str, **keywords: Any) -> tuple[OwnConfiguration, dict[str, Any]]:
    plant, own = tmp_path / "plant", tmp_path / "own"
    plant.mkdir()
    own.mkdir()
    (plant / "plant.toml").write_text(text)
    (plant / "model.py").write_text("")
    with ExitStack() as cleanup:
        found = OwnConfiguration(plant / "plant.toml", own, cleanup, **keywords)
    return found, tomllib.loads(found.file.read_text())


def test_names_addresses_and_folders_are_the_tests_own(tmp_path: Path) -> None:
    found, tables = copied(tmp_path, PLANT)
    plc, server = (one["listen"] for one in tables["emulator"])
    assert len(found.name) == 40
    assert tables["instance"] == {"name": found.name, "log_dir": "logs"}
    assert plc not in ("127.0.0.1:1102", server)
    cell, press, other = tables["source"]
    assert f"{cell['host']}:{cell['port']}" == plc
    assert press["url"] == f"opc.tcp://{server}/path"
    assert other["url"] == "opc.tcp://127.0.0.1:48401"
    assert cell["layout"] == str(tmp_path / 'shared/door "1".db')
    grpc, socket = tables["grpc"]["listen"]
    assert grpc.startswith("127.0.0.1:")
    assert grpc != "127.0.0.1:8089"
    assert socket == "unix:grpc.sock"
    assert not tables.keys() & {"recorder", "alert"}
    assert (found.file.parent / "model.py").is_symlink()
    assert not found.virtual


@pytest.mark.parametrize(("real_time", "clock"), [(False, "stepped"), (True, None)])
def test_time_is_virtual_if_all_sources_are_computed(tmp_path: Path, real_time: bool, clock: str | None) -> None:
    text = '[instance]\nname = "a"\n[[source]]\nname = "m"\nconnector = "memory"\nlayout = "m.toml"\n'
    found, tables = copied(tmp_path, text, real_time=real_time)
    assert found.virtual is not real_time
    assert tables["instance"].get("clock") == clock


def test_a_file_without_an_instance_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="instance"):
        copied(tmp_path, '[[source]]\nname = "m"\n')
