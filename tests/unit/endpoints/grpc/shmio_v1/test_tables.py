"""Images become packed arrays and then a client's numpy arrays. The results are compared with the codec's.

The codec has its own tests with fixed bytes.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.client.table import Table, Values
from shmio.endpoints.grpc.shmio_v1.tables import KINDS, Columns, describe, merge, pack
from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import Value, codec
from shmio.model.values import Column
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.layout.values.test_frame_codec import LAYOUT

LITTLE = replace(LAYOUT, byte_order="little")


def table_of(registers: list[Register], columns: Columns) -> Table:
    table = wire.Table(number=1, source="cell", slots=[0, *columns.sizes.values()])
    for register, (column, slot) in zip(registers, columns.places, strict=True):
        describe(register, table.registers.add(), column, slot)
    return Table(wire.Table.FromString(table.SerializeToString()))


def plain(value: Value, register: Register) -> Any:
    """Return the value that a client receives for a register's value.

    An invalid element of an array becomes zero or an empty text.
    """
    if isinstance(value, list):
        return [plain(item, register) for item in value]
    if value is None:
        return "" if register.element.base not in ("S5TIME", "TIME_OF_DAY", "LTOD") else 0
    return value


def same(found: Any, wanted: Any) -> bool:
    if isinstance(wanted, list):
        return len(found) == len(wanted) and all(map(same, found, wanted))
    if isinstance(wanted, float) and math.isnan(wanted):
        return bool(np.isnan(found))
    return bool(found == wanted)


def check(table: Table, registers: list[Register], layout: Layout, image: bytes) -> None:
    for place, register in enumerate(registers):
        wanted = plain(codec(register, layout.byte_order).decode(image), register)
        assert same(table.value(place), wanted), register.path


BY_PATH = {register.path: register for register in LAYOUT.registers}
chosen = st.lists(st.sampled_from(list(BY_PATH)), min_size=1, max_size=12, unique=True)
seeds = st.integers(0, 1 << 32)


def random_image(seed: int) -> bytes:
    """Return random bytes with many zeros, so that some of them are valid dates and texts."""
    random = np.random.default_rng(seed)
    return bytes(
        random.integers(0, 256, LAYOUT.size, np.uint8) * (random.random(LAYOUT.size) < seed % 5 / 4).astype(np.uint8)
    )


@given(paths=chosen, little=st.booleans(), one=seeds, other=seeds, keep=st.floats(0, 1))
def test_decoded_tables_equal_the_codecs_values(
    paths: list[str], little: bool, one: int, other: int, keep: float
) -> None:
    registers, layout = [BY_PATH[path] for path in paths], LITTLE if little else LAYOUT
    first, second = random_image(one), random_image(other)
    columns = Columns(registers, layout.byte_order)
    table = table_of(registers, columns)
    before = columns.decode(first)
    table.apply(Values.FromString(pack(before)))
    check(table, registers, layout, first)
    cut = round(keep * layout.size)
    image = first[:cut] + second[cut:]
    now = columns.decode(image)
    changes = table.apply(Values.FromString(pack(now, before)))
    check(table, registers, layout, image)
    # ``changed`` names exactly the registers whose values differ.
    told = {registers[place].path for place in table.changed(changes)}
    for register in registers:
        old, new = (codec(register, layout.byte_order).decode(data) for data in (first, image))
        assert (repr(plain(old, register)) != repr(plain(new, register))) == (register.path in told), register.path
    invalid = [
        place
        for place, register in enumerate(registers)
        if holds_none(codec(register, layout.byte_order).decode(image))
    ]
    assert list(now.invalid) == invalid


@given(paths=chosen, little=st.booleans(), one=seeds, other=seeds, part=seeds)
def test_encoded_arrays_equal_the_codecs_bytes(paths: list[str], little: bool, one: int, other: int, part: int) -> None:
    registers, layout = [BY_PATH[path] for path in paths], LITTLE if little else LAYOUT
    columns = Columns(registers, layout.byte_order)
    image, given = random_image(one), columns.decode_numbers(random_image(other))
    found, wanted = bytearray(image), bytearray(image)
    random = np.random.default_rng(part)
    for column, values in given.items():
        slots = np.concatenate([random.permutation(len(values))[: part % 9], random.integers(0, len(values), 2)])
        left = set(columns.encode(column, slots, values[slots], found).tolist())
        for at, slot in enumerate(slots.tolist()):
            place = columns.place(column, slot)
            assert place is not None
            register = registers[place]
            if at in left:
                assert register.element.base in ("S5TIME", "TIME_OF_DAY", "LTOD")
                continue
            if register.dims:
                flat = np.unravel_index(slot - columns.places[place][1], register.shape)
                index = tuple(int(i) + low for i, (low, _) in zip(flat, register.dims, strict=True))
                register = layout.element(register, index)
            codec(register, layout.byte_order).encode_into(values[slot].item(), wanted)
    assert found == wanted


def test_numbers_out_of_range_are_not_encoded_and_are_reported() -> None:
    register = Register("count", "INT", (), 0, None, 2, 1)
    columns, image = Columns([register], "big"), bytearray(2)
    slots = np.zeros(3, np.int64)
    assert columns.encode(Column.INT32, slots, np.array([1 << 15, -2, -(1 << 15) - 1]), image).tolist() == [0, 2]
    assert image == b"\xff\xfe"


def holds_none(value: Value) -> bool:
    return any(map(holds_none, value)) if isinstance(value, list) else value is None


@given(seed=seeds)
def test_an_unchanged_image_packs_to_nothing(seed: int) -> None:
    image = random_image(seed)
    columns = Columns(LAYOUT.registers, "big")
    assert pack(columns.decode(image), columns.decode(bytes(image))) == b""


@given(path=st.sampled_from([r.path for r in LAYOUT.registers if r.dims]), seed=seeds, data=st.data())
def test_only_the_changed_elements_of_an_array_are_sent(path: str, seed: int, data: Any) -> None:
    register, image = BY_PATH[path], random_image(seed)
    index = tuple(data.draw(st.integers(low, high)) for low, high in register.dims)
    element = LAYOUT.element(register, index)
    columns = Columns([register], "big")
    changed = bytearray(image)
    mask = 0xFF if element.bit is None else 1 << element.bit
    for at in range(element.offset, element.offset + element.size):
        changed[at] ^= mask
    values = wire.Values.FromString(pack(columns.decode(bytes(changed)), columns.decode(image)))
    flat = int(
        np.ravel_multi_index([i - low for i, (low, _) in zip(index, register.dims, strict=True)], register.shape)
    )
    for name in ("bools", "int32s", "int64s", "uint64s", "floats", "doubles", "texts"):
        assert set(getattr(values, name).slots) <= {flat}


@given(
    old=st.lists(st.floats(width=32), min_size=1, max_size=8),
    steps=st.lists(st.lists(st.floats(width=32), min_size=8, max_size=8), max_size=6),
    deadband=st.floats(0.001, 1e6),
)
def test_a_client_is_never_off_by_more_than_the_dead_band(
    old: list[float], steps: list[list[float]], deadband: float
) -> None:
    register = Register("a", "REAL", ((0, len(old) - 1),), 0, None, 4 * len(old), len(old))
    columns = Columns([register], "big")
    sent = columns.decode(np.array(old, ">f4").tobytes())
    table = table_of([register], columns)
    table.apply(Values.FromString(pack(sent)))
    for step in steps:
        now = columns.decode(np.array(step[: len(old)], ">f4").tobytes())
        table.apply(Values.FromString(pack(now, sent, deadband)))
        sent = merge(now, sent, deadband)
        np.testing.assert_array_equal(table.value(0), sent.arrays[Column.FLOAT])
        for seen, true in zip(table.value(0).tolist(), step, strict=False):
            assert seen == true or (math.isnan(seen) and math.isnan(true)) or abs(seen - true) <= deadband


@pytest.mark.parametrize(
    ("type_", "raw", "column", "value"),
    [
        ("BOOL", "08", Column.BOOL, True),
        ("USINT", "ff", Column.INT32, 255),
        ("INT", "8000", Column.INT32, -32768),
        ("WORD", "ffff", Column.INT32, 65535),
        ("DINT", "80000000", Column.INT32, -(1 << 31)),
        ("UDINT", "ffffffff", Column.INT64, (1 << 32) - 1),
        ("LINT", "8000000000000000", Column.INT64, -(1 << 63)),
        ("ULINT", "ffffffffffffffff", Column.UINT64, (1 << 64) - 1),
        ("REAL", "3dcccccd", Column.FLOAT, np.float32(0.1)),
        ("LREAL", "3fb999999999999a", Column.DOUBLE, 0.1),
        ("TIME", "ffffffff", Column.INT32, -1),
        ("LTIME", "0000000000000001", Column.INT64, 1),
        ("TIME_OF_DAY", "0526 5bff", Column.INT32, 86_399_999),
        ("S5TIME", "1123", Column.INT32, 12_300),
        ("DATE", "0000", Column.TEXT, "1990-01-01"),
        ("STRING[3]", "0302 e461 00", Column.TEXT, "äa"),
    ],
)
def test_fixed_bytes_of_each_type_decode_to_known_values(type_: str, raw: str, column: Column, value: Any) -> None:
    image = bytes.fromhex(raw)
    register = Register("a", type_, (), 0, 3 if type_ == "BOOL" else None, len(image), 1)
    columns = Columns([register], "big")
    assert columns.places == [(column, 0)]
    table = table_of([register], columns)
    (change,) = table.apply(Values.FromString(pack(columns.decode(image))))
    assert int(change.column) == column
    assert table.value(0) == value
    if column in KINDS:
        assert not change.values.flags.writeable


@given(paths=chosen, encoding=st.sampled_from(["windows-1252", "gbk", "utf-8"]), seed=seeds)
def test_texts_have_the_encoding_of_their_register(paths: list[str], encoding: str, seed: int) -> None:
    """Any bytes become texts that the wire can hold, and the client knows the encoding."""
    layout, image = LAYOUT.with_encoding(encoding), random_image(seed)
    registers = [layout.registers[layout.by_path[path]] for path in paths]
    columns = Columns(registers, layout.byte_order)
    table = table_of(registers, columns)
    table.apply(Values.FromString(pack(columns.decode(image))))
    check(table, registers, layout, image)
    assert [one.encoding for one in table.registers] == [one.encoding for one in registers]
