"""Structures of a server: members as registers, optional members, unions, arrays, and what browse writes."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from shmio.cli import supervisor
from shmio.connectors.browsing import Wanted
from shmio.connectors.opcua.connector import OpcUaConnector
from shmio.connectors.opcua.options import OpcUaOptions
from shmio.errors import ConfigError
from shmio.layout.compiler import Source as File
from shmio.layout.compiler import compile_sources
from shmio.layout.tags import place_tags
from shmio.layout.topic import find
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import encode
from shmio.model.statuses import (
    BAD_DECODING_ERROR,
    BAD_NO_DATA,
    BAD_TYPE_MISMATCH,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    status_area,
)
from shmio.testing.write_conformance import write
from tests.unit.connectors.opcua.device import Device
from tests.unit.connectors.opcua.harness import connected, until
from tests.unit.connectors.opcua.node_server import NodeServer

MODES = pytest.mark.parametrize("mode", ["subscribe", "poll"])
AXIS = [("Position", "Double", ""), ("Name", "String", ""), ("Homed", "Boolean", "")]
PUMP = [
    ("Count", "Int32", ""), ("State", "State", ""), ("Axis", "Axis", ""), ("Axes", "Axis", "array"),
    ("Forces", "UInt16", "array"), ("Hint", "Double", "optional"), ("Spare", "Int16", "optional"),
    ("When", "DateTime", ""),
]  # fmt: skip
VALUE: dict[str, Any] = {
    "Count": -3, "State": 1, "Axis": ["Axis", {"Position": 1.5, "Name": "Größe", "Homed": True}],
    "Axes": ["Axis", {"Position": 2.5, "Name": "a"}, {"Position": 3.5, "Name": "b"}],
    "Forces": [7, 8, 9], "Spare": 12,
}  # fmt: skip
TABLE: dict[str, Any] = {
    "count": {"type": "DINT", "address": "ns=2;s=pump#Count"},
    "state": {"type": "DINT", "address": "ns=2;s=pump#State"},
    "position": {"type": "REAL", "address": "/Objects/2:Device/2:pump#Axis.Position", "scale": 10},
    "name": {"type": "STRING[20]", "address": "ns=2;s=pump#Axis.Name"},
    "homed": {"type": "BOOL", "address": "ns=2;s=pump#Axis.Homed"},
    "second": {"type": "LREAL", "address": "ns=2;s=pump#Axes[1].Position"},
    "forces": {"type": "ARRAY[1..3] OF INT", "address": "ns=2;s=pump#Forces"},
    "force": {"type": "INT", "address": "ns=2;s=pump#Forces[2]"},
    "hint": {"type": "LREAL", "address": "ns=2;s=pump#Hint"},
    "spare": {"type": "INT", "address": "ns=2;s=pump#Spare"},
}
VALUES = {
    "count": -3, "state": 1, "position": 15.0, "name": "Größe", "homed": True, "second": 3.5, "forces": [7, 8, 9],
    "force": 9, "spare": 12,
}  # fmt: skip


@pytest.fixture(scope="module")
def server() -> Iterator[Device]:
    with Device() as device:
        device.ask("enumerate", "State", "Off", "On")
        device.ask("define", "Axis", AXIS)
        device.ask("define", "Pump", PUMP)
        device.ask("define", "Either", [("Whole", "Int32", ""), ("Text", "String", "")], True)
        device.ask("structure", "pump", "Pump", VALUE)
        device.ask("structure", "axes", "Axis", [{"Position": 1.0, "Name": "x"}, {"Position": 2.0, "Name": "y"}])
        yield device


@MODES
def test_members_are_registers(server: Device, mode: str) -> None:
    with connected(server.url, TABLE, mode=mode) as source:
        image = source.connector.read()
        statuses = {path: source.status(path, image) for path in TABLE}
        assert {path: one.code for path, one in statuses.items()} == dict.fromkeys(TABLE, GOOD) | {"hint": BAD_NO_DATA}
        assert {path: source.value(path, image) for path in VALUES} == VALUES
        assert all(statuses[path].source_ns > 0 for path in VALUES)
        assert "2 nodes" in source.connector.describe(), "one by node id, one by browse path"
        server.ask("structure", "pump", "Pump", VALUE | {"Count": 4, "Hint": 0.5, "Axes": []})
        try:
            until(lambda: source.value("count") == 4, "a change")
            image = source.connector.read()
            assert (source.value("hint", image), source.status("hint", image).code) == (0.5, GOOD)
            assert source.status("second", image).code == BAD_NO_DATA, "the array has become shorter"
        finally:
            server.ask("structure", "pump", "Pump", VALUE)


def test_arrays_of_structures(server: Device) -> None:
    tags = {
        "y": {"type": "STRING[8]", "address": "ns=2;s=axes#[1].Name"},
        "z": {"type": "STRING[8]", "address": "ns=2;s=axes#[2].Name"},
    }
    with connected(server.url, tags) as source:
        assert source.value("y") == "y"
        assert source.status("z").code == BAD_NO_DATA


STANDARD: dict[str, tuple[str, Any]] = {
    "limits": ("Range", {"Low": -1.5, "High": 20.0}),
    "unit": ("EUInformation", {"NamespaceUri": "urn:u", "UnitId": 4408652}),
    "axis": ("AxisInformation", {"EURange": ["Range", {"Low": 0.0, "High": 7.0}], "AxisSteps": [1.0, 2.0]}),
}


def test_structures_of_the_standard_need_no_definition(server: Device) -> None:
    """The server, like most, has no DataTypeDefinition for them: OPC 10000-8, sections 5.6.2 and 5.6.3."""
    for name, (kind, value) in STANDARD.items():
        server.ask("add", name, kind, value)
    tags = {
        "low": {"type": "LREAL", "address": "ns=2;s=limits#Low"},
        "high": {"type": "REAL", "address": "ns=2;s=limits#High"},
        "unit id": {"type": "DINT", "address": "ns=2;s=unit#UnitId"},
        "uri": {"type": "STRING[20]", "address": "ns=2;s=unit#NamespaceUri"},
        "most": {"type": "LREAL", "address": "ns=2;s=axis#EURange.High"},
        "step": {"type": "LREAL", "address": "ns=2;s=axis#AxisSteps[1]"},
    }
    with connected(server.url, tags) as source:
        assert {path: source.value(path) for path in tags} == {
            "low": -1.5, "high": 20.0, "unit id": 4408652, "uri": "urn:u", "most": 7.0, "step": 2.0,
        }  # fmt: skip
        assert source.write("high", 25.0) == ""
        assert (source.value("low"), source.value("high")) == (-1.5, 25.0)
    found = OpcUaConnector.browse(OpcUaOptions(url=server.url), Wanted(("Device/limits/*", "Device/axis/**")))
    assert {one.names[-1]: one.type for one in found.offers} == {
        "Low": "LREAL", "High": "LREAL", "NamespaceUri": "STRING", "UnitId": "DINT", "DisplayName": "STRING",
        "Description": "STRING", "Title": "STRING", "AxisScaleType": "DINT", "AxisSteps": "ARRAY[0..1] OF LREAL",
    }  # fmt: skip


def test_another_definition_makes_members_bad_by_name(server: Device, caplog: pytest.LogCaptureFixture) -> None:
    tags = {
        "gone": {"type": "INT", "address": "ns=2;s=pump#Axis.Speed"},
        "wrong": {"type": "BOOL", "address": "ns=2;s=pump#Count"},
        "group": {"type": "INT", "address": "ns=2;s=pump#Axis"},
        "inside": {"type": "INT", "address": "ns=2;s=pump#Count.Low"},
        "single": {"type": "INT", "address": "ns=2;s=pump#Count[0]"},
        "count": {"type": "DINT", "address": "ns=2;s=pump#Count"},
    }
    with connected(server.url, tags) as source:
        codes = {path: source.status(path).code for path in tags}
    assert codes == dict.fromkeys(tags, BAD_TYPE_MISMATCH) | {"count": GOOD}
    said = {record.getMessage().partition(":")[0]: record.getMessage() for record in caplog.records}
    assert "Axis has no member Speed; it has Position, Name, Homed" in said["gone"]
    assert "Int32" in said["wrong"]
    assert "the structure Axis; give the address of a member" in said["group"]
    assert "Count is a Int32, which has no member Low" in said["inside"]
    assert "no element [0]" in said["single"]
    assert "count" not in said


def test_a_structure_that_comes_later_is_read(server: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.connectors.opcua.session.RETRY_S", 0.05)
    server.ask("define", "Valve", [("Open", "Boolean", "")])
    tags = {
        "open": {"type": "BOOL", "address": "ns=2;s=valve#Open"},
        "state": {"type": "INT", "address": "ns=2;s=state#X"},
    }
    server.ask("add", "state", "ExtensionObject", "00")
    with connected(server.url, tags) as source:
        assert source.status("state").code == BAD_DECODING_ERROR, "the server defines no such structure"
        assert source.status("open").code not in (GOOD, BAD_WAITING_FOR_INITIAL_DATA)
        server.ask("structure", "valve", "Valve", {"Open": True})
        until(lambda: source.status("open").code == GOOD and source.value("open") is True, "the structure")


@MODES
def test_a_reload_changes_members_and_reads_definitions_again(
    server: Device, mode: str, caplog: pytest.LogCaptureFixture
) -> None:
    server.ask("define", f"Tank{mode}", [("Level", "Int32", ""), ("Limit", "Int32", "")])
    server.ask("structure", f"tank{mode}", f"Tank{mode}", {"Level": 5, "Limit": 9})
    level, limit, high = (
        {"type": "DINT", "address": f"ns=2;s=tank{mode}#{member}"} for member in ("Level", "Limit", "High")
    )
    with connected(server.url, {"level": level}, mode=mode) as source:
        assert source.value("level") == 5
        source.reload({"limit": limit, "level": level, "count": TABLE["count"]})
        image = source.connector.read()
        assert (source.value("limit", image), source.value("level", image)) == (9, 5)
        until(lambda: source.status("count").code == GOOD, "the new structure")
        server.ask("rename", f"Tank{mode}", "Limit", "High")  # the encoding stays the same
        source.reload({"high": high, "level": level})
        image = source.connector.read()
        assert (source.value("high", image), source.value("level", image)) == (9, 5)
    assert not caplog.records


@MODES
def test_members_are_written_with_the_rest_of_their_structure(server: Device, mode: str) -> None:
    tags = TABLE | {
        "first": {"type": "LREAL", "address": "ns=2;s=pump#Axes[0].Position"},
        "x": {"type": "STRING[8]", "address": "ns=2;s=axes#[0].Name"},
        "y": {"type": "LREAL", "address": "ns=2;s=axes#[1].Position"},
    }
    for node in ("pump", "axes"):
        server.ask("allow", node)
    with connected(server.url, tags, mode=mode, timeout=4000) as source:
        before = source.connector.read()
        writes = server.ask("writes")
        values: dict[str, Value] = {"count": 77, "force": 5, "second": 9.25}
        assert source.write_all(values) == [""] * 3
        assert server.ask("writes") == writes + 1, "one write for all members"
        image = source.connector.read()  # the members that were not written are as before
        expected = {path: source.value(path, before) for path in VALUES} | values | {"forces": [7, 8, 5]}
        assert {path: source.value(path, image) for path in VALUES} == expected
        assert source.write("forces", [1, 2, 3]) == ""
        assert source.write("name", "longer than before") == ""
        assert source.value("name") == "longer than before"
        assert source.write("position", -30) == ""  # it is scaled by 10
        element = source.layout.element(source.layout.registers[source.layout.by_path["forces"]], (2,))
        assert write(source.connector, encode(element, 40, source.layout.byte_order)) == [""]
        image = source.connector.read()
        assert (source.value("forces", image), source.value("position", image)) == ([1, 40, 3], -30)
        outcomes = source.write_all({"hint": 1.0, "homed": False, "first": 7.5})
        assert "at present" in outcomes[0]
        assert outcomes[1:] == ["", ""]
        assert source.value("homed") is False
        assert source.write_all({"x": "new", "y": -1.5}) == ["", ""]
        assert [source.value("x"), source.value("y")] == ["new", -1.5]
        twice = [encode(source.layout.registers[source.layout.by_path["count"]], one, "little")[0] for one in (1, 2)]
        writes = server.ask("writes")
        assert write(source.connector, twice) == ["", ""]
        assert (server.ask("writes"), source.value("count")) == (writes + 2, 2)  # both values of a pulse
        server.ask("allow", "axes", False)
        (refusal,) = source.write_all({"x": "no"})
        assert "x: the server refuses the structure: Bad" in refusal
        assert source.value("x") == "new"
    server.ask("structure", "pump", "Pump", VALUE)


def test_a_union_has_one_member(server: Device) -> None:
    server.ask("structure", "either", "Either", {"Text": "now"})
    tags = {
        "whole": {"type": "DINT", "address": "ns=2;s=either#Whole"},
        "text": {"type": "STRING[9]", "address": "ns=2;s=either#Text"},
    }
    with connected(server.url, tags) as source:
        assert (source.value("text"), source.status("whole").code) == ("now", BAD_NO_DATA)
        server.ask("structure", "either", "Either", {"Whole": 5})
        until(lambda: source.status("whole").code == GOOD and source.value("whole") == 5, "the other member")
        assert source.status("text").code == BAD_NO_DATA


@pytest.mark.parametrize(
    ("tag", "words"),
    [
        ({"address": "ns=2;s=a#B", "deadband": 1}, "no dead-band"),
        ({"address": "ns=2;s=a#B..C"}, "the path of the member is wrong at '..C'"),
        ({"address": "ns=2;s=a#"}, "## for a # of the identifier"),
    ],
)
def test_wrong_addresses(tag: dict[str, Any], words: str) -> None:
    layout = place_tags("device", {"a": {"type": "INT", **tag}}).with_statuses()
    with pytest.raises(ConfigError, match="a: ") as raised:
        OpcUaConnector(OpcUaOptions(url="opc.tcp://127.0.0.1:1"), layout)
    assert words in str(raised.value)


def test_a_write_of_members_changes_no_other_member(server: Device) -> None:
    """After random writes of members, the whole structure is as the server had it, but for what was written."""
    drawn = random.Random(7)
    new: dict[str, Callable[[], Any]] = {
        "count": lambda: drawn.randrange(-(1 << 31), 1 << 31), "position": lambda: drawn.randrange(100) * 10.0,
        "name": lambda: "".join(drawn.choices("abcü", k=drawn.randrange(20))), "homed": lambda: drawn.random() < 0.5,
        "second": drawn.random, "spare": lambda: drawn.randrange(1 << 15), "forces/1": lambda: drawn.randrange(1 << 15),
        "forces/2..3": lambda: [drawn.randrange(1 << 15), 5],
    }  # fmt: skip
    now: dict[str, Any] = dict(VALUES)
    server.ask("structure", "pump", "Pump", VALUE)
    _, _, when = server.ask("get", "pump").partition("When=")
    server.ask("allow", "pump")
    try:
        with connected(server.url, TABLE) as source:
            until(lambda: source.value("count") == VALUE["Count"], "the structure as it was")
            for _ in range(40):
                written = {path: new[path]() for path in drawn.sample(sorted(new), drawn.randrange(1, 4))}
                writes = [
                    one
                    for path, value in written.items()
                    for one in encode(find(source.layout, path), value, source.layout.byte_order)
                ]
                assert not any(write(source.connector, writes))
                now |= written
                forces = now["forces"] = [now.get("forces/1", 7), *now.get("forces/2..3", [8, 9])]
                assert server.ask("get", "pump").replace("<State.On: 1>", "1") == (
                    f"Pump(Count={now['count']}, State=1, Axis=Axis(Position={now['position'] / 10}, "
                    f"Name={now['name']!r}, Homed={now['homed']}), Axes=[Axis(Position=2.5, Name='a', Homed=False), "
                    f"Axis(Position={now['second']}, Name='b', Homed=False)], Forces={forces}, Hint=None, "
                    f"Spare={now['spare']}, When={when}"
                ), written
    finally:
        server.ask("allow", "pump", False)
        server.ask("structure", "pump", "Pump", VALUE)


def test_browse_writes_members(server: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "tags.toml"
    assert supervisor.main(["browse", server.url, "Device/pump/**", "Device/axes/**", "-o", str(file)]) == 0
    assert "imported 21 tags" in capsys.readouterr().err
    (layout,) = (one.with_statuses() for one in compile_sources([File(file.name, file.read_bytes())]).layouts)
    assert "Device/pump/Axes/1/Position" in layout.by_path
    connector = OpcUaConnector(OpcUaOptions(url=server.url, publishing_ms=10), layout)
    connector.connect()
    try:
        image = connector.read()
    finally:
        connector.close()
    area = status_area(layout)
    assert area is not None
    bad = [one.path for index, one in enumerate(layout.registers) if area.get(image, index).code != GOOD]
    assert bad == ["Device/pump/Hint"]
    found = {one.path: codec(one, layout.byte_order).decode(image) for one in layout.registers}
    assert found["Device/pump/Forces"] == [7, 8, 9]
    assert found["Device/axes/1/Name"] == "y"


def test_an_independent_server(tmp_path: Path) -> None:
    pump: dict[str, Any] = {
        "mode": 1, "axes": [{"position": 1.5, "name": "a", "settling": 20}, {"position": 2.5, "name": "Größe"}],
        "hint": 0.5, "bytes": [1, 2, 3], "on": True,
    }  # fmt: skip
    nodes: list[dict[str, Any]] = [
        {"id": "pump", "structure": "Pump", "value": pump},
        {"id": "pumps", "structure": "Pump", "value": [pump, pump | {"spare": -7}]},
        {"id": "either", "structure": "Either", "value": {"text": "now"}},
    ]
    with NodeServer(tmp_path, nodes) as server:
        found = OpcUaConnector.browse(OpcUaOptions(url=server.url, timeout=5000), Wanted(["PLC/**"]))
        tags = {"/".join(one.names): {"type": one.type, **one.columns} for one in found.offers if one.type}
        assert tags["PLC/pump/Bytes"]["type"] == "ARRAY[0..2] OF USINT"
        for mode in ("subscribe", "poll"):
            with connected(server.url, tags, mode=mode, timeout=5000) as source:
                image = source.connector.read()
                bad = {path: code for path in tags if (code := source.status(path, image).code) != GOOD}
                absent = ["PLC/pump/Spare", "PLC/pumps/0/Spare", "PLC/either/Whole"]
                assert bad == dict.fromkeys(absent, BAD_NO_DATA)
                values = {path: source.value(path, image) for path in tags}
                assert values["PLC/pump/Axes/0/Settling"] == 20
                assert values["PLC/pump/Axes/1/Name"] == "Größe"
                assert (values["PLC/pump/Mode"], values["PLC/pump/Hint"], values["PLC/pump/On"]) == (1, 0.5, True)
                assert (values["PLC/pumps/1/Spare"], values["PLC/pumps/1/Bytes"]) == (-7, [1, 2, 3])
                assert values["PLC/either/Text"] == "now"
                new: dict[str, Value] = {
                    "PLC/pump/Mode": 0, "PLC/pump/Axes/1/Name": f"by {mode}", "PLC/pump/Bytes": [4, 5, 6],
                    "PLC/pump/Axes/0/Settling": 0.25, "PLC/pumps/1/Spare": 8, "PLC/either/Text": "now",
                }  # fmt: skip
                outcomes = source.write_all({**new, "PLC/either/Whole": 1})
                assert outcomes[:-1] == [""] * len(new)
                assert "at present" in outcomes[-1]
                image = source.connector.read()
                assert {path: source.value(path, image) for path in tags} == values | new
                assert not any(source.write_all({path: values[path] for path in new}))
