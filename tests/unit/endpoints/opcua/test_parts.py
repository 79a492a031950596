"""Index ranges: clients read, monitor and write parts of arrays and texts (OPC 10000-4, section 7.27)."""

from __future__ import annotations

from itertools import count
from typing import Any

from asyncua import Client, ua

from shmio.connectors.injection_layers import Owner
from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, Segment
from tests.unit.endpoints.harness import STALE_NS, image
from tests.unit.endpoints.opcua.harness import WRITER, Changes, Served, node, processes, serve, spec
from tests.unit.endpoints.plant import Plant

TYPES = ua.VariantType
GRID = Layout(
    "DB1", 1, 26, False,
    (
        Register("grid", "INT", ((1, 3), (0, 3)), 0, None, 24, 12),
        Register("flags", "BOOL", ((0, 9),), 24, 0, 2, 10),
    ),
)  # fmt: skip


def raw(*numbers: int) -> bytes:
    return b"".join(number.to_bytes(2, "big") for number in numbers) + b"\xff\xff"


async def read(client: Client, path: str, text: str) -> Any:
    """Return the value, or the name of the status if there is none."""
    asked = ua.ReadValueId(ua.NodeId(path, 2), ua.AttributeIds.Value, text)
    (found,) = await client.uaclient.read(ua.ReadParameters(NodesToRead=[asked]))
    return found.Value.Value if found.StatusCode.is_good() else found.StatusCode.name


async def write(client: Client, path: str, text: str, value: Any, kind: ua.VariantType) -> str:
    written = ua.DataValue(ua.Variant(value, kind))
    asked = ua.WriteValue(ua.NodeId(path, 2), ua.AttributeIds.Value, text, written)
    (status,) = await client.uaclient.write(ua.WriteParameters([asked]))
    return str(status.name)


def test_reads_of_parts(instance: str) -> None:
    async def test(one: Served) -> None:
        one.publish(raw(*range(12)))
        async with one.client() as client:
            for path, text, expected in (
                ("cell/grid", "1,0:2", [[4, 5, 6]]),
                ("cell/grid", "0:1,3", [[3], [7]]),
                ("cell/grid", "0:9,0:9", [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]),
                ("cell/grid", "3,0", "BadIndexRangeNoData"),
                ("cell/grid", "1", "BadIndexRangeNoData"),
                ("cell/grid/2", "0", "BadNodeIdUnknown"),
                ("cell/grid/2/1..2", "1", [6]),
                ("cell/flags", "2:4", [True, True, True]),
                ("cell/flags", "7", [True]),
                ("cell/flags", "4:2", "BadIndexRangeInvalid"),
                ("cell/flags", "x", "BadIndexRangeInvalid"),
                ("cell/flags/0", "0", "BadIndexRangeNoData"),
                ("cell#Quality", "0:2", "goo"),
            ):
                assert await read(client, path, text) == expected, (path, text)

    with Segment.create(instance, [spec(layout=GRID)], processes()) as segment:
        serve(segment, test)
        segment.unlink()


def test_monitored_parts(segment: Segment) -> None:
    async def test(one: Served) -> None:
        one.publish(image(inputs=b"\1\2"))
        async with one.client() as client:
            changes = Changes()
            subscription = await client.create_subscription(20, changes)
            handles = count(1)

            async def monitor(path: str, text: str) -> str:
                target = ua.ReadValueId(ua.NodeId(path, 2), ua.AttributeIds.Value, text)
                options = ua.MonitoringParameters(next(handles), 0.0, None, 1, True)
                asked = ua.MonitoredItemCreateRequest(target, ua.MonitoringMode.Reporting, options)
                (made,) = await subscription.create_monitored_items([asked])
                return "Good" if isinstance(made, int) else str(made.name)

            assert await monitor("cell/inputs", "1") == "Good"
            assert await monitor("cell/inputs", "2") == "BadIndexRangeNoData"
            assert await monitor("cell/inputs", "1:0") == "BadIndexRangeInvalid"
            assert await monitor("cell/step", "0") == "BadIndexRangeNoData"
            await changes.until("cell/inputs", lambda value: value.Value.Value == [2])
            one.publish(image(inputs=b"\1\3"))
            await changes.until("cell/inputs", lambda value: value.Value.Value == [3])

    serve(segment, test)


def test_writes_of_parts_change_nothing_else(instance: str) -> None:
    async def test(one: Served) -> None:
        plant = Plant(one.writer)
        plant.owners[WRITER] = Owner(WRITER, 3)
        plant.memory[:] = raw(*range(12))
        try:
            plant.cycle()
            plant.run()
            async with one.client() as client:
                assert await write(client, "cell/grid", "1,1:2", [[50, 60]], TYPES.Int16) == "Good"
                assert plant.memory == raw(0, 1, 2, 3, 4, 50, 60, 7, 8, 9, 10, 11)
                assert await write(client, "cell/grid", "0:2,0", [[70], [71], [72]], TYPES.Int16) == "Good"
                assert plant.memory == raw(70, 1, 2, 3, 71, 50, 60, 7, 72, 9, 10, 11)
                # Bits 2 to 7 of byte 25 belong to no register.
                assert await write(client, "cell/flags", "7:8", [False, False], TYPES.Boolean) == "Good"
                assert plant.memory[24:] == bytes((0x7F, 0xFE))
                before = bytes(plant.memory)
                for path, text, value, kind, expected in (
                    ("cell/grid", "1,1:2", [[1, 2, 3]], TYPES.Int16, "BadIndexRangeDataMismatch"),
                    ("cell/grid", "1,1:2", [1, 2], TYPES.Int16, "BadIndexRangeDataMismatch"),
                    ("cell/grid", "1,3:4", [[1, 2]], TYPES.Int16, "BadIndexRangeNoData"),
                    ("cell/grid", "1", [1], TYPES.Int16, "BadIndexRangeNoData"),
                    ("cell/grid", "1:", [[1]], TYPES.Int16, "BadIndexRangeInvalid"),
                    ("cell/grid", "1,1", [[1]], TYPES.Int32, "BadTypeMismatch"),
                    ("cell/grid/1/0", "0", 1, TYPES.Int16, "BadIndexRangeNoData"),
                    ("cell/flags", "9:10", [True, True], TYPES.Boolean, "BadIndexRangeNoData"),
                ):
                    assert await write(client, path, text, value, kind) == expected, (path, text)
                assert bytes(plant.memory) == before
        finally:
            plant.stop()

    cell = BlockSpec("cell", GRID, 20_000_000, STALE_NS, 1 << 20, Attributes("test", ("*",)))
    with Segment.create(instance, [cell], processes()) as segment:
        serve(segment, test)
        segment.unlink()


def test_a_part_of_a_text_keeps_the_rest(segment: Segment) -> None:
    async def test(one: Served) -> None:
        plant = Plant(one.writer)
        plant.owners[WRITER] = Owner(WRITER, 3)
        plant.memory[16:26] = b"\x08\x05shmio\0\0\0"
        try:
            plant.cycle()
            plant.run()
            async with one.client() as client:
                assert await write(client, "cell/name", "1:2", "HM", TYPES.String) == "Good"
                assert plant.memory[16:23] == b"\x08\x05sHMio"
                assert await write(client, "cell/name", "4:5", "xy", TYPES.String) == "BadIndexRangeNoData"
                assert await write(client, "cell/long", "0:1", b"\1\2", TYPES.ByteString) == "Good"
                assert plant.memory[26:29] == b"\1\2\0"
                assert await node(client, "cell/name").read_value() == "sHMio"
        finally:
            plant.stop()

    serve(segment, test)
