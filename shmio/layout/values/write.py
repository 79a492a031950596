"""Turn new values of registers into writes to a block: bytes, or a bit without its neighbours."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

from shmio.errors import PathError
from shmio.layout.glob import Glob
from shmio.layout.model import ByteOrder, Layout, Register, element_position
from shmio.layout.topic import find_each, names_part
from shmio.layout.values.codec import codec


class Write(NamedTuple):
    """A change to bytes of a block.

    With ``mask`` 0, all of ``data`` is written from ``offset`` on. Otherwise ``mask`` has one bit
    set, ``data`` is one byte, and only that bit of the byte at ``offset`` takes its value.
    """

    offset: int
    mask: int
    data: bytes


def encode(register: Register, value: object, byte_order: ByteOrder = "big") -> list[Write]:
    """Return the writes that set a register, an array or a part of one to a value.

    There is one write, or more for a slice of bits. An array of bits is written as whole bytes,
    because no register uses the rest of a row's last byte.

    Raises:
        ValueRangeError: The value does not fit the register.
    """
    image = bytearray(register.size)
    # With offset 0, the image needs to be no larger than the register.
    codec(replace(register, offset=0), byte_order).encode_into(value, image)
    if register.partial:
        writes = merge(image, bits_of(register), [(0, register.size)])
        return [write._replace(offset=register.offset + write.offset) for write in writes]
    mask = 0 if register.bit is None or register.dims else 1 << register.bit
    return [Write(register.offset, mask, bytes(image))]


def sizes(register: Register) -> list[int]:
    """Return the maximum size in bytes of each write that :func:`encode` returns for a register."""
    return [register.size] + [1] * 14 if register.partial else [register.size]


def apply(write: Write, image: bytearray | memoryview) -> None:
    """Apply a write to an image of the block."""
    offset, mask, data = write
    if mask:
        image[offset] = image[offset] & (mask ^ 0xFF) | data[0] & mask
    else:
        image[offset : offset + len(data)] = data


def bits_of(register: Register) -> bytes:
    """Return a mask of the register's ``size`` bytes with the bits that :func:`encode` writes."""
    if register.partial:
        bits = (1 << register.count) - 1 << (register.bit or 0)
        return bits.to_bytes(register.size, "little")
    if register.bit is None or register.dims:
        return b"\xff" * register.size
    return bytes([1 << register.bit])


def covering(registers: Iterable[Register], size: int) -> bytes:
    """Return an image of ``size`` bytes in which the bits of these registers are set."""
    mask = bytearray(size)
    for register in registers:
        for at, bits in enumerate(bits_of(register), register.offset):
            mask[at] |= bits
    return bytes(mask)


def cover(layout: Layout, patterns: Iterable[str]) -> bytes:
    """Return an image of the block in which the bits of all registers that match are set.

    Raises:
        PathError: A pattern is malformed, or names a part that its register does not have.
    """
    named = (register for pattern in patterns for register in chosen(layout, pattern))
    mask = bytearray(covering(named, layout.size))
    for register in layout.registers:
        if register.type == "BOOL" and register.dims:
            _fill_rows(mask, register)
    return bytes(mask)


def chosen(layout: Layout, pattern: str) -> Iterator[Register]:
    """Yield the registers that a path or a pattern names; a slice as its elements.

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
    """Return the fewest writes that copy the masked bits of an image to a block.

    Only the bytes in the ``ranges`` (start, stop) are searched.
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
    """Return the ranges in order, with those that touch joined."""
    joined: list[tuple[int, int]] = []
    for start, stop in sorted(ranges):
        if joined and start <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(joined[-1][1], stop)
        else:
            joined.append((start, stop))
    return joined


def elements(layout: Layout, register: Register) -> Iterator[Register]:
    """Yield the elements of an array; the last index runs fastest."""
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
    """Set the whole last byte of each row of bits in which all declared bits are set."""
    own = bytearray(register.size)
    for flat in range(register.count):
        byte, bit = element_position(register.element, register.shape, flat)
        own[byte] |= 1 << (bit or 0)
    for at, bits in enumerate(own, register.offset):
        if mask[at] & bits == bits:
            mask[at] = 0xFF
