"""Invariants of the layout compiler, the layout document and the codec, for any input.

An input gives a layout whose values survive encoding and decoding, or it raises LayoutError or
ValueRangeError.
"""

from __future__ import annotations

import math
from functools import cache

from shmio.errors import LayoutError, ValueRangeError
from shmio.layout.compiler import Compiled, Program, Source, compile_sources
from shmio.layout.document import load_layout
from shmio.layout.image import initial_frame, unread
from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.frame_codec import FrameCodec
from shmio.layout.values.literal import parse_literal
from shmio.layout.values.text import from_text, json_value, to_text

SPLIT = b"\x00\xff\x00"  # separates the sources of an input
MAX_DECODED = 10  # registers of a layout that are decoded and encoded


def check(data: bytes) -> None:
    """Check one input; its first byte chooses the check."""
    if not data:
        return
    targets = (check_sources, check_sources, check_document, check_values)
    targets[data[0] % len(targets)](data[1:])


def check_sources(data: bytes) -> None:
    """Check that sources give a consistent layout, or an error with a position."""
    sources = [Source(f"{index}.db", part) for index, part in enumerate(data.split(SPLIT, 3))]
    compiled = _outcome(sources)
    if isinstance(compiled, LayoutError):
        assert compiled.diagnostics
        assert all(d.line >= 1 and d.column >= 1 and "\n" not in str(d) for d in compiled.diagnostics)
        return
    for layout in compiled.layouts:
        assert load_layout(layout.to_json()) == layout
        frame, missing = initial_frame(layout)
        assert [register.path for register in unread(layout)] == list(missing)
        _check_frame(layout, bytes(frame))
    for layout in Program(sources).compile(by_name=True).layouts:
        assert load_layout(layout.to_json()) == layout


def _outcome(sources: list[Source]) -> Compiled | LayoutError:
    try:
        return compile_sources(sources)
    except LayoutError as error:
        return error


def check_document(data: bytes) -> None:
    """Check that the JSON of a layout is refused, or gives a layout that works."""
    try:
        layout = load_layout(data)
    except LayoutError:
        return
    assert load_layout(layout.to_json()) == layout
    if layout.size <= 1 << 16:
        _check_frame(layout, (data * (layout.size // len(data) + 1))[: layout.size])


def check_values(data: bytes) -> None:
    """Decode raw bytes, and parse user text, as a scalar and as an array. Byte 0 chooses the type."""
    layout = _every_type()
    which, body = (data[0] if data else 0), data[1:] or b"\0"
    frame = (body * (layout.size // len(body) + 1))[: layout.size]
    if which == 0xFF:
        FrameCodec(layout).decode(frame)
    text = body[:200].decode("utf-8", "surrogateescape")
    buffer = bytearray(frame)
    first = which % (len(layout.registers) // 2) * 2
    for register in layout.registers[first : first + 2]:
        _check_register(layout, register, frame)
        for read in (parse_literal, from_text):
            try:
                value = read(text, register)
                codec(register).encode_into(value, buffer)
            except ValueRangeError:
                continue


def _check_frame(layout: Layout, frame: bytes) -> None:
    step = max(1, len(layout.registers) // MAX_DECODED)
    for register in layout.registers[::step]:
        _check_register(layout, register, frame)
    if frame and len(frame) % 64 == 0:  # building one is slow, so only for some inputs
        FrameCodec(layout).decode(frame)


def _check_register(layout: Layout, register: Register, frame: bytes) -> None:
    if register.count > 4096:
        return
    one = codec(register, layout.byte_order)
    value = one.decode(frame)
    json_value(value, register.element)
    text = to_text(value, register)
    if _has_none(value):
        return
    for again in (value, from_text(text, register)):
        copy = bytearray(len(frame))
        one.encode_into(again, copy)
        assert _same(one.decode(copy), value), (register, value, again)


def _has_none(value: Value) -> bool:
    return any(_has_none(item) for item in value) if isinstance(value, list) else value is None


def _same(one: Value, other: Value) -> bool:
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, float) and isinstance(other, float) and math.isnan(one):
        return math.isnan(other)
    return one == other


@cache
def _every_type() -> Layout:
    names = (
        *("Bool", "Byte", "Word", "DWord", "LWord", "SInt", "USInt", "Int", "UInt", "DInt", "UDInt", "LInt", "ULInt"),
        *("Real", "LReal", "Char", "WChar", "String[5]", "WString[4]", "Time", "LTime", "S5Time", "Time_Of_Day"),
        *("LTOD", "Date", "Date_And_Time", "LDT", "DTL", "Any", "Pointer"),
    )
    members = "".join(f"a{i} : {name}; b{i} : Array[0..1, 1..3] of {name};\n" for i, name in enumerate(names))
    text = f"DATA_BLOCK b STRUCT {members} END_STRUCT; BEGIN END_DATA_BLOCK"
    return compile_sources([Source("types.db", text.encode())]).layouts[0]
