"""Blocks that are read by the names of their members need no sizes of types; blocks that are read at addresses do."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.errors import LayoutError
from shmio.plan.prepare import Prepared, prepare

BLOCK = """DATA_BLOCK DB7 { S7_Optimized_Access := 'FALSE' } STRUCT
  a : Int; t : TON_TIME; z : Int; END_STRUCT; BEGIN END_DATA_BLOCK"""
BY_NAME = ["a", "t/PT", "t/ET", "t/IN", "t/Q", "z"]
SOURCE = '[instance]\nname = "timers"\n[[source]]\nname = "cell"\nlayout = "cell.db"\nconnector = '
OPCUA = f'{SOURCE}"opcua"\nurl = "opc.tcp://127.0.0.1:4841"\nnodes = "siemens"\n'
S7 = f'{SOURCE}"s7"\nhost = "127.0.0.1"\nport = 1102\ntimeout = 500\n'


def prepared(folder: Path, text: str, block: str = BLOCK) -> Prepared:
    (folder / "cell.db").write_text(block)
    (folder / "supervisor.toml").write_text(text)
    return prepare(folder / "supervisor.toml")


def test_a_block_read_by_names_needs_no_sizes(tmp_path: Path) -> None:
    found = prepared(tmp_path, OPCUA)
    assert [register.path for register in found.layouts["cell"].registers] == BY_NAME
    assert found.plan.warnings == ()


def test_a_block_read_at_addresses_loses_what_depends_on_an_unknown_size(tmp_path: Path) -> None:
    found = prepared(tmp_path, S7)
    assert [register.path for register in found.layouts["cell"].registers] == ["a"]
    assert any("TON_TIME" in warning and "type_bytes" in warning for warning in found.plan.warnings)
    sized = prepared(tmp_path, f"{S7}type_bytes = {{ TON_TIME = 16 }}\n").layouts["cell"]
    assert {register.path: register.offset for register in sized.registers} == {"a": 0, "t/bytes": 2, "z": 18}
    with pytest.raises(LayoutError, match="TON_TIME"):
        prepared(tmp_path, S7, BLOCK.replace("a : Int; ", ""))


def test_lists_of_older_tools_are_read_in_their_encoding(tmp_path: Path) -> None:
    (tmp_path / "tags.csv").write_bytes("path,type,address\n水泵,INT,%MW0\n".encode("gbk"))
    found = prepared(tmp_path, S7.replace("cell.db", "tags.csv") + 'encoding = "gbk"\n')
    assert [register.path for register in found.layouts["cell"].registers] == ["水泵"]
    with pytest.raises(LayoutError, match="line 2 is not in UTF-8"):
        prepared(tmp_path, S7.replace("cell.db", "tags.csv"))
