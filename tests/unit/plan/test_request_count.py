"""The requests that a source makes of its device, as planned and as the connector then sends them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from typing import Any

import msgspec
import pytest
from snap7.type import SrvArea

from shmio.config import Address, Source
from shmio.connectors import registry
from shmio.connectors.base import Connector
from shmio.connectors.request_count import CycleRequests, Requests
from shmio.connectors.s7.request_count import PDU_SIZES
from shmio.emulators.s7 import S7Server, ServerOptions
from shmio.layout.compiler import Source as SourceFile
from shmio.layout.compiler import compile_sources
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.plan.request_count import source_requests, writable_registers
from shmio.testing.proxy import FaultProxy


def block(size: int) -> Layout:
    """Return the layout of DB5 with ``size`` bytes."""
    source = f"DATA_BLOCK DB5\nSTRUCT\nx : ARRAY[1..{size}] OF BYTE;\nEND_STRUCT;\nBEGIN\nEND_DATA_BLOCK\n"
    return compile_sources([SourceFile("cell.db", source.encode())]).layouts[0]


def table(addresses: Mapping[str, str], kind: str = "INT", **more: object) -> Layout:
    """Return the layout of a tag table with these addresses."""
    tags = {path: {"type": kind, "address": address, **more} for path, address in addresses.items()}
    return place_tags("table", tags).with_statuses()


def of(connector: str, layout: Layout, *writable: str, **options: Any) -> Source:
    """Return a source with complete options, as the check of a configuration makes it."""
    whole = msgspec.to_builtins(registry.convert_options(connector, options))
    return Source(
        name="cell", connector=connector, layout="cell.db", period_ms=20, writable=list(writable), options=whole
    )


def connector_of(source: Source, layout: Layout) -> Connector:
    kind = registry.load(source.connector)
    assert issubclass(kind, Connector)
    return kind.for_layout(layout)(registry.convert_options(source.connector, source.options), layout)


def requests_of(connector: str, layout: Layout, **options: Any) -> CycleRequests:
    found = source_requests(of(connector, layout, **options), layout)
    assert found is not None
    return found


def test_a_data_block_takes_requests_by_the_size_of_a_pdu() -> None:
    found = requests_of("s7", block(2180), host="plc")
    assert found.reads == "bytes 0 to 2179 of DB5"
    assert found.requests == (
        Requests(10, 1, "PDU of 240 bytes"), Requests(5, 1, "PDU of 480 bytes"), Requests(3, 1, "PDU of 960 bytes")
    )  # fmt: skip


def test_sizes_with_the_same_count_share_a_line() -> None:
    assert requests_of("s7", block(300), host="plc").requests == (
        Requests(2, assumption="PDU of 240 bytes"),
        Requests(1, assumption="PDU of 480 or 960 bytes"),
    )
    assert requests_of("s7", block(222), host="plc").requests == (Requests(1),)
    assert requests_of("s7", block(2180), host="plc", packetSize=96).requests == (Requests(23),)


FAR = {f"r{number}": f"DB{5 + number % 2}.DBW{100 * number}" for number in range(40)}
FAR |= {"input": "%IW4", "output": "%QW0"}
SEQUENCE = {f"h{number}": f"holding {30 * number}" for number in range(20)} | {"i": "input 7"}


@pytest.mark.parametrize("layout", [block(2180), table(FAR)], ids=["block", "table"])
@pytest.mark.parametrize("pdu_size", PDU_SIZES)
def test_a_controller_gets_as_many_requests_as_check_says(layout: Layout, pdu_size: int) -> None:
    source = of("s7", layout, host="127.0.0.1")
    found = source_requests(source, layout)
    assert found is not None
    said = next(one.count for one in found.requests if not one.assumption or str(pdu_size) in one.assumption)
    reads = []

    def count(frame: bytes) -> bytes:
        if frame[8] == 3 and frame[19] == 4:  # an answer to a read
            reads.append(frame)
        return frame

    with S7Server(Address("127.0.0.1", 0), options=ServerOptions(max_pdu_size=pdu_size, max_jobs=1)) as server:
        for number in (5, 6):
            server.add_block(number, bytearray(5000))
        for area in (SrvArea.PE, SrvArea.PA):
            server.add_area(area, bytearray(100))
        server.start()
        with FaultProxy(server.address) as proxy:
            source.options["port"] = proxy.address.port
            with closing(connector_of(source, layout)) as connector:
                connector.connect()
                proxy.edit(count)
                connector.read()
    assert said > 1, "the figures differ by the size of a PDU"
    assert len(reads) == said


def test_a_table_says_which_blocks_and_areas_it_reads() -> None:
    found = requests_of(
        "s7", table({"a": "DB7.DBW0", "b": "DB5.DBW0", "c": "%MW2", "slow": "%IW2"}), host="plc", every={"slow": 5}
    )
    assert found.reads == "4 registers in DB5, DB7, inputs, markers, 1 of them not in each cycle"
    assert found.requests == (Requests(1),)
    layout = place_tags(
        "t", {"a": {"type": "INT", "address": "%MW2"}, "state": {"type": "STRING[12]", "address": "cpu.state"}}
    )
    assert requests_of("s7", layout.with_statuses(), host="plc").note.endswith(
        "values of the CPU (1 register) are requested in addition"
    )


def test_a_modbus_device_gets_one_request_after_the_other() -> None:
    found = requests_of("modbus", table(SEQUENCE), host="device")
    assert found.reads == "20 holding registers, 1 input register of unit 1"
    assert found.requests == (Requests(21),)
    found = requests_of("modbus", table({"a": "holding 0", "b": "holding 10", "c": "unit 2 holding 0"}), host="device")
    assert found.reads == "12 holding registers of 2 units"
    assert found.requests == (Requests(2),)


def test_an_opc_ua_server_is_asked_only_if_it_is_polled() -> None:
    nodes = table({f"n{number}": f"ns=2;i={number}" for number in range(2500)})
    url = "opc.tcp://127.0.0.1:4840"
    pushed = requests_of("opcua", nodes, url=url, publishing_ms=50)
    assert (pushed.reads, pushed.requests) == ("2500 nodes", ())
    assert pushed.note == "the server sends what has changed, at most every 50 ms"
    assert requests_of("opcua", nodes, url=url, mode="poll").requests == (Requests(3, 3),)
    assert requests_of("opcua", nodes, url=url, mode="poll", session_items=1500).requests == (Requests(3, 3),)
    assert requests_of("opcua", nodes, url=url, mode="poll", session_items=500).requests == (Requests(5, 5),)
    assert Requests(5, 5).round_trips == 1


@pytest.mark.parametrize(
    ("connector", "address", "options", "reads"),
    [
        ("rosbridge", "/joints sensor_msgs/JointState position[0]", {"url": "ws://robot"}, "1 topic"),
        ("ros2", "/joints sensor_msgs/JointState position[0]", {}, "1 topic"),
        ("mqtt", "cell/temperature", {"url": "mqtt://127.0.0.1", "max_age_ms": {"**": 0}}, "1 subscription"),
    ],
)
def test_messages_are_not_asked_for(connector: str, address: str, options: dict[str, Any], reads: str) -> None:
    found = requests_of(connector, table({"a": address}, "LREAL"), **options)
    assert (found.reads, found.requests) == (reads, ())


def test_sources_without_a_device_and_connectors_that_do_not_say() -> None:
    layout = block(8)
    assert source_requests(of("memory", layout), layout) is None
    assert Connector.cycle_requests(connector_of(of("s7", layout, host="plc"), layout)) is None


def test_registers_that_commands_may_write() -> None:
    layout = place_tags("t", {f"{name}/{bit}": {"type": "BOOL"} for name in ("a", "b") for bit in range(9)})
    assert writable_registers(of("memory", layout), layout) == 0
    assert writable_registers(of("memory", layout, "a", "a/*", "b/3"), layout) == 10
    assert writable_registers(of("memory", layout, "**"), layout) == 18
