"""The connector against a device made with libmodbus."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest

from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.commands import Item, coalesce, ends
from shmio.connectors.modbus import connector as module
from shmio.connectors.modbus import plan
from shmio.connectors.modbus.client import ModbusClient, RefusedError
from shmio.connectors.modbus.connector import ModbusConnector, ModbusOptions
from shmio.connectors.registry import convert_options
from shmio.errors import ConfigError
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import Write, encode
from shmio.model.statuses import (
    BAD_OUT_OF_RANGE,
    BAD_TIMEOUT,
    GOOD,
    StatusArea,
)
from shmio.segment import Command
from shmio.testing.proxy import FaultProxy
from tests.unit.connectors.modbus.device import WORDS, Device


@pytest.fixture
def device() -> Iterator[Device]:
    with Device() as device:
        yield device


def options_of(given: dict[str, Any]) -> ModbusOptions:
    """Return the options as the configuration would give them."""
    found = convert_options("modbus", given)
    assert isinstance(found, ModbusOptions)
    return found


def layout_of(tags: Mapping[str, object]) -> Layout:
    return place_tags("plant", tags).with_statuses()


@contextmanager
def connected(device: Device, tags: Mapping[str, object], **options: Any) -> Iterator[tuple[ModbusConnector, Layout]]:
    layout = layout_of(tags)
    given = {"host": device.address.host, "port": device.address.port, "timeout": 5000} | options
    connector = ModbusConnector(options_of(given), layout)
    try:
        connector.connect()
        yield connector, layout
    finally:
        connector.close()


def values(connector: ModbusConnector, layout: Layout) -> dict[str, object]:
    image = connector.read()
    area = StatusArea(layout)
    return {
        register.path: codec(register, layout.byte_order).decode(image)
        if (code := area.get(image, index).code) == GOOD
        else hex(code)
        for index, register in enumerate(layout.registers)
    }


def tag(kind: str, address: str, **more: Any) -> dict[str, Any]:
    return {"type": kind, "address": address, **more}


def words(code: str, *numbers: Any) -> list[int]:
    data = struct.pack(f">{code}", *numbers)
    return list(struct.unpack(f">{len(data) // 2}H", data))


def test_all_tables_and_types(device: Device) -> None:
    device.set("coil", 3, [1])
    device.set("discrete", 10, [1, 0, 1, 1, 0, 0, 0, 0, 1])
    device.set("input", 7, words("h", -5))
    device.set("holding", 0, words("HhIiQqfd", 65000, -2, 4_000_000_000, -7, 2**63, -9, 1.5, -2.25))
    device.set("holding", 40, [0x4142, 0x4300, 0xFFFF], unit=2)
    device.set("holding", 50, [0b1000])
    tags = {
        "lamp": tag("BOOL", "coil 3"),
        "inputs": tag("ARRAY[0..8] OF BOOL", "discrete 10"),
        "temperature": tag("INT", "input 7"),
        "u16": tag("UINT", "holding 0"),
        "i16": tag("INT", "40002"),
        "u32": tag("UDINT", "holding 2"),
        "i32": tag("DINT", "400005"),
        "u64": tag("ULINT", "holding 6"),
        "i64": tag("LINT", "holding 10"),
        "f32": tag("REAL", "holding 14"),
        "f64": tag("LREAL", "holding 16"),
        "name": tag("STRING[4]", "unit 2 holding 40"),
        "byte": tag("BYTE", "unit 2 holding 42"),
        "flag": tag("BOOL", "holding 50.3"),
        "list": tag("ARRAY[1..2, 0..1] OF UINT", "holding 0"),
    }
    with connected(device, tags) as (connector, layout):
        assert values(connector, layout) == {
            "lamp": True, "inputs": [True, False, True, True, False, False, False, False, True], "temperature": -5,
            "u16": 65000, "i16": -2, "u32": 4_000_000_000, "i32": -7, "u64": 2**63, "i64": -9, "f32": 1.5,
            "f64": -2.25, "name": "ABC", "byte": 0xFF, "flag": True, "list": [[65000, 65534], [0xEE6B, 0x2800]],
        }  # fmt: skip


@pytest.mark.parametrize(
    ("word_order", "byte_order", "sent"),
    [
        ("big", "big", [0x0102, 0x0304]),
        ("little", "big", [0x0304, 0x0102]),
        ("big", "little", [0x0201, 0x0403]),
        ("little", "little", [0x0403, 0x0201]),
    ],
)
def test_word_and_byte_order_in_both_directions(
    device: Device, word_order: str, byte_order: str, sent: list[int]
) -> None:
    device.set("holding", 5, sent)
    tags = {"n": tag("UDINT", "holding 5"), "b": tag("ARRAY[0..1] OF DWORD", "holding 20")}
    with connected(device, tags, word_order=word_order, byte_order=byte_order) as (connector, layout):
        assert values(connector, layout)["n"] == 0x01020304
        assert connector.write(encode(layout.registers[1], [0, 0x01020304], "little")) == [""]
        assert device.get("holding", 22, 2) == sent
        for bit in (0, 9, 17, 30):
            register = find(layout, f"b/1.%X{bit}")
            assert connector.write(encode(register, not 0x01020304 >> bit & 1, "little")) == [""]
            assert values(connector, layout)["b"] == [0, 0x01020304 ^ 1 << bit]
            assert connector.write(encode(register, bool(0x01020304 >> bit & 1), "little")) == [""]


def test_a_tag_may_have_its_own_order_of_words_and_bytes(device: Device) -> None:
    """The tag's keys override those of the source, in both directions."""
    orders: dict[str, dict[str, str]] = {
        "AABB CCDD": {},
        "CCDD AABB": {"word_order": "little"},
        "BBAA DDCC": {"byte_order": "little"},
        "DDCC BBAA": {"word_order": "little", "byte_order": "little"},
    }
    tags = {name: tag("UDINT", f"holding {10 * at}", **keys) for at, (name, keys) in enumerate(orders.items())}
    tags["as the source"] = tag("UDINT", "holding 60", byte_order="big")
    for at, name in enumerate(orders):
        device.set("holding", 10 * at, [int(word, 16) for word in name.split()])
    device.set("holding", 60, [0x1122, 0x3344])
    with connected(device, tags) as (connector, layout):
        assert values(connector, layout) == dict.fromkeys(orders, 0xAABBCCDD) | {"as the source": 0x11223344}
        for at, name in enumerate(orders):
            assert connector.write(encode(find(layout, f"{name}"), 0x01020304, "little")) == [""]
            sent = bytes.fromhex(name.replace("AA", "01").replace("BB", "02").replace("CC", "03").replace("DD", "04"))
            assert device.get("holding", 10 * at, 2) == list(struct.unpack(">2H", sent))
            assert connector.write(encode(find(layout, f"{name}.%X8"), True, "little")) == [""]
            assert values(connector, layout)[name] == 0x01020304 | 1 << 8


def test_scales_and_types_of_the_device(device: Device) -> None:
    device.set("holding", 0, words("hH", -125, 40000))
    tags = {
        "level": tag("REAL", "holding 0 INT", scale=[0.1, 20]),
        "count": tag("DINT", "holding 1 UINT"),
        "whole": tag("INT", "holding 0", scale=2),
    }
    with connected(device, tags) as (connector, layout):
        assert values(connector, layout) == {"level": 7.5, "count": 40000, "whole": -250}
        assert connector.write(encode(find(layout, "level"), 20.5, "little")) == [""]
        assert device.get("holding", 0) == [5]
        (refusal,) = connector.write(encode(find(layout, "count"), 70_000, "little"))
        assert "does not fit the device's UINT" in refusal
        assert device.get("holding", 1) == [40000]


def test_requests_are_merged_within_the_limits(device: Device) -> None:
    device.set("holding", 0, list(range(700)))
    tags = {f"n{at}": tag("UINT", f"holding {at}") for at in range(0, 600, 2)}
    tags["long"] = tag("ARRAY[0..299] OF UINT", "holding 400")
    tags["coils"] = tag("ARRAY[1..100] OF BOOL", "coil 0")
    with connected(device, tags, max_bits=64) as (connector, layout):
        found = values(connector, layout)
        assert [found[f"n{at}"] for at in range(0, 600, 2)] == list(range(0, 600, 2))
        assert found["long"] == list(range(400, 700))
        counts = [(function, count) for function, _, count in device.calls()]
        assert counts == [(1, 64), (1, 36), *[(3, 125)] * 5, (3, 72)]


def test_one_bad_address_among_good_ones_is_bad_alone_and_not_asked_in_each_cycle(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_ns = [10**12]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    tags = {f"n{at}": tag("UINT", f"holding {WORDS - 50 + at}") for at in range(60)}
    with connected(device, tags) as (connector, layout):
        found = values(connector, layout)
        for at in range(60):
            assert found[f"n{at}"] == (0 if at < 50 else hex(BAD_OUT_OF_RANGE))
        assert len(device.calls()) <= 1 + plan.MAX_PROBES + 1
        for _ in range(3):  # the search for ten addresses takes several cycles
            assert values(connector, layout) == found
        device.calls()
        connector.close()
        connector.connect()  # what is known outlives the connection
        assert values(connector, layout) == found
        assert all(address + count <= WORDS for _, address, count in device.calls())
        now_ns[0] += plan.RETRY_NS
        values(connector, layout)
        assert any(address >= WORDS for _, address, _ in device.calls())


def test_writes_of_all_kinds(device: Device) -> None:
    device.set("holding", 30, [0b0101])
    tags = {
        "lamp": tag("BOOL", "coil 3"),
        "lamps": tag("ARRAY[0..19] OF BOOL", "coil 10"),
        "speed": tag("REAL", "holding 10"),
        "list": tag("ARRAY[0..299] OF UINT", "holding 100"),
        "flag": tag("BOOL", "holding 30.1"),
        "word": tag("WORD", "holding 30"),
        "name": tag("STRING[5]", "unit 2 holding 40"),
        "byte": tag("BYTE", "holding 60"),
        "small": tag("SINT", "holding 61"),
        "bytes": tag("ARRAY[0..2] OF BYTE", "holding 62"),
    }
    device.set("holding", 60, [0x1234, 0xABCD, 0x1111, 0x2222, 0x3333])
    with connected(device, tags) as (connector, layout):

        def write(path: str, value: object) -> list[str]:
            return connector.write(encode(find(layout, path), value, "little"))

        assert write("lamp", True) == write("lamps/7", True) == [""]
        assert device.get("coil", 3) == [1]
        assert [bool(one) for one in device.get("coil", 10, 20)] == [at == 7 for at in range(20)]
        assert set(write("lamps", [at % 3 == 0 for at in range(20)])) == {""}
        assert [bool(one) for one in device.get("coil", 10, 20)] == [at % 3 == 0 for at in range(20)]
        assert set(write("lamps/3..5", [False, True, True])) == {""}
        assert [bool(one) for one in device.get("coil", 12, 5)] == [False, False, True, True, True]
        assert write("speed", -2.5) == [""]
        assert device.get("holding", 10, 2) == words("f", -2.5)
        assert write("list", list(range(300))) == [""]
        assert device.get("holding", 100, 300) == list(range(300))
        assert write("list/7", 9) == [""]
        assert device.get("holding", 106, 3) == [6, 9, 8]
        assert write("flag", True) == write("word.%X12", True) == [""]
        assert device.get("holding", 30) == [0b0101 | 2 | 1 << 12]
        assert write("name", "abc") == [""]
        assert device.get("holding", 40, 3, unit=2) == [0x6162, 0x6300, 0]
        assert write("byte", 7) == write("small", -1) == [""]
        assert write("bytes", [7, 8, 9]) == [""]
        assert device.get("holding", 60, 5) == [0x1207, 0xABFF, 0x1107, 0x2208, 0x3309]
        assert {call[0] for call in device.calls()} == {5, 6, 15, 16, 22}


def test_the_longest_text_that_can_be_read_can_be_written(device: Device) -> None:
    text = "".join(chr(97 + at % 26) for at in range(250))
    with connected(device, {"name": tag("STRING[250]", "holding 40")}) as (connector, layout):
        assert connector.write(encode(find(layout, "name"), text, "little")) == [""]
        assert values(connector, layout) == {"name": text}
        assert [call[0] for call in device.calls()].count(16) == 2


def test_a_write_that_is_refused_half_way_says_so(device: Device) -> None:
    tags = {"list": tag("ARRAY[0..299] OF UINT", f"holding {WORDS - 200}")}
    with connected(device, tags) as (connector, layout):
        [reason] = connector.write(encode(find(layout, "list"), list(range(1, 301)), "little"))
        assert "a part was written" in reason
        assert "illegal data address" in reason
        assert device.get("holding", WORDS - 200, 2) == [1, 2]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"type": "INT"}, "`address` is missing"),
        (tag("INT", "hold 3"), "is not a Modbus address"),
        (tag("INT", "holding 70000"), "the number must be from 0 to 65535"),
        (tag("INT", "unit 300 holding 1"), "the unit id from 0 to 255"),
        (tag("INT", "40000"), "the number must be from 0"),
        (tag("BOOL", "holding 3"), "a BOOL needs a coil"),
        (tag("INT", "coil 3"), "a INT needs a word"),
        (tag("BOOL", "holding 3.16"), "has bits, numbered 0 to 15"),
        (tag("ARRAY[0..3] OF BOOL", "holding 3.1"), "an array of BOOL needs coils"),
        (tag("DATE", "holding 3"), "Modbus has no DATE"),
        (tag("INT", "holding 3 STRING[4]"), "does not fit a"),
        (tag("INT", "holding 3 FOO"), "unknown type 'FOO'"),
        (tag("DINT", "holding 65535"), "ends after address 65535"),
        (tag("INT", "input 3", writable=True), "nothing can be written to the table input"),
        (tag("STRING[254]", "holding 3"), "127 words"),
    ],
)
def test_a_wrong_address_is_named_with_its_register(entry: Mapping[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=r"layout: (plant/x: )?") as error:
        ModbusConnector(options_of({"host": "127.0.0.1"}), layout_of({"plant/x": entry}))
    assert message in str(error.value)


def test_a_unit_that_does_not_answer_its_gateway_leaves_the_others_good(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_ns = [10**12]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    tags = {"here": tag("UINT", "holding 1"), "there": tag("UINT", "unit 9 holding 1")}
    tags["too"] = tag("BOOL", "unit 9 coil 1")
    with connected(device, tags) as (connector, layout):
        bad = hex(BAD_TIMEOUT)
        assert values(connector, layout) == {"here": 0, "there": bad, "too": bad}
        assert len(device.calls()) == 2  # the second request to the unit is not sent: it would cost a time-out
        now_ns[0] += module.GATEWAY_RETRY_NS
        assert values(connector, layout)["here"] == 0
        assert len(device.calls()) == 2


def test_a_gap_may_join_two_requests(device: Device) -> None:
    tags = {"one": tag("UINT", "holding 0"), "two": tag("UINT", "holding 20")}
    for max_gap, expected in ((18, [(3, 0, 1), (3, 20, 1)]), (19, [(3, 0, 21)])):
        with connected(device, tags, max_gap=max_gap) as (connector, _):
            connector.read()
            assert device.calls() == expected


def test_each_lost_write_is_reported_by_what_is_known_of_it(device: Device) -> None:
    tags = {"list": tag("ARRAY[0..2] OF UINT", "holding 0")}
    framing = lambda data: 6 + int.from_bytes(data[4:6], "big") if len(data) >= 6 else 0  # noqa: E731
    with FaultProxy(device.address, framing=framing) as proxy:
        address = proxy.address
        with connected(device, tags, host=address.host, port=address.port, timeout=300) as (connector, layout):
            passed = iter((True, False))
            proxy.edit(lambda frame: frame if next(passed, False) else None)
            writes = [encode(find(layout, f"list/{place}"), 7, "little")[0] for place in range(3)]
            with pytest.raises(WriteLostError, match="no answer within 300 ms") as lost:
                connector.write(writes)
            assert lost.value.outcomes == ("", Lost.UNKNOWN, Lost.UNSENT)
            assert not device.get("holding", 2)[0]
            with pytest.raises(WriteLostError, match="not connected") as lost:
                connector.write(writes[:1])
            assert lost.value.outcomes == (Lost.UNSENT,)


def test_a_part_of_a_value_is_refused_and_changes_nothing(device: Device) -> None:
    device.set("holding", 0, [0x1234, 0x1122, 0x3344])
    tags = {"w": tag("WORD", "holding 0"), "d": tag("DWORD", "holding 1"), "name": tag("STRING[3]", "holding 5")}
    with connected(device, tags) as (connector, layout):
        for path in ("w.%B0", "w.%B1", "d.%W0", "d.%W1", "d.%B2"):
            (reason,) = connector.write(encode(find(layout, path), 7, "little"))
            assert "a part of a value" in reason, path
        (reason,) = connector.write([Write(find(layout, "name").offset, 0, b"\x0a\xff123")])
        assert "not a valid STRING[3]" in reason
        assert device.get("holding", 0, 7) == [0x1234, 0x1122, 0x3344, 0, 0, 0, 0]
        assert device.calls() == []


def test_a_text_of_odd_length_ends_before_the_next_byte(device: Device) -> None:
    device.set("holding", 0, [0x4142, 0x4344, 0x4520])
    with connected(device, {"name": tag("STRING[5]", "holding 0")}) as (connector, layout):
        assert values(connector, layout) == {"name": "ABCDE"}


def test_a_unit_that_lacks_function_22_does_not_cost_the_others(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = ModbusClient.write

    def refusing(client: ModbusClient, unit: int, function: int, data: bytes) -> None:
        if (unit, function) == (2, 22):
            raise RefusedError(1)
        write(client, unit, function, data)

    monkeypatch.setattr(ModbusClient, "write", refusing)
    device.set("holding", 0, [0x00F0], unit=2)
    tags = {"a": tag("BOOL", "holding 0.1"), "b": tag("BOOL", "unit 2 holding 0.1")}
    with connected(device, tags) as (connector, layout):
        for path in ("b", "a", "b"):
            assert connector.write(encode(find(layout, path), True, "little")) == [""]
        assert [function for function, _, _ in device.calls()] == [3, 6, 22, 3, 6]
        assert (device.get("holding", 0), device.get("holding", 0, unit=2)) == ([2], [0x00F2])


def carried_out(connector: ModbusConnector, layout: Layout, *wanted: tuple[str, object]) -> list[tuple[str, str]]:
    """Carry out commands of one cycle, one for each path; return the kind and text of each command's last event."""
    items = [
        Item(Command(1, number, 1, 1 << 62, (write,)), 0)
        for number, (path, value) in enumerate(wanted, 1)
        for write in encode(find(layout, path), value, "little")
    ]
    writes, superseded = coalesce(items, layout.size)
    return [
        (kind.name.lower(), text) for kind, text in ends(items, writes, superseded, connector.write(writes), "lost")
    ]


def test_word_and_bit_of_two_commands_are_written_as_one_word(device: Device) -> None:
    tags = {"word": tag("WORD", "holding 4"), "long": tag("DWORD", "holding 6"), "other": tag("INT", "holding 9")}
    with connected(device, tags) as (connector, layout):
        wanted = ("word", 0x1234), ("other", -2), ("word.%X0", True), ("word.%X15", True)
        assert carried_out(connector, layout, *wanted) == [("written", "")] * 4
        assert device.get("holding", 4) == [0x9235]
        assert device.get("holding", 9) == words("h", -2)
        assert sorted(call[0] for call in device.calls()) == [6, 6]
        assert carried_out(connector, layout, ("long", 0), ("long.%W1", 7)) == [("written", "")] * 2
        assert device.get("holding", 6, 2) == [7, 0]
        superseded = "superseded by a later write of the same cycle"
        assert carried_out(connector, layout, ("word.%X0", False), ("word", 1)) == [
            ("written", superseded),
            ("written", ""),
        ]
        assert device.get("holding", 4) == [1]


def test_the_items_of_a_command_are_written_in_their_order(device: Device) -> None:
    """Two registers may lie over the same word; the later item counts, wherever the registers are in the table."""
    tags = {"byte": tag("BYTE", "holding 4"), "word": tag("WORD", "holding 4")}
    with connected(device, tags) as (connector, layout):
        for order, found in ((("word", 0x1234), ("byte", 7)), 0x1207), ((("byte", 7), ("word", 0x1234)), 0x1234):
            writes = [one for path, value in order for one in encode(find(layout, path), value, "little")]
            command = Command(1, 1, 1, 1 << 62, tuple(writes))
            batch, _ = coalesce([Item(command, place) for place in range(len(writes))], layout.size)
            assert connector.write(batch) == ["", ""]
            assert device.get("holding", 4) == [found]


def test_bits_of_two_commands_stay_two_requests(device: Device) -> None:
    device.set("holding", 4, [0b1000])
    with connected(device, {"word": tag("WORD", "holding 4")}) as (connector, layout):
        assert carried_out(connector, layout, ("word.%X0", True), ("word.%X1", True)) == [("written", "")] * 2
        assert device.get("holding", 4) == [0b1011]
        assert [call[0] for call in device.calls()] == [22, 22]


def test_refusal_of_joined_writes_is_that_of_their_commands_alone(device: Device) -> None:
    tags = {
        "word": tag("WORD", f"holding {WORDS}"),
        "other": tag("INT", "holding 9"),
        "slice": tag("WORD", "holding 2"),
    }
    with connected(device, tags) as (connector, layout):
        wanted = ("word", 5), ("other", 3), ("word.%X3", True), ("slice.%B0", 1), ("slice.%X9", True)
        found = carried_out(connector, layout, *wanted)
        assert [kind for kind, _ in found] == ["refused", "written", "refused", "refused", "written"]
        assert "illegal data address" in found[0][1]
        assert found[2] == found[0]
        assert "a part of a value" in found[3][1]
        assert device.get("holding", 9) == [3]
        assert device.get("holding", 2) == [0x200]


def test_loss_of_joined_writes_is_unknown_for_their_commands_alone(device: Device) -> None:
    tags = {"word": tag("WORD", "holding 4"), "first": tag("INT", "holding 1"), "last": tag("INT", "holding 9")}
    framing = lambda data: 6 + int.from_bytes(data[4:6], "big") if len(data) >= 6 else 0  # noqa: E731
    with FaultProxy(device.address, framing=framing) as proxy:
        address = proxy.address
        with connected(device, tags, host=address.host, port=address.port, timeout=300) as (connector, layout):
            passed = iter((True, False))
            proxy.edit(lambda frame: frame if next(passed, False) else None)
            wanted = ("first", 1), ("word", 5), ("word.%X3", True), ("last", 1)
            items = [
                Item(Command(1, number, 1, 1 << 62, (write,)), 0)
                for number, (path, value) in enumerate(wanted, 1)
                for write in encode(find(layout, path), value, "little")
            ]
            writes, superseded = coalesce(items, layout.size)
            with pytest.raises(WriteLostError) as lost:
                connector.write(writes)
            found = ends(items, writes, superseded, lost.value.outcomes, "lost")
            assert [kind.name for kind, _ in found] == ["WRITTEN", "UNKNOWN", "UNKNOWN", "EXPIRED"]


@pytest.mark.parametrize("word_order", ["big", "little"])
@pytest.mark.parametrize("byte_order", ["big", "little"])
def test_copied_and_converted_values_are_the_same(device: Device, word_order: str, byte_order: str) -> None:
    device.set("holding", 0, list(range(0x3FF0, 0x3FF0 + 200)))
    kinds = {"INT": 1, "UINT": 1, "WORD": 1, "DINT": 2, "REAL": 2, "DWORD": 2, "LINT": 4, "LREAL": 4}
    tags, number = {}, 0
    for kind, width in kinds.items():
        for at in range(5):
            tags[f"{kind}{at}"] = tag(kind, f"holding {number}")
            tags[f"list_{kind}{at}"] = tag(f"ARRAY[0..0] OF {kind}", f"holding {number}")  # arrays are converted
            number += width
    with connected(device, tags, word_order=word_order, byte_order=byte_order) as (connector, layout):
        found = values(connector, layout)
        for path in tags:
            if not path.startswith("list"):
                assert [found[path]] == found[f"list_{path}"], path
