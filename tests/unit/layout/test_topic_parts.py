"""Slices of arrays and parts of integers, compared with plain arithmetic."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import PathError
from shmio.layout.model import INTEGERS, ByteOrder, Layout, Register, array_size, element_type
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import Write, apply, bits_of, encode, paths_of
from shmio.segment.changed_registers import ChangeScan

ORDERS: st.SearchStrategy[ByteOrder] = st.sampled_from(["big", "little"])
WIDTHS = {"X": 1, "B": 8, "W": 16, "D": 32}


def integer(type_: str) -> Register:
    element = element_type(type_)
    assert element is not None
    return Register("a", type_, (), 3, None, element.size, 1)


def array(type_: str, low: int, count: int) -> Register:
    element = element_type(type_)
    assert element is not None
    bit = 0 if type_ == "BOOL" else None
    return Register("a", type_, ((low, low + count - 1),), 3, bit, array_size(element, (count,)), count)


def layout_of(register: Register, order: ByteOrder = "big") -> Layout:
    return Layout("DB1", 1, register.offset + register.size + 3, False, (register,), order)


@given(st.sampled_from(sorted(INTEGERS)), ORDERS, st.sampled_from("XBWD"), st.integers(0, 7), st.binary(min_size=14))
def test_part_of_an_integer_is_its_bits(type_: str, order: ByteOrder, kind: str, number: int, data: bytes) -> None:
    register = integer(type_)
    layout = layout_of(register, order)
    width = WIDTHS[kind]
    if kind == "X":
        number = number * register.size + register.size - 1
    elif width >= 8 * register.size or (number + 1) * width > 8 * register.size:
        with pytest.raises(PathError, match="has no such part; it has %X0 to"):
            find(layout, f"a.%{kind}{number}")
        return
    part = find(layout, f"a.%{kind}{number}")
    assert part.path == f"a.%{kind}{number}"
    image = bytearray(data[: layout.size].ljust(layout.size, b"\0"))
    whole = codec(register, order).decode(image)
    assert isinstance(whole, int)
    value = codec(part, order).decode(image)
    assert value == whole >> number * width & (1 << width) - 1
    changed = int(value) ^ (1 << width) - 1
    for write in encode(part, bool(changed) if kind == "X" else changed, order):
        apply(write, image)
    after = codec(register, order).decode(image)
    assert isinstance(after, int)
    mask = (1 << 8 * register.size) - 1
    assert (after ^ whole) & mask == (1 << width) - 1 << number * width, "no neighbour was changed"


@given(
    st.sampled_from(["BOOL", "BYTE", "INT", "REAL", "STRING[3]"]),
    st.integers(-3, 3), st.integers(1, 40), st.data(), st.binary(min_size=300, max_size=300),
)  # fmt: skip
def test_slice_is_its_elements(type_: str, low: int, count: int, data: st.DataObject, image: bytes) -> None:
    register = array(type_, low, count)
    layout = layout_of(register)
    first = data.draw(st.integers(low, low + count - 1))
    last = data.draw(st.integers(first, low + count - 1))
    part = find(layout, f"a/{first}..{last}")
    before = bytearray(image[: layout.size])
    elements = [find(layout, f"a/{index}") for index in range(first, last + 1)]
    assert repr(codec(part).decode(before)) == repr([codec(element).decode(before) for element in elements])

    own = bytearray(layout.size)
    for element in elements:
        for at, bits in enumerate(bits_of(element), element.offset):
            own[at] |= bits
    if type_ != "STRING[3]":  # its elements have a byte of padding between them
        covered = bytes(part.offset) + bits_of(part)
        assert covered.ljust(layout.size, b"\0") == bytes(own)

    one: dict[str, list[object]] = {"BOOL": [True], "REAL": [1.5], "STRING[3]": ["xy"]}
    new = one.get(type_, [7]) * len(elements)
    after = bytearray(before)
    for write in encode(part, new):
        apply(write, after)
    assert codec(part).decode(after) == new
    for index in set(range(low, low + count)) - set(range(first, last + 1)):
        other = find(layout, f"a/{index}")
        assert repr(codec(other).decode(after)) == repr(codec(other).decode(before)), "no neighbour was changed"


@given(st.integers(0, 39), st.integers(1, 40), st.integers(0, 39))
def test_scan_sees_a_change_within_a_slice_of_bits(first: int, count: int, flipped: int) -> None:
    layout = layout_of(array("BOOL", 0, 40))
    last = min(39, first + count - 1)
    scan = ChangeScan([find(layout, f"a/{first}..{last}")])
    image = bytearray(layout.size)
    image[3 + flipped // 8] ^= 1 << flipped % 8
    assert scan.changed(bytes(layout.size), bytes(image)) == ([0] if first <= flipped <= last else [])


@pytest.mark.parametrize(
    ("type_", "path", "message"),
    [
        ("REAL", "a.%X0", "REAL has no such part; only a single integer has bits, bytes and words"),
        ("TIME", "a.%X0", "TIME has no such part"),
        ("BOOL", "a.%X0", "BOOL has no such part"),
        ("BYTE", "a.%X8", "BYTE has bits 0 to 7"),
        ("BYTE", "a.%B0", r"BYTE has no such part; it has %X0 to %X7$"),
        ("DWORD", "a.%W2", r"DWORD has no such part; it has %X0 to %X31, %B0 to %B3, %W0 to %W1$"),
        ("DWORD", "a.%X0.%X0", "BOOL has no such part"),
        ("DWORD", "a/0..1", "a range must take the place of an array's last index"),
        ("DWORD", "b.%X0", "b: "),
    ],
)
def test_invalid_part_is_refused(type_: str, path: str, message: str) -> None:
    register = Register("a", "BOOL", (), 3, 0, 1, 1) if type_ == "BOOL" else Register("a", type_, (), 3, None, 4, 1)
    if type_ == "BYTE":
        register = integer(type_)
    with pytest.raises(PathError, match=message):
        find(layout_of(register), path)


def test_part_of_an_array_needs_an_element() -> None:
    layout = layout_of(array("WORD", 0, 4))
    assert find(layout, "a/2.%X3").offset == 3 + 2 * 2 + 1
    for path in ("a.%X0", "a/0..1.%X0"):
        with pytest.raises(PathError, match="an array has no such part"):
            find(layout, path)


@pytest.mark.parametrize("order", ["big", "little"])
def test_writes_are_named_by_the_paths_that_made_them(order: ByteOrder) -> None:
    registers = (
        Register("speed", "REAL", (), 0, None, 4, 1),
        Register("bytes", "BYTE", ((0, 9),), 4, None, 10, 10),
        Register("on", "BOOL", (), 14, 0, 1, 1),
        Register("off", "BOOL", (), 14, 1, 1, 1),
        Register("bits", "BOOL", ((1, 20),), 16, 0, 3, 20),
        Register("grid", "INT", ((0, 1), (1, 3)), 20, None, 12, 6),
        Register("word", "WORD", (), 32, None, 2, 1),
        Register("long", "LWORD", (), 34, None, 8, 1),
    )
    layout = Layout("DB1", 1, 42, False, registers, order)
    for paths in (
        ["speed"], ["bytes"], ["bytes/3"], ["bytes/3..7"], ["bytes/9.%X0"], ["off"], ["bits/4"], ["bits/3..12"],
        ["grid/0/2..3", "grid/1/1..2"], ["word"], ["word.%X11"], ["word.%B1"],
        ["speed", "bytes/0..1", "on", "word.%X0"], ["long.%D1"], ["long.%X7", "long.%B1", "long.%W2"], ["long.%W1"],
    ):  # fmt: skip
        writes: list[Write] = []
        for path in paths:
            part = find(layout, path)
            full: object = {"BOOL": True, "REAL": 1.0, "INT": 1, "BYTE": 1, "WORD": 1, "DWORD": 1}[part.type]
            writes += encode(part, [full] * part.count if part.dims else full, order)
        assert paths_of(layout, writes) == paths
    assert paths_of(layout, [Write(1, 0, b"\0"), Write(15, 0, b"\0"), Write(33, 0, b"\0" * 99)]) == [
        "speed", "word.%B0" if order == "big" else "word.%B1", "long",
    ]  # fmt: skip
