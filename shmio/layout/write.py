"""What a new value of a register changes in a block: bytes, or single bits whose neighbours stay as they are."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from shmio.errors import PathError
from shmio.layout.codec import codec
from shmio.layout.glob import Glob
from shmio.layout.model import ByteOrder, Layout, Register, element_position
from shmio.layout.topic import find


class Write(NamedTuple):
    """Bytes of a block to be changed.

    ``mask`` 0: all of ``data`` goes to ``offset`` and on. Else ``mask`` has one bit, and of the one byte at ``offset``
    only that bit changes, to what it is in the one byte of ``data``.
    """

    offset: int
    mask: int
    data: bytes


def encode(register: Register, value: object, byte_order: ByteOrder = "big") -> list[Write]:
    """The writes that give a register, an array or an element this value; ValueRangeError."""
    image = bytearray(register.offset + register.size)
    codec(register, byte_order).encode_into(value, image)
    if register.type != "BOOL":
        return [Write(register.offset, 0, bytes(image[register.offset :]))]
    if not register.dims:
        return [Write(register.offset, 1 << (register.bit or 0), bytes(image[register.offset :]))]
    return merge(image, bit_mask(register, len(image)), [(register.offset, len(image))])


def bit_mask(register: Register, size: int) -> bytearray:
    """An image of ``size`` bytes in which exactly the register's bits are set."""
    mask = bytearray(size)
    _set_bits(register, mask)
    return mask


def cover(layout: Layout, patterns: Iterable[str]) -> bytes:
    """An image of the layout's size in which the bits of all that the patterns name are set; PathError."""
    mask = bytearray(layout.size)
    for pattern in patterns:
        if "*" not in pattern:
            try:
                _set_bits(find(layout, pattern), mask)
                continue
            except PathError:  # a structure: what is below it
                pass
        glob = Glob(pattern)
        for register in layout.registers:
            if glob.matches(register.path):
                _set_bits(register, mask)
            elif register.dims:
                for element in _elements(layout, register):
                    if glob.matches(element.path):
                        _set_bits(element, mask)
    return bytes(mask)


def merge(image: bytes | bytearray, mask: bytes | bytearray, ranges: Iterable[tuple[int, int]]) -> list[Write]:
    """The fewest writes that bring the masked bits of an image to a block, looked for in (start, stop) ranges."""
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
    """Ranges in order, those that touch joined."""
    joined: list[tuple[int, int]] = []
    for start, stop in sorted(ranges):
        if joined and start <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(joined[-1][1], stop)
        else:
            joined.append((start, stop))
    return joined


def _elements(layout: Layout, register: Register) -> Iterable[Register]:
    index = [low for low, _ in register.dims]
    for _ in range(register.count):
        yield layout.element(register, tuple(index))
        for place in reversed(range(len(index))):
            low, high = register.dims[place]
            index[place] += 1
            if index[place] <= high:
                break
            index[place] = low


def _set_bits(register: Register, mask: bytearray) -> None:
    element = register.element
    if register.type == "BOOL":
        for flat in range(register.count):
            byte, bit = element_position(element, register.shape, flat) if register.dims else (0, register.bit)
            mask[register.offset + byte] |= 1 << (bit or 0)
        return
    for start in range(register.offset, register.offset + register.size, element.stride):
        mask[start : start + element.size] = b"\xff" * element.size
