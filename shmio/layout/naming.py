"""What bytes and bits of a block are called: the paths by which :func:`shmio.layout.topic.find` finds them."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator

from shmio.layout.model import Layout, Register
from shmio.layout.parts import part_of, slice_of
from shmio.layout.types import INTEGERS
from shmio.layout.write import Write, bits_of, elements


def paths_of(layout: Layout, writes: Iterable[Write]) -> list[str]:
    """Return the paths of the bits that writes set, in address order: whole registers, or else slices, elements, bits.

    Of what has no parts, as a REAL, its path; nothing for bytes that are no register's, or outside the block.
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
    """Return the path of the register, or of the array's element, that lies at a byte; empty if there is none."""
    for index in _overlapping(layout, offset, offset + 1):
        register = layout.registers[index]
        if not register.dims or register.bit is not None:
            return register.path
        flat, indices = (offset - register.offset) // register.element.stride, list[str]()
        for low, high in reversed(register.dims):
            flat, place = divmod(flat, high - low + 1)
            indices.insert(0, str(low + place))
        return "/".join((register.path, *indices))
    return ""


def _overlapping(layout: Layout, start: int, stop: int) -> range:
    """The registers that share a byte with a range."""
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
        yield from _elements(layout, register, bits)
    elif register.type in INTEGERS:
        yield from _parts(layout, register, share)
    else:
        yield register.path


def _share(register: Register, bits: bytearray) -> bytes:
    """The part of these bits that is a register's."""
    there = bits[register.offset : register.offset + register.size]
    return bytes(bit & own for bit, own in zip(there, bits_of(register), strict=True))


def _elements(layout: Layout, array: Register, bits: bytearray) -> Iterator[str]:
    """Those of an array; neighbours within its last dimension as a slice."""
    run: list[tuple[int, ...]] = []
    for element in elements(layout, array):
        index = tuple(int(part) for part in element.path[len(array.path) + 1 :].split("/"))
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
    """Bits of an integer; whole bytes of it as such, the least significant first."""
    for number, byte in enumerate(reversed(share) if layout.byte_order == "big" else share):
        if byte == 0xFF:
            yield part_of(layout, register, "B", number).path
        else:
            yield from (part_of(layout, register, "X", 8 * number + bit).path for bit in range(8) if byte >> bit & 1)
