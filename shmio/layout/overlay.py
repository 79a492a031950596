"""Registers over a data block: names for bits, parts, slices and typed views of its registers.

Such a register has no bytes of its own. It shares the bytes of the part of the block that it names,
so reading or writing the register reads or writes that part.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

from shmio.layout.model import INTEGERS, Dims, ElementType, Layout, Register, array_size, shape_of
from shmio.layout.topic import find, holder, holders, names_part, shorten
from shmio.layout.values.write import bits_of, chosen, covering
from shmio.wording import counted

_PARTS: Final = {1: "B", 2: "W", 4: "D"}


def overlay_register(base: Layout, path: str, over: str, kind: tuple[ElementType, Dims] | None = None) -> Register:
    """Return a register that lies over a part of a block.

    Args:
        base: The layout of the block.
        path: Path of the new register.
        over: Canonical path of the part that it names: a register of the block, an element, a
            slice, or a bit or another part of an integer.
        kind: The type and the array bounds of the new register; None: those of the named part. A
            register of another type interprets the bytes from the start of the part.

    Raises:
        PathError: The block has no such part.
        ValueError: The type does not fit the bytes of the part.

    """
    named = find(base, over)
    element, dims = kind or (named.element, named.dims)
    count = math.prod(shape_of(dims))
    rows = count == named.count and len(dims) == len(named.dims) == 1
    if element.name == named.type and (dims == named.dims or rows):
        return Register(
            path, named.type, dims, named.offset, named.bit, named.size, named.count,
            partial=named.type == "BOOL" and len(dims) == 1, over=over, encoding=named.encoding,
        )  # fmt: skip
    whole = find(base, over.rpartition(".%")[0]) if named.type == "BOOL" and ".%X" in over else named
    if whole.type not in INTEGERS:
        written = _written(named.type, named.dims)
        raise ValueError(
            f"type: {shorten(over)} is {written}, found {_written(element.name, dims)}; only bytes and integers can be "
            "read as another type"
        )
    if named.type == "BOOL" and element.base != "BOOL":
        raise ValueError(f"type: {shorten(over)} is a BOOL, so it cannot be read as {_written(element.name, dims)}")
    if element.base == "BOOL":
        return _bits(base, path, over, named, whole, dims)
    size = array_size(element, shape_of(dims))
    room = _room(base, named, over)
    exact = names_part(over) or not (named.dims or _is_element(base, named))
    if size > room or (exact and size != room):
        needs = f"type: {_written(element.name, dims)} needs {counted(size, 'byte')}"
        raise ValueError(f"{needs}, {_has(over, room, exact)}")
    return Register(path, element.name, dims, named.offset, None, size, count, over=over)


def needed(layout: Layout, register: Register) -> set[str]:
    """Return the paths of the layout's registers that must be read to know a register, element or part.

    The result contains the layout's register that is or contains ``register``. If that register
    lies over the block, the result also contains the block's own register that is or contains the
    named part, if there is one.
    """
    over = _over(layout, register)
    paths = [path for path in holders(over) if path in layout.by_path] if over else []
    return {holder(layout, register), *paths[:1]}


def names_in(layout: Layout, patterns: Iterable[str]) -> list[Register]:
    """Return the registers over the block that patterns name.

    Leave out a register if the patterns also name all its bits through the block's own registers.

    Raises:
        PathError: A pattern is malformed, or names a part that its register does not have.

    """
    if len(layout.own) == len(layout.registers):
        return []
    found = [register for pattern in patterns for register in chosen(layout, pattern)]
    own = covering((register for register in found if not _over(layout, register)), layout.size)
    return [
        register
        for register in found
        if _over(layout, register)
        and any(bits & ~own[at] for at, bits in enumerate(bits_of(register), register.offset))
    ]


def _over(layout: Layout, register: Register) -> str:
    return layout.registers[layout.by_path[holder(layout, register)]].over


def _bits(base: Layout, path: str, over: str, named: Register, whole: Register, dims: Dims) -> Register:
    """Return an array of BOOL over bytes; raise ValueError if it does not fit."""
    if not dims:
        raise ValueError(f"type: a BOOL needs the address of a bit, such as {shorten(over)}.%X0")
    if len(dims) > 1 or whole.element.size > 1:
        raise ValueError(f"type: an array of BOOL needs bytes and one dimension, but {shorten(over)} is {whole.type}")
    first, count = named.bit or 0, math.prod(shape_of(dims))
    room = 8 * _room(base, whole, over.rpartition(".%")[0] if named.type == "BOOL" else over) - first
    if count > room:
        raise ValueError(f"type: {count} bits are needed, but {shorten(over)} has {room}")
    return Register(path, "BOOL", dims, named.offset, first, -(-(first + count) // 8), count, partial=True, over=over)


def _room(base: Layout, named: Register, over: str) -> int:
    """Return the most bytes that a view over a part may have: up to the end of its array, slice or integer."""
    if named.dims or not _is_element(base, named) or names_part(over):
        return named.size
    array = base.registers[base.by_path[_array_of(base, named.path)]]
    return array.offset + array.size - named.offset


def _is_element(base: Layout, named: Register) -> bool:
    return not names_part(named.path) and named.path not in base.by_path


def _array_of(base: Layout, path: str) -> str:
    while path not in base.by_path:
        path = path.rpartition("/")[0]
    return path


def _has(over: str, room: int, exact: bool) -> str:
    if not exact:
        return f"but from {shorten(over)} on there {'is' if room == 1 else 'are'} only {room}"
    hint = f"; name a part of it, such as {shorten(over)}.%{_PARTS[room // 2]}0" if room in (2, 4, 8) else ""
    return f"but {shorten(over)} has {room}{hint if not names_part(over) else ''}"


def _written(name: str, dims: Dims) -> str:
    bounds = ", ".join(f"{low}..{high}" for low, high in dims)
    return f"ARRAY[{bounds}] OF {name}" if dims else name
