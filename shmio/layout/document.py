"""Read a layout's JSON, as segments and recordings store it.

The JSON is untrusted: types are checked strictly, then every value that can be computed is computed
again and compared.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Annotated

import msgspec

from shmio.errors import LayoutError, PathError
from shmio.layout.encodings import NAMES as ENCODINGS
from shmio.layout.model import (
    ALIASES,
    MAX_BLOCK_BYTES,
    MAX_ELEMENTS,
    MAX_IMAGE_BYTES,
    MAX_REGISTERS,
    ByteOrder,
    Layout,
    Register,
    array_size,
    element_type,
    is_encoded,
    shape_of,
    status_bytes,
)
from shmio.layout.topic import check_canonical, find, holders

MAX_JSON_BYTES = 128 << 20


class _Layout(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    name: str
    number: Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)] | None
    size: Annotated[int, msgspec.Meta(ge=0, le=MAX_IMAGE_BYTES)]
    optimized: bool
    registers: Annotated[tuple[Register, ...], msgspec.Meta(max_length=MAX_REGISTERS)]
    byte_order: ByteOrder = "big"
    status_offset: Annotated[int, msgspec.Meta(ge=0)] | None = None


_DECODER = msgspec.json.Decoder(_Layout)  # msgspec crashes if two threads are the first to use a type


def load_layout(data: bytes, digest: bytes | None = None) -> Layout:
    """Read and validate JSON that ``Layout.to_json`` should have written; the data may be hostile.

    Args:
        data: The JSON.
        digest: The layout's :attr:`Layout.hash`, if the caller knows it.

    Raises:
        LayoutError: The JSON is malformed, or the layout is impossible. For example, registers
            overlap, have wrong sizes, or are outside the block.

    """
    if len(data) > MAX_JSON_BYTES:
        raise LayoutError(f"layout: the document is larger than {MAX_JSON_BYTES} bytes")
    try:
        document = _DECODER.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise LayoutError(f"layout: {error}") from None
    layout = _layout_of(document)
    _check(document)
    _check_paths(layout)
    _check_overlay(layout)
    if digest is not None:
        vars(layout)["hash"] = digest
    return layout


def load_part(data: bytes, path: str) -> Layout | None:
    """Read only the register that a path names, or that contains what the path names.

    The JSON of a large block takes long to read, and most programs that start need few registers.

    Args:
        data: The JSON, as for :func:`load_layout`; it may be hostile.
        path: Canonical path of a register, or of an element, slice or part of one.

    Returns:
        A layout with this one register, in which :func:`shmio.layout.topic.find` finds the path.
        None if that takes the whole layout: the path names a structure or nothing, the register
        lies over the block, the registers have statuses, or the JSON is malformed.

    """
    # Inside a string of JSON, quotation marks are escaped. So these bytes begin a register, or nothing.
    key = _key(path)
    if data.find(key + b"/") >= 0:
        return None
    for place in holders(path):
        if (at := data.find(_key(place) + b'",')) >= 0:
            break
    else:
        return None
    first, last = data.find(_REGISTERS) + len(_REGISTERS), data.rfind(_REGISTERS_END)
    end = data.find(b',{"path":"', at, last)
    try:
        head = _DECODER.decode(data[:first] + data[at : last if end < 0 else end] + data[last:])
        layout = _layout_of(head)
        (register,) = layout.registers
        if head.status_offset is not None or register.over or register.path != place:
            return None
        _check(head)
        find(layout, path)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, ValueError, LayoutError, PathError):
        return None
    return layout


_REGISTERS = b'"registers":['
_REGISTERS_END = b'],"'


def _key(path: str) -> bytes:
    """Return the bytes with which the JSON of a register with this path, or with a path that begins so, begins."""
    return b'{"path":' + msgspec.json.encode(path)[:-1]


def _layout_of(document: _Layout) -> Layout:
    for register in document.registers:
        if not register.dims:
            msgspec.structs.force_setattr(register, "dims", ())
    return Layout(
        document.name, document.number, document.size, document.optimized, document.registers,
        document.byte_order, document.status_offset,
    )  # fmt: skip


def _check(document: _Layout) -> None:
    """Raise LayoutError if a register is impossible, or if two registers share bits."""
    lengths: dict[tuple[object, ...], int] = {}
    end = 0  # in bits
    elements = 0
    over = 0
    for register in document.registers:
        elements += register.count
        if register.over:
            over += 1
            _kind(register)
            continue
        if over:
            raise LayoutError(f"layout: {register.path!r} must come before the registers that lie over the block")
        bit = register.bit
        shape = register.type, register.dims, register.size, register.count, bit, register.partial, register.encoding
        length = lengths.get(shape) or lengths.setdefault(shape, _length(register))
        first = register.offset * 8 + (bit or 0)
        if first < end:
            raise LayoutError(f"layout: {register.path!r} overlaps the register before it")
        end = first + length
    size = document.size if document.status_offset is None else document.status_offset
    if end > size * 8 or size > MAX_BLOCK_BYTES or elements > MAX_ELEMENTS:
        raise LayoutError(f"layout: the registers do not fit the block of {size} bytes")
    if document.status_offset is not None and document.size != size + status_bytes(len(document.registers) - over):
        raise LayoutError(f"layout: the status area at {size} does not fit the image of {document.size} bytes")
    if document.status_offset is not None and size % 8:
        raise LayoutError(f"layout: the status area at {size} is not aligned to 8 bytes")


def _check_paths(layout: Layout) -> None:
    """Raise LayoutError if two registers have the same path, or if a path is not in its canonical form."""
    paths = [register.path for register in layout.registers]
    if len(layout.by_path) < len(paths):
        twice = next(path for path, times in Counter(paths).items() if times > 1)
        raise LayoutError(f"layout: two registers have the path {twice!r}")
    try:
        check_canonical(paths)
    except PathError as error:
        raise LayoutError(f"layout: {error}") from None


def _check_overlay(layout: Layout) -> None:
    """Raise LayoutError unless each register over the block lies where its ``over`` path says.

    Set ``partial`` of each of these registers, which the JSON does not contain.
    """
    own = len(layout.own)
    if own == len(layout.registers):
        return
    from shmio.layout.overlay import overlay_register  # noqa: PLC0415  most layouts have no such registers

    for register in layout.registers[own:]:
        try:
            found = overlay_register(layout.base, register.path, register.over, (register.element, register.dims))
        except ValueError as error:
            raise LayoutError(f"layout: {register.path!r}: {error}") from None
        except PathError as error:
            raise LayoutError(f"layout: {register.path!r} lies over nothing: {error}") from None
        if _place_of(found) != _place_of(register):
            raise LayoutError(f"layout: {register.path!r} does not lie over {register.over!r}")
        msgspec.structs.force_setattr(register, "partial", found.partial)


def _place_of(register: Register) -> tuple[object, ...]:
    return register.offset, register.bit, register.size, register.count


def _length(register: Register) -> int:
    """Return the number of bits of a register of the block itself.

    Raises:
        LayoutError: The type does not exist, or size, count or bit do not fit type and bounds.

    """
    size, count, has_bit = _kind(register)
    if register.size != size or register.count != count or register.partial:
        raise LayoutError(f"layout: {register.path!r} has a size or count that does not fit its type")
    if (register.bit is not None) != has_bit or (register.bit and register.dims):
        raise LayoutError(f"layout: {register.path!r} has a bit that does not fit its type")
    return 1 if has_bit and not register.dims else size * 8


def _kind(register: Register) -> tuple[int, int, bool]:
    """Return (size, count, whether the type is BOOL), as type and bounds of a register determine them.

    Raises:
        LayoutError: There is no such type, or a lower bound is above the upper bound.

    """
    element = element_type(register.type)
    if element is None or element.name != register.type or register.type in ALIASES:
        raise LayoutError(f"layout: {register.path!r} has the unknown type {register.type!r}")
    if register.encoding and (register.encoding not in ENCODINGS or not is_encoded(register.type)):
        raise LayoutError(f"layout: {register.path!r} has the unknown encoding {register.encoding!r}")
    if any(low > high for low, high in register.dims):
        raise LayoutError(f"layout: {register.path!r} has inverted bounds")
    shape = shape_of(register.dims)
    return array_size(element, shape), math.prod(shape), element.base == "BOOL"
