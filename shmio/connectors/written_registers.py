"""Finds the registers that a write sets, for devices that accept only whole values."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator

from shmio.errors import ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import Write, apply, bits_of, element_bits


def written_registers(layout: Layout, write: Write, present: Callable[[int], Value]) -> Iterator[tuple[int, Value]]:
    """Yield the registers that a write sets, with their new values.

    Args:
        layout: The layout of the block.
        write: The write. It may set some elements of an array, but must set any other register as a
            whole.
        present: Function that returns the present value of an array, given the array's index in the
            layout, for the elements that the write does not set. It raises ValueRangeError if the
            value is unknown.

    Yields:
        The index of each register in the layout, and its new value.

    Raises:
        ValueError: The write sets only a part of a value, or sets no register.

    """
    none = True
    covered, image = bytearray(layout.size), bytearray(layout.size)
    apply(Write(write.offset, write.mask, b"\xff" * len(write.data)), covered)
    registers, stop = layout.registers, write.offset + len(write.data)
    first = bisect_right(registers, write.offset, key=lambda register: register.offset + register.size)
    for index in range(first, bisect_left(registers, stop, key=lambda register: register.offset)):
        register = registers[index]
        wanted = bits_of(register)
        there = covered[register.offset : register.offset + register.size]
        share = bytes(a & b for a, b in zip(there, wanted, strict=True))
        if not any(share):
            continue
        none = False
        if share != wanted:
            if not _whole_elements(register, share):
                raise ValueError(f"{register.path}: a message cannot carry a part of a value; write the whole register")
            try:
                codec(register, layout.byte_order).encode_into(present(index), image)
            except ValueRangeError:
                raise ValueError(
                    f"{register.path}: the other elements are unknown, because the last message does not contain them; "
                    "write the whole array"
                ) from None
        apply(write, image)
        yield index, codec(register, layout.byte_order).decode(image)
    if none:
        raise ValueError("no register of the layout covers the written bytes")


def _whole_elements(register: Register, share: bytes) -> bool:
    """Return whether the written bits, ``share``, are those of whole elements of an array."""
    if not register.dims:
        return False
    if register.type == "BOOL":
        return any(a & b for a, b in zip(element_bits(register), share, strict=True))
    size, stride = register.element.size, register.element.stride
    parts = (share[place * stride : place * stride + size] for place in range(register.count))
    return all(part in (bytes(size), b"\xff" * size) for part in parts)
