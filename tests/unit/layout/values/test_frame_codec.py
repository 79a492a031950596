"""The vectorised codec, compared with the scalar one."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import codec
from shmio.layout.values.frame_codec import FrameCodec

TYPES = re.split(
    " ",
    "Bool Byte Word DWord LWord SInt USInt Int UInt DInt UDInt LInt ULInt Real LReal Char WChar String[5] WString[3] "
    "S5Time Time LTime TOD LTOD Date DT LDT DTL Pointer Any",
)
MEMBERS = "".join(
    f"s{i} : {type_}; a{i} : Array[0..2] of {type_}; m{i} : Array[0..1, 1..3] of {type_};"
    for i, type_ in enumerate(TYPES)
)


def compile_members(members: str) -> Layout:
    text = f'DATA_BLOCK "b" STRUCT {members} END_STRUCT; BEGIN END_DATA_BLOCK'
    return compile_sources([Source("x.db", text.encode())]).layouts[0]


LAYOUT = compile_members(MEMBERS)
CODEC = FrameCodec(LAYOUT)
MS, NS = np.timedelta64(1, "ms"), np.timedelta64(1, "ns")


LAST_MOMENT = "2262-04-11T23:47:16.854775807"
"""The last moment of datetime64[ns]."""


def expected(value: Any, register: Register) -> Any:
    """Return what the vectorised codec must give for a value of the scalar codec."""
    if isinstance(value, list):
        return [expected(item, register) for item in value]
    base = register.element.base
    if base in ("CHAR", "WCHAR", "STRING", "WSTRING"):
        return (value or "").rstrip("\0")
    if base in ("TIME", "S5TIME", "TIME_OF_DAY"):
        return np.timedelta64("NaT", "ms") if value is None else value * MS
    if base in ("LTIME", "LTOD"):
        return np.timedelta64("NaT", "ns") if value is None or value == -(1 << 63) else value * NS
    if base in ("DATE", "DATE_AND_TIME", "LDT", "DTL"):
        return np.datetime64("NaT", "ns") if value is None or value > LAST_MOMENT else np.datetime64(value)
    return bytes.fromhex(value) if base in ("POINTER", "ANY") else value


def same(found: Any, wanted: Any) -> bool:
    if isinstance(wanted, list):
        return len(found) == len(wanted) and all(map(same, found, wanted))
    if isinstance(wanted, np.datetime64 | np.timedelta64):
        return bool(found == wanted) or bool(np.isnat(found) and np.isnat(wanted))
    if isinstance(wanted, float) and math.isnan(wanted):
        return bool(np.isnan(found))
    return bool(found.tobytes() == wanted) if isinstance(wanted, bytes) else bool(found == wanted)


# Bytes that make BCD digits, short lengths and small fields likely, so that both valid and invalid values occur.
likely = st.one_of(st.integers(0, 255), st.sampled_from([0, 1, 2, 5, 0x07, 0xB2, 0x12, 0x31, 0x59, 0x99, 0xD8, 0xDC]))


@settings(max_examples=60)
@given(st.data())
def test_agrees_with_the_scalar_codec(data: st.DataObject) -> None:
    seed = data.draw(st.lists(likely, min_size=40, max_size=120))
    frames = np.resize(np.array(seed, np.uint8), (3, LAYOUT.size))
    decoded = CODEC.decode(frames)
    assert decoded.shape == (3,)
    for row, frame in zip(decoded, frames, strict=True):
        for register in LAYOUT.registers:
            wanted = expected(codec(register).decode(frame.tobytes()), register)
            assert same(row[register.path], wanted), (register, row[register.path], wanted)


@pytest.mark.parametrize(
    ("type_", "value"),
    [
        ("DT", "2024-02-29T12:34:56.789"),
        ("DT", "2089-12-31T23:59:59.999"),
        ("DTL", "2262-04-11T23:47:16.854775807"),
        ("DTL", "2000-02-29T00:00:00.000000001"),
        ("LDT", "2262-04-11T23:47:16.854775807"),
        ("Date", "2169-06-06"),
        ("TOD", 86_399_999),
        ("LTOD", 86_399_999_999_999),
        ("LTime", -(1 << 63) + 1),
        ("S5Time", 9_990_000),
        ("Time", -(1 << 31)),
        ("String[5]", "añb"),
        ("WString[3]", "😀x"),
        ("WString[3]", "€€€"),
        ("WChar", "€"),
    ],
)
@pytest.mark.parametrize("byte_order", ["big", "little"])
def test_chosen_values(type_: str, value: Any, byte_order: Any) -> None:
    compiled = compile_members(f"x : Byte; a : {type_}; b : Array[1..2] of {type_};")
    layout = Layout("b", None, compiled.size, optimized=False, registers=compiled.registers, byte_order=byte_order)
    frame = bytearray(layout.size)
    codec(layout.registers[1], byte_order).encode_into(value, frame)
    codec(layout.registers[2], byte_order).encode_into([value, value], frame)
    row = FrameCodec(layout).decode(frame)[0]
    wanted = expected(value, layout.registers[1])
    assert row["a"] == wanted
    assert list(row["b"]) == [wanted, wanted]


def test_field_types() -> None:
    kinds = {
        type_: str(CODEC.dtype[f"s{i}"].newbyteorder("=")).replace("<", "").replace("=", "")
        for i, type_ in enumerate(TYPES)
    }
    assert kinds["Bool"] == "bool"
    assert (kinds["Int"], kinds["LWord"], kinds["Real"]) == ("int16", "uint64", "float32")
    assert (kinds["String[5]"], kinds["WString[3]"], kinds["Char"]) == ("U5", "U3", "U1")
    assert (kinds["Time"], kinds["LTime"]) == ("timedelta64[ms]", "timedelta64[ns]")
    assert (kinds["Date"], kinds["DT"], kinds["DTL"]) == ("datetime64[D]", "datetime64[ms]", "datetime64[ns]")
    assert CODEC.dtype["m7"].shape == (2, 3)
    assert all(CODEC.dtype[name].isnative for name in CODEC.dtype.names or ())


def test_names_and_several_blocks_of_bytes() -> None:
    layout = compile_members('"a/b" : Bool; "in" : Int; c : Struct d : Real; END_STRUCT;')
    frame = bytes.fromhex("0100" + "0005" + "3fc00000")
    for frames in (frame * 2, bytearray(frame * 2), memoryview(frame * 2), np.frombuffer(frame * 2, np.uint8)):
        decoded = FrameCodec(layout).decode(frames)
        assert decoded.dtype.names == ("a%2Fb", "%69n", "c/d")
        assert decoded.tolist() == [(True, 5, 1.5)] * 2


def test_frames_need_not_be_contiguous() -> None:
    layout = compile_members("a : Int; b : Bool;")
    frames = np.zeros((3, 8), np.uint8)
    frames[:, 1] = [1, 2, 3]
    assert FrameCodec(layout).decode(frames[:, :4])["a"].tolist() == [1, 2, 3]
    assert FrameCodec(layout).decode(frames[::-2, :4])["a"].tolist() == [3, 1]


def test_a_block_without_registers() -> None:
    assert FrameCodec(compile_members("")).decode(np.zeros((2, 0), np.uint8)).shape == (2,)


def test_neighbours_and_gaps() -> None:
    layout = compile_members(
        "a : Byte; b : Byte; c : Int; d : Byte; e : Array[0..2] of Byte; f : Byte; g : USInt; h : Word;"
    )
    frame = bytes(range(1, layout.size + 1))
    row = FrameCodec(layout).decode(frame)[0]
    assert {r.path: row[r.path].tolist() for r in layout.registers} == {
        r.path: codec(r).decode(frame) for r in layout.registers
    }


def test_no_frames_and_wrong_sizes() -> None:
    layout = compile_members("a : Int; b : Bool; c : String[3]; d : WString[2]; e : DTL; f : Array[0..1] of Bool;")
    assert FrameCodec(layout).decode(np.zeros((0, layout.size), np.uint8)).shape == (0,)
    for wrong in (b"\0" * (layout.size + 1), np.zeros((2, layout.size - 1), np.uint8)):
        with pytest.raises(ValueError, match="expected frames of"):
            FrameCodec(layout).decode(wrong)
