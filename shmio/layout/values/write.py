"""Writes to a block: of whole bytes, or of one bit of a byte.

The functions of this module convert new values to writes, find the bits of registers, and return
the paths of the registers that writes set. :func:`shmio.layout.topic.find` reads these paths.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import NamedTuple

import msgspec

from shmio.errors import PathError
from shmio.layout.glob import Glob
from shmio.layout.model import INTEGERS, ByteOrder, Layout, Register, bit_positions, index_at
from shmio.layout.topic import find_each, names_part, part_of, slice_of
from shmio.layout.values.codec import codec


class Write(NamedTuple):
    """A change to bytes of a block.

    If ``mask`` is 0, all of ``data`` is written from ``offset`` on. Otherwise ``mask`` has one bit
    set, and ``data`` is one byte; only that bit of the byte at ``offset`` is written.
    """

    offset: int
    mask: int
    data: bytes


def encode(register: Register, value: object, byte_order: ByteOrder = "big") -> list[Write]:
    """Return the writes that set a register, or a part of a register, to a value.

    A slice of bits may need several writes, anything else needs one. An array of bits is written as
    whole bytes, because no other register of the block uses the rest of a row's last byte. In a
    device, something else may use it: a connector writes only the :func:`element_bits`.

    Raises:
        ValueRangeError: The value does not fit the register.
    """
    image = bytearray(register.size)
    # With offset 0, an image as large as the register suffices.
    codec(msgspec.structs.replace(register, offset=0), byte_order).encode_into(value, image)
    if register.partial:
        writes = merge(image, bits_of(register), [(0, register.size)])
        return [write._replace(offset=register.offset + write.offset) for write in writes]
    mask = 0 if register.bit is None or register.dims else 1 << register.bit
    return [Write(register.offset, mask, bytes(image))]


def sizes(register: Register) -> list[int]:
    """Return the maximum size, in bytes, of each write that :func:`encode` would return for a register."""
    return [register.size] + [1] * 14 if register.partial else [register.size]


def apply(write: Write, image: bytearray | memoryview) -> None:
    """Carry out a write in an image of the block."""
    offset, mask, data = write
    if mask:
        image[offset] = image[offset] & (mask ^ 0xFF) | data[0] & mask
    else:
        image[offset : offset + len(data)] = data


def bits_of(register: Register) -> bytes:
    """Return a mask of ``register.size`` bytes in which the bits that :func:`encode` writes are set."""
    if register.partial:
        bits = (1 << register.count) - 1 << (register.bit or 0)
        return bits.to_bytes(register.size, "little")
    if register.bit is None or register.dims:
        return b"\xff" * register.size
    return bytes([1 << register.bit])


def element_bits(register: Register) -> bytes:
    """Return a mask of ``register.size`` bytes in which only the bits of the register's elements are set.

    Unlike :func:`bits_of`, the mask leaves out the padding of an array: the rest of the last byte
    of each row of BOOLs, and bytes between elements of an odd size. In a device, these bits may
    belong to something else.
    """
    mask = bytearray(register.size)
    if register.type == "BOOL":
        for at, bit in bit_positions(register):
            mask[at] |= 1 << bit
        return bytes(mask)
    size, stride = register.element.size, register.element.stride
    for place in range(register.count):
        mask[place * stride : place * stride + size] = b"\xff" * size
    return bytes(mask)


def changed_bits(register: Register, before: bytes | bytearray, after: bytes | bytearray) -> bytes:
    """Return a mask of ``register.size`` bytes with all bits of each element that differs between two images."""
    start, stop = register.offset, register.offset + register.size
    old, new = before[start:stop], after[start:stop]
    own = element_bits(register)
    if register.type == "BOOL":
        return bytes((one ^ other) & bits for one, other, bits in zip(old, new, own, strict=True))
    mask = bytearray(register.size)
    size, stride = register.element.size, register.element.stride
    for at in range(0, register.count * stride, stride):
        if old[at : at + size] != new[at : at + size]:
            mask[at : at + size] = own[at : at + size]
    return bytes(mask)


def covering(registers: Iterable[Register], size: int, *, padding: bool = True) -> bytes:
    """Return an image of ``size`` bytes in which the bits of these registers are set; with or without padding."""
    mask = bytearray(size)
    for register in registers:
        for at, bits in enumerate(bits_of(register) if padding else element_bits(register), register.offset):
            mask[at] |= bits
    return bytes(mask)


def cover(layout: Layout, patterns: Iterable[str]) -> bytes:
    """Return an image of the block in which the bits of all registers that patterns name are set.

    Raises:
        PathError: A pattern is malformed, or names a part that its register does not have.
    """
    named = (register for pattern in patterns for register in chosen(layout, pattern))
    mask = bytearray(covering(named, layout.size))
    for register in layout.own:
        if register.type == "BOOL" and register.dims:
            _fill_rows(mask, register)
    return bytes(mask)


def chosen(layout: Layout, pattern: str) -> Iterator[Register]:
    """Yield the registers that a path or a pattern names; for a slice, yield its elements.

    Raises:
        PathError: The pattern is malformed, or names a part that its register does not have.
    """
    if "*" not in pattern:
        registers = find_each(layout, pattern)
        try:
            first = next(registers)
        except PathError:  # a structure: take the registers below it
            if names_part(pattern) and not layout.members(pattern):
                raise
        else:
            yield first
            yield from registers
            return
    glob = Glob(pattern)
    for register in layout.registers:
        if glob.matches(register.path):
            yield register
        elif register.dims and glob.reaches(register.path):
            yield from (element for element in elements(layout, register) if glob.matches(element.path))


def merge(image: bytes | bytearray, mask: bytes | bytearray, ranges: Iterable[tuple[int, int]]) -> list[Write]:
    """Return writes that copy to a block those bits of an image that are set in ``mask``.

    There are as few writes as possible. They copy only bytes in the ``ranges``, which are pairs
    (start, stop).
    """
    writes: list[Write] = []
    for start, stop in _joined(ranges):
        at = start
        while at < stop:
            if mask[at] == 0xFF:
                end = at
                while end < stop and mask[end] == 0xFF:
                    end += 1
                writes.append(Write(at, 0, bytes(image[at:end])))
                at = end
                continue
            writes += [Write(at, 1 << bit, bytes(image[at : at + 1])) for bit in range(8) if mask[at] >> bit & 1]
            at += 1
    return writes


def _joined(ranges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the ranges in order; join ranges that overlap or touch."""
    joined: list[tuple[int, int]] = []
    for start, stop in sorted(ranges):
        if joined and start <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(joined[-1][1], stop)
        else:
            joined.append((start, stop))
    return joined


def elements(layout: Layout, register: Register) -> Iterator[Register]:
    """Yield the elements of an array; the last index varies fastest."""
    index = [low for low, _ in register.dims]
    for _ in range(register.count):
        yield layout.element(register, tuple(index))
        for place in reversed(range(len(index))):
            low, high = register.dims[place]
            index[place] += 1
            if index[place] <= high:
                break
            index[place] = low


def _fill_rows(mask: bytearray, register: Register) -> None:
    """Set all bits of each byte of a BOOL array in which all bits of the array are set."""
    for at, bits in enumerate(element_bits(register), register.offset):
        if mask[at] & bits == bits:
            mask[at] = 0xFF


# -- paths of writes -----------------------------------------------------------------------------------------


def paths_of(layout: Layout, writes: Iterable[Write], most: int | None = None) -> list[str]:
    """Return the paths of what writes set, in address order; at most ``most`` paths (None: all).

    For a register that is written in part, return paths of slices, elements, bytes or bits; if its
    type has no parts, as REAL, return its own path. Skip bytes that belong to no register.
    """
    bits = bytearray(layout.size)
    overlapping: set[int] = set()
    for offset, mask, data in writes:
        stop = min(offset + len(data), layout.size)
        for at in range(offset, stop):
            bits[at] |= mask or 0xFF
        overlapping.update(_overlapping(layout, offset, stop))
    paths = (path for index in sorted(overlapping) for path in _register_paths(layout, layout.own[index], bits))
    return list(islice(paths, most))


def paths_outside(layout: Layout, writes: Iterable[Write], allowed: bytes, most: int | None = None) -> list[str]:
    """Return the paths of what writes set outside some bits, as :func:`paths_of` does.

    Args:
        layout: The layout of the block.
        writes: The writes; they may set several bits of each byte.
        allowed: The bits, as an image of the block.
        most: Maximum number of paths; None: no limit.

    """
    outside = (
        Write(at, bits, b"\0")
        for offset, mask, data in writes
        for at in range(offset, min(offset + len(data), len(allowed)))
        if (bits := (mask or 0xFF) & ~allowed[at])
    )
    return paths_of(layout, outside, most)


def path_at(layout: Layout, offset: int) -> str:
    """Return the path of the register or array element to which a byte belongs; "" if there is none."""
    for index in _overlapping(layout, offset, offset + 1):
        register = layout.own[index]
        if not register.dims or register.bit is not None:
            return register.path
        place = index_at(register.dims, (offset - register.offset) // register.element.stride)
        return "/".join((register.path, *map(str, place)))
    return ""


def _overlapping(layout: Layout, start: int, stop: int) -> range:
    """Return the indices of the registers in :attr:`Layout.own` that have a byte in a range of bytes."""
    first = bisect_right(layout.own, start, key=lambda register: register.offset + register.size)
    return range(first, bisect_left(layout.own, stop, key=lambda register: register.offset))


def _register_paths(layout: Layout, register: Register, bits: bytearray) -> Iterator[str]:
    share = _share(register, bits)
    own = bits_of(register)
    if not any(share):
        return
    if share == own:
        yield register.path
    elif register.dims:
        yield from _element_paths(layout, register, share, bits)
    elif register.type in INTEGERS:
        yield from _part_paths(layout, register, share)
    else:
        yield register.path


def _share(register: Register, bits: bytearray) -> bytes:
    """Return the bytes of a register from the image ``bits``, without bits of other registers."""
    there = bytes(bits[register.offset : register.offset + register.size])
    if register.bit is None or register.dims:
        return there
    return bytes([there[0] & 1 << register.bit])


def _touched_elements(array: Register, share: bytes) -> range:
    """Return a range of elements that includes each element of which ``share`` has a bit."""
    first, stop = len(share) - len(share.lstrip(b"\0")), len(share.rstrip(b"\0"))
    if array.bit is None:
        return range(first // array.element.stride, min(array.count, -(-stop // array.element.stride)))
    if len(array.dims) == 1:
        return range(8 * first, min(array.count, 8 * stop))
    return range(array.count)


def _element_paths(layout: Layout, array: Register, share: bytes, bits: bytearray) -> Iterator[str]:
    """Yield the paths of the written elements; adjacent elements of a row form a slice."""
    run: list[tuple[int, ...]] = []
    for flat in _touched_elements(array, share):
        index = index_at(array.dims, flat)
        element = layout.element(array, index)
        whole = _share(element, bits) == bits_of(element)
        if run and (not whole or index[:-1] != run[-1][:-1]):
            yield _run_path(layout, array, run)
            run = []
        if whole:
            run.append(index)
        else:
            yield from _register_paths(layout, element, bits)
    if run:
        yield _run_path(layout, array, run)


def _run_path(layout: Layout, array: Register, run: list[tuple[int, ...]]) -> str:
    if len(run) == 1:
        return layout.element(array, run[0]).path
    return slice_of(layout, array, run[0][:-1], run[0][-1], run[-1][-1]).path


def _part_paths(layout: Layout, register: Register, share: bytes) -> Iterator[str]:
    """Yield the paths of an integer's written bits, least significant first.

    If all bits of a byte, word or double word are written, yield its path instead.
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
