"""Find the paths of bytes and bits of a block, as :func:`shmio.layout.topic.find` reads them."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator

from shmio.layout.model import Layout, Register
from shmio.layout.parts import part_of, slice_of
from shmio.layout.types import INTEGERS
from shmio.layout.values.write import Write, bits_of


def paths_of(layout: Layout, writes: Iterable[Write]) -> list[str]:
    """Return the paths of the bits that writes set, in address order.

    A register that is written in part is named by slices, elements, bytes or bits. A type without
    parts, such as REAL, is named as a whole. Bytes outside the block or of no register are skipped.
    """
    bits = bytearray(layout.size)
    touched: set[int] = set()
    for offset, mask, data in writes:
        stop = min(offset + len(data), layout.size)
        for at in range(offset, stop):
            bits[at] |= mask or 0xFF
        touched.update(_overlapping(layout, offset, stop))
    return [path for index in sorted(touched) for path in _of(layout, layout.registers[index], bits)]


def path_at(layout: Layout, offset: int) -> str:
    """Return the path of the register or array element at a byte, or an empty string."""
    for index in _overlapping(layout, offset, offset + 1):
        register = layout.registers[index]
        if not register.dims or register.bit is not None:
            return register.path
        place = _index(register, (offset - register.offset) // register.element.stride)
        return "/".join((register.path, *map(str, place)))
    return ""


def _overlapping(layout: Layout, start: int, stop: int) -> range:
    """Return the indices of the registers that share a byte with a range."""
    first = bisect_right(layout.registers, start, key=lambda register: register.offset + register.size)
    return range(first, bisect_left(layout.registers, stop, key=lambda register: register.offset))


def _of(layout: Layout, register: Register, bits: bytearray) -> Iterator[str]:
    share = _share(register, bits)
    own = bits_of(register)
    if not any(share):
        return
    if share == own:
        yield register.path
    elif register.dims:
        yield from _elements(layout, register, share, bits)
    elif register.type in INTEGERS:
        yield from _parts(layout, register, share)
    else:
        yield register.path


def _share(register: Register, bits: bytearray) -> bytes:
    """Return the bits that belong to a register."""
    there = bytes(bits[register.offset : register.offset + register.size])
    if register.bit is None or register.dims:
        return there
    return bytes([there[0] & 1 << register.bit])


def _touched(array: Register, share: bytes) -> range:
    """Return a range of elements that includes all those with some of these bits."""
    first, stop = len(share) - len(share.lstrip(b"\0")), len(share.rstrip(b"\0"))
    if array.bit is None:
        return range(first // array.element.stride, min(array.count, -(-stop // array.element.stride)))
    if len(array.dims) == 1:
        return range(8 * first, min(array.count, 8 * stop))
    return range(array.count)


def _index(array: Register, flat: int) -> tuple[int, ...]:
    """Return the declared indices of an element; the last index runs fastest."""
    index: tuple[int, ...] = ()
    for low, high in reversed(array.dims):
        flat, place = divmod(flat, high - low + 1)
        index = (low + place, *index)
    return index


def _elements(layout: Layout, array: Register, share: bytes, bits: bytearray) -> Iterator[str]:
    """Yield the paths of an array's elements; neighbours within its last dimension form a slice."""
    run: list[tuple[int, ...]] = []
    for flat in _touched(array, share):
        index = _index(array, flat)
        element = layout.element(array, index)
        whole = _share(element, bits) == bits_of(element)
        if run and (not whole or index[:-1] != run[-1][:-1]):
            yield _run(layout, array, run)
            run = []
        if whole:
            run.append(index)
        else:
            yield from _of(layout, element, bits)
    if run:
        yield _run(layout, array, run)


def _run(layout: Layout, array: Register, run: list[tuple[int, ...]]) -> str:
    if len(run) == 1:
        return layout.element(array, run[0]).path
    return slice_of(layout, array, run[0][:-1], run[0][-1], run[-1][-1]).path


def _parts(layout: Layout, register: Register, share: bytes) -> Iterator[str]:
    """Yield the paths of an integer's bits, least significant first.

    Whole bytes, words and double words are named as such.
    """
    ascending = share[::-1] if layout.byte_order == "big" else share
    at = 0
    while at < len(ascending):
        for kind, width in (("D", 4), ("W", 2), ("B", 1)):
            if width < len(ascending) and at % width == 0 and ascending[at : at + width] == b"\xff" * width:
                yield part_of(layout, register, kind, at // width).path
                at += width
                break
        else:
            bits = (8 * at + bit for bit in range(8) if ascending[at] >> bit & 1)
            yield from (part_of(layout, register, "X", number).path for number in bits)
            at += 1
