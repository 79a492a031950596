from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout, Register
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.segment.changed_registers import ChangeScan

TEXT = """DATA_BLOCK "b" STRUCT
    b0 : Bool; b1 : Bool; one : Byte; real : Real; bits : Array[0..1, 0..8] of Bool; odd : Array[0..1] of String[1];
    x : Bool; bytes3 : Array[0..2] of Byte; b2 : Bool; last : Bool;
    END_STRUCT; BEGIN END_DATA_BLOCK"""
LAYOUT: Layout = compile_sources([Source("x.db", TEXT.encode())]).layouts[0]
INDEX = LAYOUT.by_path


def bits_of(register: Register, frame: bytes) -> object:
    """Return the register's own bytes or bits, element by element, without the scan."""
    if register.type == "BOOL":
        return codec(register).decode(frame)
    element = register.element
    starts = range(register.offset, register.offset + register.size, element.stride)
    return [frame[start : start + element.size] for start in starts]


def naive(old: bytes, new: bytes) -> list[int]:
    return [i for i, r in enumerate(LAYOUT.registers) if bits_of(r, old) != bits_of(r, new)]


frames = st.binary(min_size=LAYOUT.size, max_size=LAYOUT.size)


@given(frames, st.lists(st.tuples(st.integers(0, LAYOUT.size - 1), st.integers(0, 255)), max_size=5))
def test_the_scan_equals_a_comparison_of_each_register(old: bytes, changes: list[tuple[int, int]]) -> None:
    new = bytearray(old)
    for position, value in changes:
        new[position] = value
    scan = ChangeScan(LAYOUT.registers)
    assert scan.changed(old, bytes(new)) == naive(old, bytes(new))
    chosen = [INDEX["last"], INDEX["one"], INDEX["bits"]]
    wanted = [position for position, index in enumerate(chosen) if index in naive(old, bytes(new))]
    assert ChangeScan([LAYOUT.registers[i] for i in chosen]).changed(old, bytes(new)) == wanted


def test_a_change_of_each_single_bit_is_found() -> None:
    old = bytes(LAYOUT.size)
    for bit in range(LAYOUT.size * 8):
        new = bytearray(old)
        new[bit // 8] |= 1 << bit % 8
        changed = ChangeScan(LAYOUT.registers).changed(old, bytes(new))
        assert changed == naive(old, bytes(new)), bit
        assert len(changed) <= 1, bit


@pytest.mark.parametrize(("low", "high"), [(0, 3), (2, 5), (0, 7), (3, 8), (5, 19), (8, 19), (16, 19), (19, 19)])
def test_a_slice_of_bits_changes_only_with_its_own_bits(low: int, high: int) -> None:
    layout = compile_sources([Source("x.toml", b'[registers]\nrow = "ARRAY[0..19] OF BOOL"')]).layouts[0]
    part = find(layout, f"row/{low}..{high}")
    for bit in range(layout.size * 8):
        new = bytearray(layout.size)
        new[bit // 8] |= 1 << bit % 8
        assert ChangeScan([part]).changed(bytes(layout.size), bytes(new)) == ([0] if low <= bit <= high else []), bit


def test_bytes_are_compared_not_values() -> None:
    scan = ChangeScan(LAYOUT.registers)
    at = LAYOUT.registers[INDEX["real"]].offset

    def frame(value: float) -> bytes:
        return bytes(at) + struct.pack(">f", value) + bytes(LAYOUT.size - at - 4)

    assert scan.changed(frame(math.nan), frame(math.nan)) == []
    assert scan.changed(frame(-math.nan), frame(-math.nan)) == []
    assert scan.changed(frame(0.0), frame(-0.0)) == [INDEX["real"]]


def test_all_changed_none_changed_and_a_wrong_size() -> None:
    old, new = bytes(LAYOUT.size), b"\xff" * LAYOUT.size
    assert ChangeScan(LAYOUT.registers).changed(old, new) == list(range(len(LAYOUT.registers)))
    assert ChangeScan([]).changed(old, new) == []
    with pytest.raises(ValueError, match="one size"):
        ChangeScan(LAYOUT.registers).changed(old, new + b"x")
    with pytest.raises(ValueError, match="outside"):
        ChangeScan(LAYOUT.registers).changed(old[:4], new[:4])


@pytest.mark.parametrize("size", [200, 65_536, 65_600, 200_000])
def test_a_change_is_found_wherever_it_is(size: int) -> None:
    """The scan compares images in pieces first; a register may span several pieces."""
    each = 100
    registers = [
        Register(f"r{at}", "BYTE", ((1, each),), at, None, each, each) for at in range(0, size - each + 1, each)
    ]
    scan, old = ChangeScan(registers), bytes(size)
    last = len(registers) * each - 1
    for places in ([0], [63], [64], [65], [127, 128], [199], [last - 99], [last], [0, size // 2, last]):
        new = bytearray(old)
        for place in places:
            new[min(place, last)] = 1
        assert scan.changed(old, bytes(new)) == sorted({min(place, last) // each for place in places}), places
    everything = scan.changed(old, b"\1" * size)
    assert everything == list(range(len(registers)))
