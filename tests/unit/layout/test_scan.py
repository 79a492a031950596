from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.layout.codec import codec
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout, Register
from shmio.layout.scan import ChangeScan

TEXT = """DATA_BLOCK "b" STRUCT
    b0 : Bool; b1 : Bool; one : Byte; real : Real; bits : Array[0..1, 0..8] of Bool; odd : Array[0..1] of String[1];
    x : Bool; bytes3 : Array[0..2] of Byte; b2 : Bool; last : Bool;
    END_STRUCT; BEGIN END_DATA_BLOCK"""
LAYOUT: Layout = compile_sources([Source("x.db", TEXT.encode())]).layouts[0]
INDEX = LAYOUT.by_path


def bits_of(register: Register, frame: bytes) -> object:
    """The register's data alone, independently of the scan: element by element."""
    if register.type == "BOOL":
        return codec(register).decode(frame)
    element = register.element
    starts = range(register.offset, register.offset + register.size, element.stride)
    return [frame[start : start + element.size] for start in starts]


def naive(old: bytes, new: bytes) -> list[int]:
    return [i for i, r in enumerate(LAYOUT.registers) if bits_of(r, old) != bits_of(r, new)]


frames = st.binary(min_size=LAYOUT.size, max_size=LAYOUT.size)


@given(frames, st.lists(st.tuples(st.integers(0, LAYOUT.size - 1), st.integers(0, 255)), max_size=5))
def test_agrees_with_a_comparison_of_each_register(old: bytes, changes: list[tuple[int, int]]) -> None:
    new = bytearray(old)
    for position, value in changes:
        new[position] = value
    scan = ChangeScan(LAYOUT)
    assert scan.changed(old, bytes(new)).tolist() == naive(old, bytes(new))
    assert scan.changed(old, new).tolist() == naive(old, bytes(new))
    chosen = [INDEX["last"], INDEX["one"], INDEX["bits"]]
    wanted = sorted(set(chosen) & set(naive(old, bytes(new))))
    assert ChangeScan(LAYOUT, chosen).changed(old, bytes(new)).tolist() == wanted


@pytest.mark.parametrize("bit", range(LAYOUT.size * 8))
def test_every_single_bit(bit: int) -> None:
    old = bytes(LAYOUT.size)
    new = bytearray(old)
    new[bit // 8] |= 1 << bit % 8
    changed = ChangeScan(LAYOUT).changed(old, new).tolist()
    assert changed == naive(old, bytes(new))
    assert len(changed) <= 1


def test_bytes_are_compared_not_values() -> None:
    scan = ChangeScan(LAYOUT)
    at = LAYOUT.registers[INDEX["real"]].offset

    def frame(value: float) -> bytes:
        return bytes(at) + struct.pack(">f", value) + bytes(LAYOUT.size - at - 4)

    assert scan.changed(frame(math.nan), frame(math.nan)).tolist() == []
    assert scan.changed(bytearray(frame(math.nan)), frame(math.nan)).tolist() == []
    assert scan.changed(frame(0.0), frame(-0.0)).tolist() == [INDEX["real"]]


def test_buffers_and_empty_choices() -> None:
    old, new = bytes(LAYOUT.size), b"\xff" * LAYOUT.size
    everything = list(range(len(LAYOUT.registers)))
    assert ChangeScan(LAYOUT).changed(memoryview(old), np.frombuffer(new, np.uint8)).tolist() == everything
    assert ChangeScan(LAYOUT, []).changed(old, new).tolist() == []
    with pytest.raises(ValueError, match=r"broadcast|operands|shape"):
        ChangeScan(LAYOUT).changed(old, new + b"x")


def test_results_stay_when_the_scan_is_used_again() -> None:
    scan = ChangeScan(LAYOUT)
    first = scan.changed(bytes(LAYOUT.size), b"\xff" * LAYOUT.size)
    kept = first.tolist()
    scan.changed(bytes(LAYOUT.size), b"\x01" + bytes(LAYOUT.size - 1))
    assert first.tolist() == kept
