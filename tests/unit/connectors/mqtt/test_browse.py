"""``shmio-supervisor browse``: a broker's topics, as a tree and as a tag table that a source can read."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from shmio.cli import supervisor
from shmio.connectors.mqtt.connector import MqttConnector
from shmio.connectors.mqtt.options import MqttOptions
from shmio.layout.compiler import Source as SourceFile
from shmio.layout.compiler import compile_sources
from shmio.model.statuses import GOOD
from tests.unit.connectors.mqtt.conftest import Plant
from tests.unit.connectors.mqtt.peer import Peer
from tests.unit.connectors.source import Source

TREE = """\
b
  lamp 1
    value  BOOL  b/lamp 1
    name  STRING  b/lamp 1/name
  pos  LREAL  b/pos
  raw  (its payload is binary, or text that is too long)
  state
    axes
      0
        pos  LREAL  b/state $.axes[0].pos
        on  BOOL  b/state $.axes[0].on
    list  ARRAY[0..2] OF LREAL  b/state $.list
    my.name  STRING  b/state $['my.name']
    none  (it is null, so its type is unknown)
Line 1
  cell
    robot
      Axis
        Pos  LREAL  sparkplug Line 1/cell/robot metric Axis/Pos
      count  INT  sparkplug Line 1/cell/robot metric count
"""


@pytest.fixture(scope="module")
def device(plant: Plant) -> Peer:
    peer = plant.device
    peer.publish("b/pos", "12.5", retain=True)
    peer.publish("b/lamp 1", "ON", retain=True)
    peer.publish("b/lamp 1/name", "left", retain=True)
    peer.ask("publish", "b/raw", {"hex": "ff00"}, {"retain": True, "qos": 1})
    state = {"axes": [{"pos": 1, "on": True}], "list": [1, 2.5, 3], "my.name": "x", "none": None}
    peer.publish("b/state", state, retain=True)
    metrics = [
        {"name": "Axis/Pos", "type": "Double", "value": 1.5, "alias": 1},
        {"name": "count", "type": "Int16", "value": 3, "alias": 2},
    ]
    birth = {"topic": "spBv1.0/Line 1/DBIRTH/cell/robot", "payload": {"timestamp": 1, "seq": 1, "metrics": metrics}}
    peer.ask("repeat_sparkplug", [birth], 20)
    return peer


def browse(plant: Plant, *arguments: object) -> int:
    return supervisor.main(["browse", f"mqtt://{plant.address}", *map(str, arguments), "--set", "timeout=300"])


def test_the_tree(plant: Plant, device: Peer, capsys: pytest.CaptureFixture[str]) -> None:
    assert browse(plant) == 0
    assert sorted(capsys.readouterr().out.splitlines()) == sorted(TREE.splitlines())
    assert browse(plant, "b/state/axes/**", "b/p*") == 0
    shown = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert sorted(shown) == sorted(["b", "pos", "state", "axes", "0", "pos", "on"])
    assert browse(plant, "--limit", 2) == 1
    assert "select some of them by a PATTERN" in capsys.readouterr().err


def test_the_table_can_be_read(plant: Plant, device: Peer, tmp_path: Path) -> None:
    table = tmp_path / "tags.toml"
    assert browse(plant, "b", "-o", table) == 0
    layout = compile_sources([SourceFile(str(table), table.read_bytes())]).layouts[0].with_statuses()
    options = msgspec.convert({"url": f"mqtt://{plant.address}", "max_age_ms": 0}, MqttOptions)
    connector = MqttConnector(options, layout)
    try:
        connector.connect()
        source = Source(connector, layout)
        source.until(lambda: all(source.code(register.path) == GOOD for register in layout.registers))
        assert source.value("b/state/list") == [1.0, 2.5, 3.0]
        assert source.value("b/lamp 1/value") is True
    finally:
        connector.close()


def test_a_broker_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert supervisor.main(["browse", "mqtt://127.0.0.1:1", "--set", "timeout=300"]) == 1
    assert "refused" in capsys.readouterr().err
