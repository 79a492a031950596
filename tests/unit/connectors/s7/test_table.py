"""Tag tables read from and written to shmio's emulator and python-snap7's server."""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from snap7.server import Server
from snap7.type import SrvArea

from shmio.config import Address
from shmio.connectors.base import Connector
from shmio.connectors.s7 import pdu
from shmio.connectors.s7.connector import S7Connector, S7Options
from shmio.connectors.s7.table import RETRY_NS
from shmio.emulators.emulator import Emulator
from shmio.emulators.s7 import Fault, S7Server, ServerOptions
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.model import Layout
from shmio.layout.report import Report
from shmio.layout.s7.address import Area
from shmio.layout.tags import compile_tags, place_tags
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import encode
from shmio.model.statuses import BAD_NODE_ID_UNKNOWN, BAD_OUT_OF_RANGE, GOOD, StatusArea
from shmio.testing.ports import reserved_port
from shmio.testing.proxy import FaultProxy

FIELD = Path(__file__).parents[3] / "field/s7"
TAGS: dict[str, object] = {
    "bit": {"type": "BOOL", "address": "DB1.DBX0.1"},
    "int": {"type": "INT", "address": "DB1.DBW4"},
    "text": {"type": "STRING[6]", "address": "DB1.DBB10"},
    "time": {"type": "DTL", "address": "DB2.DBB20"},
    "list": {"type": "ARRAY[0..2] OF REAL", "address": "DB2.DBD40"},
    "input": {"type": "BOOL", "address": "E0.7"},
    "word": {"type": "WORD", "address": "%IW256"},
    "output": {"type": "BYTE", "address": "%QB4"},
    "marker": {"type": "BOOL", "address": "%M3.7"},
    "scaled": {"type": "REAL", "address": "%MW20 INT", "scale": [0.5, 10.0]},
    "timer": {"type": "S5TIME", "address": "T5"},
    "counter": {"type": "INT", "address": "Z3"},
}
VALUES: dict[str, Value] = {
    "bit": True, "int": -2, "text": "abc", "time": "2024-02-29T12:34:56.000000007", "list": [1.0, -2.5, 0.0],
    "input": True, "word": 0x1234, "output": 7, "marker": True, "scaled": 60.0, "timer": 123_000, "counter": 123,
}  # fmt: skip


class Plc:
    """The memory of a controller."""

    def __init__(self) -> None:
        self.blocks = {1: bytearray(100), 2: bytearray(100)}
        self.areas = {SrvArea.PE: bytearray(300), SrvArea.PA: bytearray(30), SrvArea.MK: bytearray(30)}
        self.areas |= {SrvArea.TM: bytearray(30), SrvArea.CT: bytearray(30)}
        self.blocks[1][0:16] = b"\2\0\0\0\xff\xfe\0\0\0\0\6\3abc\0"
        self.blocks[2][20:32] = bytes.fromhex("07e8021d050c223800000007")
        self.blocks[2][40:48] = bytes.fromhex("3f800000c0200000")
        self.areas[SrvArea.PE][0], self.areas[SrvArea.PE][256:258] = 0x80, b"\x12\x34"
        self.areas[SrvArea.PA][4], self.areas[SrvArea.MK][3], self.areas[SrvArea.MK][21] = 7, 0x80, 100
        self.areas[SrvArea.TM][10:12], self.areas[SrvArea.CT][6:8] = b"\x21\x23", b"\x01\x23"


@contextlib.contextmanager
def served(plc: Plc, options: ServerOptions | None = None) -> Iterator[int]:
    """Serve the memory with shmio's emulator, and return the port."""
    server = S7Server(Address("127.0.0.1", 0), options=options)
    for number, data in plc.blocks.items():
        server.add_block(number, data)
    for area, data in plc.areas.items():
        server.add_area(area, data)
    server.start()
    try:
        yield server.address.port
    finally:
        server.stop()


@contextlib.contextmanager
def served_by_snap7(plc: Plc) -> Iterator[int]:
    """Serve the memory with python-snap7's server, and return the port."""
    server = Server(log=False)
    for number, data in plc.blocks.items():
        server.register_area(SrvArea.DB, number, data)
    for area, data in plc.areas.items():
        server.register_area(area, 0, data)
    server.start(0)
    try:
        assert server.server_socket is not None
        yield server.server_socket.getsockname()[1]
    finally:
        server.stop()


def table(tags: dict[str, object]) -> Layout:
    return place_tags("table", tags).with_statuses()


@contextlib.contextmanager
def connected(layout: Layout, port: int) -> Iterator[Connector]:
    connector = S7Connector.for_layout(layout)(S7Options(host="127.0.0.1", port=port, timeout=2000), layout)
    try:
        connector.connect()
        yield connector
    finally:
        connector.close()


def values(layout: Layout, raw: bytes) -> dict[str, Value]:
    return {one.path: codec(one, layout.byte_order).decode(raw) for one in layout.registers}


def codes(layout: Layout, raw: bytes) -> list[int]:
    area = StatusArea(layout)
    return [area.get(raw, index).code for index in range(len(layout.registers))]


def write(connector: Connector, layout: Layout, path: str, value: Value) -> list[str]:
    return connector.write(encode(layout.registers[layout.by_path[path]], value, layout.byte_order))


@pytest.mark.parametrize("serve", [served, served_by_snap7])
def test_all_areas_are_read_and_written(serve: Callable[[Plc], contextlib.AbstractContextManager[int]]) -> None:
    layout, plc = table(TAGS), Plc()
    changed: dict[str, Value] = {
        "bit": False, "int": 300, "text": "hello", "time": "2025-01-02T03:04:05.000000000", "list": [4.0, 5.0, 6.0],
        "output": 255, "marker": False, "scaled": -10.0,
    }  # fmt: skip
    with serve(plc) as port, connected(layout, port) as connector:
        raw = connector.read()
        assert values(layout, raw) == VALUES
        assert codes(layout, raw) == [GOOD] * len(TAGS)
        for path, value in changed.items():
            assert write(connector, layout, path, value) == [""]
        for path in ("input", "word", "timer", "counter"):
            (refusal,) = write(connector, layout, path, VALUES[path])
            assert "inputs cannot be written" in refusal or "can only be read" in refusal
        assert values(layout, connector.read()) == VALUES | changed
    assert plc.areas[SrvArea.MK][20:22] == (-40).to_bytes(2, "big", signed=True)


@pytest.mark.parametrize("serve", [served, served_by_snap7])
def test_texts_have_the_encoding_of_the_controller(
    serve: Callable[[Plc], contextlib.AbstractContextManager[int]],
) -> None:
    plc = Plc()
    tags: dict[str, object] = {
        "text": {"type": "STRING[6]", "address": "DB1.DBB10"},
        "char": {"type": "CHAR", "address": "DB1.DBB30"},
        "list": {"type": "ARRAY[0..1] OF STRING[4]", "address": "DB1.DBB40"},
    }
    for encoding, data, text in [
        ("windows-1252", bytes.fromhex("80 81 8d 8f 90 9d"), "€\x81\x8d\x8f\x90\x9d"),
        ("gbk", bytes.fromhex("ce c2 b6 c8 81 20"), "温度\uf781 "),
        ("cp949", bytes.fromhex("bf c2 b5 b5 ff"), "온도\uf7ff"),
    ]:
        plc.blocks[1][10 : 12 + len(data)] = bytes((6, len(data))) + data
        plc.blocks[1][30] = 0x81
        plc.blocks[1][40:52] = bytes((4, 4)) + data[:4] + bytes((4, 1)) + data[:1] + bytes(3)
        before = bytes(plc.blocks[1])
        layout = table(tags).with_encoding(encoding)
        with serve(plc) as port, connected(layout, port) as connector:
            found = values(layout, connector.read())
            assert found["text"] == text, encoding
            for path, value in found.items():
                assert write(connector, layout, path, value) == [""], (encoding, path)
            assert plc.blocks[1] == before
            assert write(connector, layout, "text", text[0] + "1") == [""]
            assert plc.blocks[1][10:14] == bytes((6, 2)) + data[:1] + b"1" or encoding != "windows-1252"
            assert values(layout, connector.read())["text"] == text[0] + "1"


def test_a_bit_is_written_without_its_neighbours() -> None:
    layout, plc = table(TAGS), Plc()
    plc.blocks[1][0] = 0xFF
    with served(plc) as port, connected(layout, port) as connector:
        assert write(connector, layout, "bit", False) == [""]
    assert plc.blocks[1][0] == 0xFD


def test_refused_registers_are_found_and_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """At first, half of a range lies beyond the end of a block, and one block is missing. Later both exist."""
    tags: dict[str, object] = {f"r{at}": {"type": "INT", "address": f"DB1.DBW{at}"} for at in range(80, 120, 2)}
    tags["gone"] = {"type": "INT", "address": "DB3.DBW0"}
    layout, plc = table(tags), Plc()
    expected = [GOOD] * 10 + [BAD_OUT_OF_RANGE] * 10 + [BAD_NODE_ID_UNKNOWN]
    with served(plc) as port, connected(layout, port) as connector:
        assert codes(layout, connector.read()) == expected
        connector.close()
        connector.connect()  # what is known is kept
        assert codes(layout, connector.read()) == expected
        plc.blocks[1].extend(b"\0\1" * 50)
        assert codes(layout, connector.read()) == expected
        monkeypatch.setattr("shmio.connectors.s7.table.time.monotonic_ns", later(RETRY_NS))
        connector.read()
        connector.read()
        raw = connector.read()
        assert codes(layout, raw) == [GOOD] * 20 + [BAD_NODE_ID_UNKNOWN]
        assert values(layout, raw)["r118"] == 1
        assert "in 1 request a cycle" in connector.describe()


def test_what_is_refused_is_found_in_several_sessions_if_one_is_too_short() -> None:
    layout = table({f"r{at}": {"type": "INT", "address": f"DB3.DBW{at}"} for at in range(0, 4000, 4)})
    options = S7Options(host="127.0.0.1", port=1, timeout=150, maxJobs=1)
    with served(Plc()) as port, FaultProxy(Address("127.0.0.1", port), up_s=0.01) as proxy:
        options = msgspec.structs.replace(options, port=proxy.address.port)
        connector = S7Connector.for_layout(layout)(options, layout)
        failures = 0
        try:
            while failures < 100:
                try:
                    connector.connect()
                    raw = connector.read()
                    break
                except ConnectorError:
                    failures += 1
        finally:
            connector.close()
    assert failures > 0
    assert codes(layout, raw) == [BAD_NODE_ID_UNKNOWN] * 1000


def later(ns: int) -> Callable[[], int]:
    now = time.monotonic_ns
    return lambda: now() + ns


def test_a_controller_that_permits_nothing_is_a_fault_of_the_source() -> None:
    layout = table(TAGS)
    with (
        served(Plc(), ServerOptions(fault=Fault.PUT_GET_OFF)) as port,
        connected(layout, port) as connector,
        pytest.raises(ConnectorError, match="PUT/GET"),
    ):
        connector.read()


def test_slow_registers_are_read_in_each_third_cycle_and_say_when() -> None:
    tags: dict[str, object] = {
        "fast": {"type": "INT", "address": "DB1.DBW0"},
        "slow/a": {"type": "INT", "address": "DB1.DBW2"},
    }
    layout, plc = table(tags), Plc()
    area = StatusArea(layout)
    plc.blocks[1][:4] = bytes(4)
    with served(plc) as port:
        options = S7Options(host="127.0.0.1", port=port, timeout=2000, every={"slow/*": 3})
        connector = S7Connector.for_layout(layout)(options, layout)
        seen, times = [], []
        try:
            connector.connect()
            for count in range(7):
                plc.blocks[1][1] = plc.blocks[1][3] = count
                raw = connector.read()
                found = values(layout, raw)
                seen.append((found["fast"], found["slow/a"]))
                times.append(area.get(raw, 1).source_ns)
                assert codes(layout, raw) == [GOOD, GOOD]
                assert area.get(raw, 0).source_ns == 0
            connector.close()
            connector.connect()
            plc.blocks[1][3] = 99
            assert values(layout, connector.read())["slow/a"] == 99  # a new session begins with all registers
        finally:
            connector.close()
    assert seen == [(0, 0), (1, 0), (2, 0), (3, 3), (4, 3), (5, 3), (6, 6)]
    assert times[0] == times[2] < times[3] == times[5] < times[6]


@pytest.mark.parametrize("every", [{"nothing/*": 2}, {"[": 2}])
def test_a_rate_of_no_register_is_a_fault_of_the_configuration(every: dict[str, int]) -> None:
    layout = table(TAGS)
    with pytest.raises(ConfigError, match="every: "):
        S7Connector.for_layout(layout)(S7Options(host="127.0.0.1", every=every), layout)


def test_digits_that_are_not_in_bcd_are_bad() -> None:
    layout, plc = table(TAGS), Plc()
    plc.areas[SrvArea.CT][6:8] = b"\x0a\x00"
    with served(plc) as port, connected(layout, port) as connector:
        assert codes(layout, connector.read()) == [GOOD] * 11 + [BAD_OUT_OF_RANGE]


@pytest.mark.parametrize("pdu_size", [240, 480, 960])
def test_many_registers_in_several_jobs(pdu_size: int) -> None:
    plc = Plc()
    plc.blocks[5] = bytearray(at // 2 % 251 if at % 2 else 0 for at in range(8000))
    tags: dict[str, object] = {f"r{at}": {"type": "INT", "address": f"DB5.DBW{at}"} for at in range(0, 8000, 40)}
    tags["long"] = {"type": "ARRAY[1..1500] OF BYTE", "address": "DB5.DBB0"}
    layout = table(tags)
    with served(plc, ServerOptions(max_pdu_size=pdu_size)) as port, connected(layout, port) as connector:
        found = values(layout, connector.read())
    assert found.pop("long") == list(plc.blocks[5][:1500])
    assert found == {f"r{at}": at // 2 % 251 for at in range(0, 8000, 40)}


@pytest.mark.parametrize(
    ("tag", "reason"),
    [
        ({"type": "BOOL", "address": "%I0.0", "writable": True}, "x: writable: inputs cannot be written"),
        ({"type": "INT"}, "x: address: this key is needed"),
    ],
)
def test_a_wrong_table_is_a_fault_of_the_configuration(tag: object, reason: str) -> None:
    layout = table({"y": {"type": "INT", "address": "%MW0"}, "x": tag})
    with pytest.raises(ConfigError, match=reason):
        S7Connector.for_layout(layout)(S7Options(host="127.0.0.1"), layout)


def test_a_layout_without_addresses_is_read_as_a_block() -> None:
    assert S7Connector.for_layout(place_tags("DB1", {"x": "INT"}, "big")) is S7Connector


@given(st.binary(max_size=120), st.lists(st.integers(1, 20), min_size=1, max_size=5), st.booleans())
def test_any_answer_is_parsed_or_a_fault(noise: bytes, sizes: list[int], headed: bool) -> None:
    head = struct.pack(">BxH3sBB2xHHHH", 3, 0, b"\x02\xf0\x80", 0x32, 3, 1, 2, len(noise), 0) + bytes((4, len(sizes)))
    frame = memoryview(head + noise if headed else noise.ljust(7, b"\0"))
    with contextlib.suppress(ConnectorError):
        answers = pdu.parse_items(frame, sizes)
        assert [len(one.data) for one in answers if one.code == 0xFF] == [
            size for one, size in zip(answers, sizes, strict=True) if one.code == 0xFF
        ]


def test_data_behind_an_item_that_is_too_short_are_no_refusal() -> None:
    """The first item lacks its data. The header and data of the second item would fit in their place."""
    data = b"\xff\x04\0\x20" + b"\xff\x04\0\x20" + b"0123"
    head = struct.pack(">BxH3sBB2xHHHH", 3, 0, b"\x02\xf0\x80", 0x32, 3, 1, 2, len(data), 0) + b"\x04\x02"
    with pytest.raises(ConnectorError, match="return code 0x30 and length 12851"):
        pdu.parse_items(memoryview(head + data), [4, 4])
    refused = b"\x77\0\0\0"  # a code that no table has
    head = struct.pack(">BxH3sBB2xHHHH", 3, 0, b"\x02\xf0\x80", 0x32, 3, 1, 2, len(refused), 0) + b"\x04\x01"
    assert [one.code for one in pdu.parse_items(memoryview(head + refused), [4])] == [0x77]


def test_an_answer_to_other_sizes_is_refused() -> None:
    data = b"\xff\x04\0\x10ab\xff\x04\0\x08c"
    head = struct.pack(">BxH3sBB2xHHHH", 3, 0, b"\x02\xf0\x80", 0x32, 3, 1, 2, len(data), 0) + b"\x04\x02"
    frame = memoryview(head + data)
    assert [bytes(one.data) for one in pdu.parse_items(frame, [2, 1])] == [b"ab", b"c"]
    with pytest.raises(ConnectorError, match="bytes of data"):
        pdu.parse_items(frame, [1, 2])


def test_an_array_of_bits_leaves_the_rest_of_its_last_byte_to_others() -> None:
    """A horn has the last bit of a byte whose first three bits are lamps."""
    source = FIELD / "bool_array_neighbours/io.toml"
    layout = compile_tags(source.name, source.read_bytes(), Report([source.name])).with_statuses()
    with (
        reserved_port() as address,
        Emulator(layout, "idle", address) as plc,
        connected(layout, address.port) as connector,
    ):
        for path, value in {"horn": True, "other": 255, "other2": 255}.items():
            assert write(connector, layout, path, value) == [""]
        assert write(connector, layout, "lamps", [True, False, True]) == [""]
        assert write(connector, layout, "flags", [[True, False, True], [False, True, False]]) == [""]
        found = values(layout, connector.read())
        assert (found["horn"], found["other"], found["other2"]) == (True, 253, 250)
        assert plc._contents.memory[Area.OUTPUT, 0][4] == 0b1000_0101
