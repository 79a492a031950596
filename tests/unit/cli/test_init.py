"""``shmio-supervisor init``: the configuration that it makes; what it prints is in test_supervisor.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.cli.instance.init import new_config, vacant_name
from shmio.config import load
from shmio.errors import ConfigError

DB = """DATA_BLOCK "Cell"
STRUCT
  speed : REAL;
END_STRUCT;
BEGIN
END_DATA_BLOCK
"""


def test_configuration_with_an_emulated_controller_is_complete(tmp_path: Path) -> None:
    source, file = tmp_path / "cell.db", tmp_path / "supervisor.toml"
    source.write_text(DB)
    text, missing, warnings = new_config(file, [source], emulated=True)
    file.write_text(text)
    config = load(file)
    assert (missing, warnings) == ({}, [])
    assert [source.name for source in config.source] == ["cell"]
    assert vacant_name(config.instance.name, tmp_path / "other.toml") == f"{config.instance.name}-2"


def test_missing_keys_of_a_real_controller_are_named(tmp_path: Path) -> None:
    source, file = tmp_path / "cell.db", tmp_path / "supervisor.toml"
    source.write_text(DB)
    assert new_config(file, [source]).missing == {file: ["host", "dbNumber"]}
    with pytest.raises(ConfigError, match="no data block 'other'"):
        new_config(file, [source], "other")
