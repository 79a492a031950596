"""A data block's registers, read by their names from an independent server, as an S7-1500 offers them."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import pytest

from shmio.connectors.browsing import Wanted
from shmio.connectors.opcua.connector import OpcUaConnector
from shmio.connectors.opcua.options import OpcUaOptions
from shmio.layout.addresses.opcua import NodeAddress
from shmio.layout.addresses.siemens import NAMESPACE, node_address
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout
from shmio.layout.topic import find
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import Write, encode
from shmio.model.statuses import GOOD, status_area
from shmio.testing.write_conformance import write
from tests.unit.connectors.opcua.node_server import NodeServer

A50 = Path(__file__).parents[4] / "db201.db"
MIXED = """
DATA_BLOCK "Press line"
{ S7_Optimized_Access := 'TRUE' }
VERSION : 0.1
   STRUCT
      Ready : Bool;
      Doors : Array[1..3] of Bool;
      Count : LInt;
      Mask : Word;
      Letter : Char;
      Name : String[20];
      Wide : WString[20];
      Pause : Time;
      Old : S5Time;
      Day : Date;
      At : Time_Of_Day;
      Made : Date_And_Time;
      Exact : LDT;
      Axes : Array[0..1] of Struct
         "Set point" : Real;
         Limits : Array[0..1] of Int;
      END_STRUCT;
      Grid : Array[0..1, 1..3] of Int;
   END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
MIXED_NODES: list[tuple[str, str, str, Any, Value]] = [  # path, node, its type, its value, the register's value
    ("Ready", '"Press line"."Ready"', "Boolean", True, True),
    ("Doors", '"Press line"."Doors"', "Boolean", [True, False, True], [True, False, True]),
    ("Count", '"Press line"."Count"', "Int64", [0, 77], 77),
    ("Mask", '"Press line"."Mask"', "UInt16", 0xABCD, 0xABCD),
    ("Letter", '"Press line"."Letter"', "Byte", 65, "A"),
    ("Name", '"Press line"."Name"', "String", "Gr\u00f6\u00dfe", "Gr\u00f6\u00dfe"),
    ("Wide", '"Press line"."Wide"', "String", "\u20ac", "\u20ac"),
    ("Pause", '"Press line"."Pause"', "Int32", -1500, -1500),
    ("Old", '"Press line"."Old"', "UInt16", 0x2127, 127_000),
    ("Day", '"Press line"."Day"', "UInt16", 1, "1990-01-02"),
    ("At", '"Press line"."At"', "UInt32", 3_600_000, 3_600_000),
    ("Made", '"Press line"."Made"', "Byte", [0x24, 2, 0x29, 0x12, 0x34, 0x56, 0x78, 0x95], "2024-02-29T12:34:56.789"),
    ("Exact", '"Press line"."Exact"', "DateTime", "2024-02-29T12:34:56.789Z", "2024-02-29T12:34:56.789000000"),
    ("Axes/0/Set point", '"Press line"."Axes"[0]."Set point"', "Float", 1.5, 1.5),
    ("Axes/0/Limits", '"Press line"."Axes"[0]."Limits"', "Int16", [-5, 5], [-5, 5]),
    ("Axes/1/Set point", '"Press line"."Axes"[1]."Set point"', "Float", 2.5, 2.5),
    ("Axes/1/Limits", '"Press line"."Axes"[1]."Limits"', "Int16", [-6, 6], [-6, 6]),
    ("Grid", '"Press line"."Grid"', "Int16", [[1, 2, 3], [4, 5, 6]], [[1, 2, 3], [4, 5, 6]]),
]


def compiled(name: str, text: bytes) -> Layout:
    (layout,) = compile_sources([Source(name, text)]).layouts
    return layout.with_statuses()


def a50_nodes() -> dict[str, tuple[str, str, Value]]:
    """Return node, type and value of each register of the cell, by its path."""
    found: dict[str, tuple[str, str, Value]] = {
        "Inputs": ('"DB201"."Inputs"', "Byte", [place % 251 for place in range(1000)]),
        "Outputs": ('"DB201"."Outputs"', "Byte", [place % 241 for place in range(1100)]),
    }
    for axis in (1, 2):
        found[f"NCAchse{axis}_Pos"] = f'"DB201"."NCAchse{axis}_Pos"', "Float", 100.5 + axis
    for robot in (800, 825, 850):
        for axis in range(1, 7):
            path = f"Robot_{robot}/Axs{axis}_Pos"
            found[path] = f'"DB201"."Robot_{robot}"."Axs{axis}_Pos"', "Float", robot + axis / 4
    return found


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeServer]:
    nodes = [{"id": node, "type": kind, "value": value, "writable": True} for node, kind, value in a50_nodes().values()]
    nodes += [{"id": node, "type": kind, "value": value, "writable": True} for _, node, kind, value, _ in MIXED_NODES]
    with NodeServer(tmp_path_factory.mktemp("node-opcua"), nodes) as server:
        yield server


def connected(server: NodeServer, layout: Layout, mode: Literal["subscribe", "poll"] = "subscribe") -> OpcUaConnector:
    options = OpcUaOptions(url=server.url, nodes="siemens", mode=mode, timeout=5000, publishing_ms=50, sampling_ms=50)
    connector = OpcUaConnector(options, layout)
    connector.connect()
    return connector


def values(layout: Layout, image: bytes) -> dict[str, Value]:
    area = status_area(layout)
    assert area is not None
    assert [area.get(image, index).code for index in range(len(layout.registers))] == [GOOD] * len(layout.registers)
    return {register.path: codec(register, layout.byte_order).decode(image) for register in layout.registers}


@pytest.mark.parametrize("mode", ["subscribe", "poll"])
def test_all_registers_of_the_cell_come_from_an_independent_server(
    server: NodeServer, mode: Literal["subscribe", "poll"]
) -> None:
    layout = compiled("db201.db", A50.read_bytes())
    connector = connected(server, layout, mode)
    try:
        image = connector.read()
        expected = {path: value for path, (_, _, value) in a50_nodes().items()}
        assert len(expected) == 22
        assert values(layout, image) == expected
        area = status_area(layout)
        assert area is not None
        assert abs(area.get(image, 0).source_ns - time.time_ns()) < 600e9
    finally:
        connector.close()


def test_all_nodes_of_an_independent_server_are_listed(server: NodeServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.connectors.opcua.session.REFERENCES_AT_ONCE", 3)  # it says where the rest is
    found = OpcUaConnector.browse(OpcUaOptions(url=server.url, timeout=5000), Wanted(["PLC"]))
    listed = {str(one.columns["address"]): one.type for one in found.offers if one.type}
    axes = {f"nsu={NAMESPACE};s={node}": kind for node, kind, _ in a50_nodes().values()}
    assert {node: listed[node] for node in axes} == {
        node: "REAL" if kind == "Float" else f"ARRAY[0..{999 if 'Inputs' in node else 1099}] OF USINT"
        for node, kind in axes.items()
    }
    assert len(listed) == len(axes) + len(MIXED_NODES)
    assert found.incomplete == ""


def test_types_of_an_optimized_block(server: NodeServer) -> None:
    layout = compiled("press.db", MIXED.encode())
    assert layout.optimized
    connector = connected(server, layout)
    try:
        assert values(layout, connector.read()) == {path: value for path, _, _, _, value in MIXED_NODES}
    finally:
        connector.close()


WRITTEN: dict[str, Value] = {
    "Ready": False, "Doors": [False, True, False], "Count": -(1 << 40), "Mask": 0x1234, "Letter": "z", "Name": "short",
    "Wide": "\u00fc\u20ac", "Pause": 2500, "Old": 5_000, "Day": "2024-02-29", "At": 7_200_000,
    "Made": "1999-12-31T23:59:59.999", "Exact": "2024-03-01T00:00:00.000001000", "Axes/0/Set point": -3.25,
    "Axes/1/Limits": [7, 8],
}  # fmt: skip


def test_every_type_is_written(server: NodeServer) -> None:
    """Each value is read back from the server by a connector of its own."""
    layout = compiled("press.db", MIXED.encode())
    by_path = {register.path: register for register in layout.registers}
    before = {path: value for path, _, _, _, value in MIXED_NODES}
    writer = connected(server, layout)
    try:
        for new in (WRITTEN, {path: before[path] for path in WRITTEN}):
            writes = [one for path, value in new.items() for one in encode(by_path[path], value, "big")]
            assert write(writer, writes) == [""] * len(writes)
            reader = connected(server, layout, "poll")
            try:
                assert values(layout, reader.read()) == before | new
                assert values(layout, writer.read()) == before | new
            finally:
                reader.close()
    finally:
        writer.close()


def test_an_element_is_written_alone(server: NodeServer) -> None:
    layout = compiled("db201.db", A50.read_bytes())
    outputs = layout.registers[layout.by_path["Outputs"]]
    connector = connected(server, layout)
    try:
        for place, value in ((13, 200), (1099, 201)):
            (outcome,) = write(connector, encode(layout.element(outputs, (place,)), value))
            assert outcome == ""
            found = values(layout, connector.read())["Outputs"]
            assert isinstance(found, list)
            assert found[place] == value
            assert found[:13] == [number % 241 for number in range(13)]
            assert write(connector, encode(layout.element(outputs, (place,)), place % 241)) == [""]
    finally:
        connector.close()


def test_elements_of_an_array_with_two_dimensions_are_written_alone(server: NodeServer) -> None:
    layout = compiled("press.db", MIXED.encode())
    grid = find(layout, "Grid")
    connector = connected(server, layout)

    def written(bits: Write) -> tuple[list[str], Value]:
        outcomes = write(connector, [bits])
        return outcomes, values(layout, connector.read())["Grid"]

    try:
        (one,) = encode(find(layout, "Grid/1/2"), 50)
        assert written(one) == ([""], [[1, 2, 3], [4, 50, 6]])
        assert written(Write(grid.offset + 2, 0, struct.pack(">2h", 7, 8))) == ([""], [[1, 7, 8], [4, 50, 6]])
        assert written(Write(grid.offset + 6, 0, struct.pack(">3h", 9, 10, 11))) == ([""], [[1, 7, 8], [9, 10, 11]])
        (outcome,), after = written(Write(grid.offset + 4, 0, bytes(4)))  # the end of a row, and the start of the next
        assert "form a range" in outcome
        assert after == [[1, 7, 8], [9, 10, 11]]
        (all_of_them,) = encode(grid, [[1, 2, 3], [4, 5, 6]])
        assert written(all_of_them) == ([""], [[1, 2, 3], [4, 5, 6]])
    finally:
        connector.close()


def test_names_of_nested_arrays_and_names_with_quotes() -> None:
    text = """
    DATA_BLOCK "My DB"
    STRUCT
      grid : Array[0..1, -1..0] of Struct
         "a.b/c" : Array[0..3] of Real;
         in : Struct
            x : Int;
         END_STRUCT;
      END_STRUCT;
    END_STRUCT;
    BEGIN
    END_DATA_BLOCK
    """
    layout = compiled("my.db", text.encode())
    found = [node_address(layout, register) for register in layout.registers]
    assert found[2:4] == [
        NodeAddress(NAMESPACE, '"My DB"."grid"[0,0]."a.b/c"'),
        NodeAddress(NAMESPACE, '"My DB"."grid"[0,0]."in"."x"'),
    ]
