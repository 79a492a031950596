"""Reads a layout's JSON, as segments and recordings store it.

It trusts nothing: types are checked strictly, then every value that can be computed is
computed again and compared.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from shmio.errors import LayoutError, PathError
from shmio.layout.model import (
    ALIASES,
    MAX_BLOCK_BYTES,
    MAX_DIMENSIONS,
    MAX_ELEMENTS,
    MAX_REGISTERS,
    ByteOrder,
    Dims,
    Layout,
    Register,
    array_size,
    element_type,
    shape_of,
)
from shmio.layout.topic import MAX_TOPIC, canonical_path

MAX_JSON_BYTES = 128 << 20

_Bound = Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 31)]
_Size = Annotated[int, msgspec.Meta(ge=0, le=MAX_BLOCK_BYTES)]


class _Register(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    path: Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_TOPIC)]
    type: str
    dims: Annotated[list[tuple[_Bound, _Bound]], msgspec.Meta(min_length=1, max_length=MAX_DIMENSIONS)] | None
    offset: _Size
    bit: Annotated[int, msgspec.Meta(ge=0, le=7)] | None
    size: _Size
    count: Annotated[int, msgspec.Meta(ge=1, le=MAX_ELEMENTS)]
    comment: str
    initial: str | None


class _Layout(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    name: str
    number: Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)] | None
    size: _Size
    optimized: bool
    registers: Annotated[list[_Register], msgspec.Meta(max_length=MAX_REGISTERS)]
    byte_order: ByteOrder = "big"


_DECODER = msgspec.json.Decoder(_Layout)  # msgspec crashes if two threads use a type first


def load_layout(data: bytes) -> Layout:
    """Read and validate the JSON of ``Layout.to_json``; the data may be hostile.

    Raises:
        LayoutError: The JSON is malformed, or the layout is impossible: registers that overlap,
            have wrong sizes, or are outside the block.

    """
    if len(data) > MAX_JSON_BYTES:
        raise LayoutError(f"layout: larger than {MAX_JSON_BYTES} bytes")
    try:
        document = _DECODER.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise LayoutError(f"layout: {error}") from None
    registers: list[Register] = []
    seen: set[str] = set()
    end_bits = elements = 0
    for item in document.registers:
        register = _register(item)
        if register.path in seen:
            raise LayoutError(f"layout: two registers have the path {register.path!r}")
        first = register.offset * 8 + (register.bit or 0)
        if first < end_bits:
            raise LayoutError(f"layout: {register.path!r} overlaps the register before it")
        alone = register.bit is not None and not register.dims
        end_bits = first + (1 if alone else register.size * 8)
        elements += register.count
        seen.add(register.path)
        registers.append(register)
    if end_bits > document.size * 8 or elements > MAX_ELEMENTS:
        raise LayoutError(f"layout: the registers do not fit the block of {document.size} bytes")
    return Layout(
        document.name, document.number, document.size, document.optimized, tuple(registers), document.byte_order
    )


def _register(item: _Register) -> Register:
    element = element_type(item.type)
    if element is None or element.name != item.type or item.type in ALIASES:
        raise LayoutError(f"layout: {item.path!r} has the unknown type {item.type!r}")
    dims: Dims = tuple(item.dims or ())
    if any(low > high for low, high in dims):
        raise LayoutError(f"layout: {item.path!r} has inverted bounds")
    shape = shape_of(dims)
    if item.count != math.prod(shape) or item.size != array_size(element, shape):
        raise LayoutError(f"layout: {item.path!r} has a size or count that does not fit its type")
    if (item.bit is None) != (element.base != "BOOL") or (dims and item.bit):
        raise LayoutError(f"layout: {item.path!r} has a bit that does not fit its type")
    try:
        path = canonical_path(item.path)
    except PathError as error:
        raise LayoutError(f"layout: {error}") from None
    if path != item.path:
        raise LayoutError(f"layout: {item.path!r} is not a path in its canonical form")
    return Register(
        item.path, item.type, dims, item.offset, item.bit, item.size, item.count, item.comment, item.initial
    )
