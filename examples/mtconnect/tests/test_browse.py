"""``shmio-supervisor browse`` lists the data items of an agent, and the connector reads the table that it writes."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from agent import Agent
from shmio.cli import supervisor
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout
from shmio.layout.values.codec import codec
from shmio.model.statuses import StatusArea
from shmio_mtconnect.connector import MTConnectConnector, MTConnectOptions

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "cnc"
connector = "mtconnect"
layout = "tags.toml"
url = "{url}"
"""
TREE = """\
VMC
  avail  STRING[120]  avail
  base
    X
      act  LREAL  Xact  mm
    Y
      act  LREAL  Yact  mm
  controller
    path
      exec  STRING[120]  exec
      program  STRING[120]  prog
      count  UDINT  count
      copy  LREAL  copy
      pos  ARRAY[0..2] OF LREAL  pos  mm
      door  STRING[120]  door
      vib  (write an ARRAY with as many of the newest values of the series as you need)
      set  (data sets and tables are not supported)
      hyd  USINT  hyd
"""


def good(layout: Layout, image: bytes) -> bool:
    """Return whether all registers of an image are good."""
    area = StatusArea(layout)
    return not any(area.get(image, at).code for at in range(len(layout.registers)))


def test_the_tree_and_the_table(tmp_path: Path, instance: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The table has the types and units of the probe. ``check`` accepts it, and all its values arrive."""
    table, config = tmp_path / "tags.toml", tmp_path / "supervisor.toml"
    with Agent() as agent:
        url = f"http://{agent.address}"
        browse = ["browse", "--connector", "mtconnect", url]
        assert supervisor.main(browse) == 0
        assert capsys.readouterr().out == TREE
        assert supervisor.main([*browse, "VMC/base", "VMC/controller", "-o", str(table)]) == 0
        config.write_text(CONFIG.format(instance=instance, url=url))
        assert supervisor.main(["check", "-c", str(config)]) == 0
        layout = compile_sources([Source(str(table), table.read_bytes())]).layouts[0].with_statuses()
        agent.set(Xact="1.5", Yact="2.5", exec="ACTIVE", prog="O1", count="7", copy="3", pos="1 2 3", door="OPEN")
        agent.condition("hyd", "Fault", "E7", "low")
        connector = MTConnectConnector(MTConnectOptions(url=url, interval=5, heartbeat=50), layout)
        try:
            connector.connect()
            end = time.monotonic() + 10
            while not good(layout, image := connector.read()):
                assert time.monotonic() < end
            found = {one.path: codec(one, "little").decode(image) for one in layout.registers}
        finally:
            connector.close()
    assert found == {
        "VMC/base/X/act": 1.5, "VMC/base/Y/act": 2.5, "VMC/controller/path/exec": "ACTIVE",
        "VMC/controller/path/program": "O1", "VMC/controller/path/count": 7, "VMC/controller/path/copy": 3.0,
        "VMC/controller/path/pos": [1.0, 2.0, 3.0], "VMC/controller/path/door": "OPEN", "VMC/controller/path/hyd": 2,
    }  # fmt: skip


def test_an_agent_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    """The error names the address."""
    assert supervisor.main(["browse", "--connector", "mtconnect", "http://127.0.0.1:1"]) == 1
    assert "127.0.0.1:1" in capsys.readouterr().err
