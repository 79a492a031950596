"""Emulated Modbus devices and OPC UA servers, read and written by the connectors, and by the libraries' own clients."""

from __future__ import annotations

import asyncio
import select
import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any, cast

import pytest
from asyncua import Client, ua

from shmio.config import Address
from shmio.connectors.base import Connector
from shmio.connectors.modbus.connector import ModbusConnector, ModbusOptions
from shmio.connectors.opcua.connector import OpcUaConnector
from shmio.connectors.opcua.options import OpcUaOptions
from shmio.connectors.s7.connector import S7Connector
from shmio.connectors.s7.session import S7Options
from shmio.emulators.device import Device, Served
from shmio.emulators.kinds import KINDS, create
from shmio.errors import ConfigError, EndpointError
from shmio.layout import compiler
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import encode
from shmio.model.statuses import BAD_OUT_OF_RANGE, GOOD, status_area
from shmio.testing.cell import until
from shmio.testing.ports import reserved_port
from shmio.testing.write_conformance import write as written

pytest.importorskip("pymodbus")

MODBUS: dict[str, object] = {
    "on": {"type": "BOOL", "address": "coil 3", "initial": True, "writable": True},
    "seen": {"type": "ARRAY[0..9] OF BOOL", "address": "discrete 5", "initial": [True, False, True]},
    "word": {"type": "UINT", "address": "holding 10", "initial": 7, "writable": True},
    "fault": {"type": "BOOL", "address": "holding 11.4", "initial": True, "writable": True},
    "scaled": {"type": "REAL", "address": "holding 12 INT", "scale": [0.5, 10.0], "initial": 60.0, "writable": True},
    "long": {"type": "LREAL", "address": "unit 7 input 500", "initial": -2.5},
    "text": {"type": "STRING[6]", "address": "unit 7 holding 40", "initial": "abc", "writable": True},
    "list": {"type": "ARRAY[1..2,1..2] OF DINT", "address": "input 20", "initial": [1, 2, 3, 4]},
}
OPCUA: dict[str, object] = {
    "on": {"type": "BOOL", "address": "ns=2;s=on", "initial": True, "writable": True},
    "small": {"type": "SINT", "address": "ns=2;i=17", "initial": -3},
    "big": {"type": "ULINT", "address": "nsu=http://maker/device;s=big", "initial": 2**63, "writable": True},
    "real": {"type": "REAL", "address": "/Objects/2:Device/3:Part/3:real", "initial": 1.5, "writable": True},
    "other": {"type": "REAL", "address": "/Objects/2:Device/2:other", "initial": 2.5},
    "scaled": {"type": "INT", "address": "ns=2;s=scaled", "scale": [2.0, 1.0], "initial": 21, "writable": True},
    "text": {"type": "STRING[20]", "address": "ns=2;s=text", "initial": "größer", "writable": True},
    "wide": {"type": "WSTRING[20]", "address": "ns=2;s=wide", "initial": "Ω"},
    "letter": {"type": "CHAR", "address": "ns=2;s=letter", "initial": "x"},
    "time": {"type": "TIME", "address": "ns=2;s=time", "initial": 1500, "writable": True},
    "day": {"type": "DATE", "address": "ns=2;s=day", "initial": "2026-02-03"},
    "moment": {"type": "DTL", "address": "ns=2;s=moment", "initial": "2026-02-03T04:05:06.7", "writable": True},
    "list": {"type": "ARRAY[1..2,1..3] OF DINT", "address": "ns=2;s=list", "initial": [1, 2, 3, 4, 5, 6]},
    "bits": {"type": "ARRAY[0..3] OF BOOL", "address": "ns=2;s=bits", "initial": [True, False, True, True]},
}


def table(tags: dict[str, object]) -> Layout:
    return place_tags("table", tags).with_statuses()


def reader(kind: str, address: Address, layout: Layout, **options: Any) -> Connector:
    if kind == "s7":
        made: Any = S7Connector.for_layout(layout)
        return cast("Connector", made(S7Options(host=address.host, port=address.port, **options), layout))
    if kind == "modbus":
        return ModbusConnector(ModbusOptions(host=address.host, port=address.port, **options), layout)
    return OpcUaConnector(OpcUaOptions(url=f"opc.tcp://{address}", publishing_ms=10, sampling_ms=10, **options), layout)


@contextmanager
def device(kind: str, served: Sequence[Served], program: str = "idle") -> Iterator[tuple[Device, Address]]:
    with reserved_port() as address:
        made = create(kind, served, program, address)
        made.start()
        try:
            yield made, address
        finally:
            made.stop()


@contextmanager
def connected(kind: str, address: Address, layout: Layout, **options: Any) -> Iterator[Connector]:
    connector = reader(kind, address, layout, **options)
    connector.connect()
    try:
        yield connector
    finally:
        connector.close()


def values(connector: Connector, layout: Layout) -> dict[str, Value]:
    image = connector.read()
    return {one.path: codec(one, layout.byte_order).decode(image) for one in layout.registers}


def write(connector: Connector, layout: Layout, path: str, value: object) -> list[str]:
    register = next(one for one in layout.registers if one.path == path)
    return list(written(connector, encode(register, value, layout.byte_order)))


def statuses(connector: Connector, layout: Layout) -> dict[str, int]:
    area, image = status_area(layout), connector.read()
    assert area is not None
    return {one.path: area.get(image, index).code for index, one in enumerate(layout.registers)}


def given(tags: dict[str, object]) -> dict[str, Any]:
    return {path: tag["initial"] for path, tag in tags.items() if isinstance(tag, dict)}


@pytest.mark.parametrize(("kind", "tags"), [("modbus", MODBUS), ("opcua", OPCUA)])
def test_each_type_in_both_directions(kind: str, tags: dict[str, object]) -> None:
    layout = table(tags)
    lists = {"modbus": [[1, 2], [3, 4]], "opcua": [[1, 2, 3], [4, 5, 6]]}
    expected = given(tags) | {"list": lists[kind], "seen": [True, False, True] + [False] * 7}
    expected["moment"] = "2026-02-03T04:05:06.700000000"
    with device(kind, [Served(layout)]) as (_, address), connected(kind, address, layout) as connector:
        assert values(connector, layout) == {path: expected[path] for path in tags}
        assert set(statuses(connector, layout).values()) == {GOOD}
        written: dict[str, Any] = {
            "on": False, "word": 65_000, "fault": False, "scaled": 61.0 if kind == "modbus" else 41, "text": "xyz",
            "big": 5, "real": -0.25, "time": 99, "moment": "2027-01-01T00:00:00.000001000",
        }  # fmt: skip
        for path in [path for path in tags if path in written]:
            assert write(connector, layout, path, written[path]) == [""]
            until(lambda path=path: values(connector, layout)[path] == written[path], path)  # type: ignore[misc]


@pytest.mark.parametrize(("kind", "tags"), [("modbus", MODBUS), ("opcua", OPCUA)])
def test_the_program_moves_what_commands_cannot_write(kind: str, tags: dict[str, object]) -> None:
    layout = table(tags)
    with (
        device(kind, [Served(layout)], "wave") as (made, address),
        connected(kind, address, layout) as connector,
    ):
        path = "long" if kind == "modbus" else "other"
        before = values(connector, layout)
        until(lambda: values(connector, layout)[path] != before[path], "another value")
        assert values(connector, layout)["text"] == before["text"]
        assert write(connector, layout, "on", False) == [""]
        cycles = made.cycle.cycles
        until(lambda: made.cycle.cycles > cycles + 3, "three cycles")
        assert values(connector, layout)["on"] is False
        assert made.cycle.failure is None


def test_modbus_orders_units_and_what_there_is_not() -> None:
    layout = table({"long": {"type": "DINT", "address": "holding 150", "initial": 0x0102_0304}})
    orders = {"word_order": "little", "byte_order": "little", "unit": 9}
    with device("modbus", [Served(layout, orders)]) as (_, address):
        with connected("modbus", address, layout, **orders) as connector:
            assert values(connector, layout)["long"] == 0x0102_0304
        beyond = table(
            {"beyond": {"type": "DINT", "address": "holding 152"}, "word": {"type": "UINT", "address": "holding 150"}}
        )
        with connected("modbus", address, beyond, unit=9) as connector:
            assert statuses(connector, beyond) == {"beyond": BAD_OUT_OF_RANGE, "word": GOOD}
            assert values(connector, beyond)["word"] == 0x0403
        with connected("modbus", address, beyond, unit=1) as connector:
            assert GOOD not in statuses(connector, beyond).values()


def test_opcua_serves_a_data_block_as_an_s7_1500_does() -> None:
    source = """
        DATA_BLOCK "Press line"
        { S7_Optimized_Access := 'TRUE' }
        VERSION : 0.1
        STRUCT
            Speed : Real := 12.5;
            Wait : TON_TIME;
            Axes : Array[1..2] of Struct
                Pos : DInt := 3;
            END_STRUCT;
        END_STRUCT;
        BEGIN
        END_DATA_BLOCK"""
    [layout] = compiler.compile_sources([compiler.Source("a.db", source.encode())]).layouts
    layout = layout.with_statuses()
    served = Served(layout, {"nodes": "siemens"})
    with device("opcua", [served]) as (_, address), connected("opcua", address, layout, nodes="siemens") as connector:
        timer = {"Wait/PT": 0, "Wait/ET": 0, "Wait/IN": False, "Wait/Q": False}
        assert values(connector, layout) == {"Speed": 12.5, **timer, "Axes/1/Pos": 3, "Axes/2/Pos": 3}
        assert write(connector, layout, "Axes/2/Pos", -7) == [""]
        until(lambda: values(connector, layout)["Axes/2/Pos"] == -7, "the written value")


@pytest.mark.parametrize("kind", ["modbus", "opcua"])
def test_two_tables_share_a_device(kind: str) -> None:
    address_of = {"modbus": "holding 5", "opcua": "ns=2;s=shared"}[kind]
    first = table({"a": {"type": "INT", "address": address_of, "writable": True}})
    second = table({"b": {"type": "INT", "address": address_of, "writable": True, "initial": 4}})
    with (
        device(kind, [Served(first), Served(second)]) as (_, address),
        connected(kind, address, first) as one,
        connected(kind, address, second) as other,
    ):
        assert write(one, first, "a", 12) == [""]
        until(lambda: values(other, second)["b"] == 12, "the other's value")


@pytest.mark.parametrize("kind", KINDS)
def test_a_used_address_is_named(kind: str) -> None:
    layout = place_tags(
        "t", {"a": {"type": "INT", "address": {"s7": "MW0", "modbus": "holding 0"}.get(kind, "ns=2;i=1")}}
    )
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        made = create(kind, [Served(layout)], "idle", Address("127.0.0.1", port))
        with pytest.raises(EndpointError, match=f"127.0.0.1:{port}"):
            made.start()
        made.stop()


@pytest.mark.parametrize(
    ("kind", "tag", "fault"),
    [
        ("modbus", {"type": "INT", "address": "DB1.DBW0"}, "layout: a: .* is not a Modbus address"),
        ("opcua", {"type": "INT", "address": "holding 1"}, "layout: a: .* is not an address of OPC UA"),
        ("opcua", {"type": "INT", "address": "ns=0;i=2258"}, "namespace 0"),
        ("opcua", {"type": "INT", "address": "ns=101;i=2258"}, "namespaces up to 100"),
    ],
)
def test_wrong_addresses_are_named(kind: str, tag: dict[str, object], fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        create(kind, [Served(place_tags("t", {"a": tag}))], "idle", Address("127.0.0.1", 0))


@pytest.mark.parametrize("kind", ["modbus", "opcua"])
def test_the_number_of_clients_is_limited(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"shmio.emulators.{kind}.MAX_CLIENTS", 2)
    layout = table({"a": {"type": "INT", "address": {"modbus": "holding 0"}.get(kind, "ns=2;i=1"), "initial": 3}})
    with device(kind, [Served(layout)]) as (_, address):
        with ExitStack() as stack:
            clients = [stack.enter_context(socket.create_connection((address.host, address.port))) for _ in range(3)]
            ended, _, _ = select.select(clients, [], [], 20)
            assert [client.recv(10) for client in ended] == [b""]
        with connected(kind, address, layout) as connector:
            assert values(connector, layout) == {"a": 3}


BEFORE: dict[str, dict[str, object]] = {
    "s7": {"kept": "%MW10", "moved": "DB5.DBW0", "gone": "%MW12"},
    "modbus": {"kept": "holding 10", "moved": "holding 11", "gone": "unit 7 holding 3"},
    "opcua": {"kept": "ns=2;s=kept", "moved": "ns=2;s=moved", "gone": "ns=2;s=gone"},
}
AFTER: dict[str, dict[str, object]] = {
    "s7": {"new": "DB9.DBW2", "kept": "%MW10", "more": "DB5.DBW700", "moved": "%MW20"},
    "modbus": {"new": "unit 9 holding 4", "kept": "holding 10", "more": "holding 700", "moved": "holding 12"},
    "opcua": {"new": "ns=3;s=new", "kept": "ns=2;s=kept", "more": "/Objects/2:D/2:more", "moved": "ns=2;s=there"},
}


def words(addresses: dict[str, object]) -> Layout:
    tags = {
        path: {"type": "INT", "address": address, "initial": 40 + at}
        for at, (path, address) in enumerate(addresses.items())
    }
    return table({path: tag | {"writable": True} for path, tag in tags.items()})


@pytest.mark.parametrize("kind", KINDS)
def test_layouts_change_while_clients_are_connected(kind: str) -> None:
    before, after = words(BEFORE[kind]), words(AFTER[kind])
    with device(kind, [Served(before)]) as (made, address), connected(kind, address, before) as client:
        until(lambda: values(client, before) == {"kept": 40, "moved": 41, "gone": 42}, "the initial values")
        assert write(client, before, "kept", 7) == [""]
        with pytest.raises(ConfigError), made.cycle.held():
            made.change([Served(table({"wrong": {"type": "INT", "address": "nothing"}}))])
        with made.cycle.held():
            made.change([Served(after)])
        made.cycle.advance(0)
        area = status_area(before)
        assert area is not None
        assert area.get(client.read(), 0).code == GOOD  # over the same connection
        with connected(kind, address, after) as other:
            expected = {"new": 40, "kept": 7, "more": 42, "moved": 43}
            until(lambda: values(other, after) == expected, "the new registers, and the value that was written")
            assert write(other, after, "more", -5) == [""]
            until(lambda: values(other, after) == expected | {"more": -5}, "the written value")
        with made.cycle.held():
            made.change([Served(before)])
        with connected(kind, address, before) as other:
            until(lambda: values(other, before) == {"kept": 7, "moved": 41, "gone": 42}, "the first registers again")


def test_a_node_of_two_types_keeps_its_value() -> None:
    shared: dict[str, object] = {
        "count": {"type": "INT", "address": "ns=2;s=n", "writable": True},
        "wide": {"type": "DINT", "address": "ns=2;s=n"},
    }
    more = shared | {"new": {"type": "INT", "address": "ns=2;s=new"}}
    count = table({"count": shared["count"]})
    with device("opcua", [Served(table(shared))]) as (made, address), connected("opcua", address, count) as client:
        until(lambda: values(client, count) == {"count": 0}, "the initial value")
        assert write(client, count, "count", 7) == [""]
        with made.cycle.held():
            made.change([Served(table(more))])
        with connected("opcua", address, count) as other:
            until(lambda: values(other, count) == {"count": 7}, "the value that was written")


def test_a_data_block_changes_by_names() -> None:
    """A register that gets another place in an S7 data block keeps its value."""
    source = "DATA_BLOCK DB5\nSTRUCT\n{}END_STRUCT;\nBEGIN\nEND_DATA_BLOCK\n"
    kept = "flag : Bool; speed : Real := 2.5; name : String[6] := 'abc';\n"
    before, after = (
        compiler.compile_sources([compiler.Source("a.db", source.format(text).encode())]).layouts[0]
        for text in (kept, f"first : Array[0..4] of Int := [5(7)];\n{kept}last : LReal := 1.5;\n")
    )
    with device("s7", [Served(before)]) as (made, address), connected("s7", address, before, dbNumber=5) as client:
        assert write(client, before, "speed", 9.5) == [""]
        assert write(client, before, "flag", True) == [""]
        with made.cycle.held():
            made.change([Served(after)])
        with connected("s7", address, after, dbNumber=5) as other:
            assert values(other, after) == {
                "first": [7] * 5, "flag": True, "speed": 9.5, "name": "abc", "last": 1.5,
            }  # fmt: skip


def test_opcua_serves_parts_of_arrays_and_texts() -> None:
    """Index ranges (OPC 10000-4, section 7.27): a write changes nothing but the named elements."""
    read, refused = ua.ReadValueId, ua.StatusCodes

    def at(name: str, text: str) -> ua.ReadValueId:
        return read(ua.NodeId(name, 2), ua.AttributeIds.Value, text)

    async def use(address: Address) -> None:
        async with Client(f"opc.tcp://{address}", timeout=20) as client:

            async def values_at(*asked: tuple[str, str]) -> list[object]:
                params = ua.ReadParameters(NodesToRead=[at(*one) for one in asked])
                found = await client.uaclient.read(params)
                return [one.Value.Value if one.StatusCode.is_good() else one.StatusCode.value for one in found]

            async def write_at(name: str, text: str, value: object, kind: ua.VariantType) -> int:
                written = ua.DataValue(ua.Variant(value, kind))
                asked = ua.WriteValue(ua.NodeId(name, 2), ua.AttributeIds.Value, text, written)
                (status,) = await client.uaclient.write(ua.WriteParameters([asked]))
                return int(status.value)

            assert await values_at(
                ("list", "1,0:1"), ("bits", "2"), ("text", "1:3"), ("list", "2,0"), ("bits", "3:1"), ("time", "0"),
            ) == [
                [[4, 5]], [True], "röß", refused.BadIndexRangeNoData, refused.BadIndexRangeInvalid,
                refused.BadIndexRangeNoData,
            ]  # fmt: skip
            seen: asyncio.Queue[object] = asyncio.Queue()
            handler = SimpleNamespace(datachange_notification=lambda _node, value, _data: seen.put_nowait(value))
            subscription = await client.create_subscription(10, handler)
            options = ua.MonitoringParameters(1, 0.0, None, 1, True)
            item = ua.MonitoredItemCreateRequest(at("list", "0,1:2"), ua.MonitoringMode.Reporting, options)
            await subscription.create_monitored_items([item])
            assert await asyncio.wait_for(seen.get(), 20) == [[2, 3]]
            kinds = ua.VariantType
            assert await write_at("list", "1,0", [[40]], kinds.Int32) == refused.Good
            assert await write_at("list", "0,2", [[30]], kinds.Int32) == refused.Good
            assert await asyncio.wait_for(seen.get(), 20) == [[2, 30]]
            assert await write_at("bits", "1", [True], kinds.Boolean) == refused.Good
            assert await write_at("text", "0:1", "GR", kinds.String) == refused.Good
            assert await write_at("list", "1,2:3", [[1, 2]], kinds.Int32) == refused.BadIndexRangeNoData
            assert await write_at("list", "1,1:2", [[1]], kinds.Int32) == refused.BadIndexRangeDataMismatch
            assert await write_at("list", "1,1", [[1.0]], kinds.Double) == refused.BadTypeMismatch
            assert await values_at(("list", "0:1,0:2"), ("bits", "0:3"), ("text", "0:20")) == [
                [[1, 2, 30], [40, 5, 6]], [True, True, True, True], "GRößer",
            ]  # fmt: skip

    with device("opcua", [Served(table(OPCUA), {})]) as (_, address):
        asyncio.run(use(address))
