"""Convert registers between a frame's bytes and Python values.

``scalar.py`` lists the Python value of each type. An array is a list; with several dimensions, a
list of lists.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from typing import Protocol

from shmio.errors import ValueRangeError
from shmio.layout.model import ByteOrder, Register, bit_positions
from shmio.layout.values.checks import brief, to_bool
from shmio.layout.values.date_types import Buffer
from shmio.layout.values.scalar import Scalar, scalar_codec

Value = Scalar | list["Value"]


class RegisterCodec(Protocol):
    """Decodes and encodes one register of a frame; ``codec`` returns it."""

    def decode(self, data: Buffer) -> Value:
        """Return the register's value in a frame; None (or None elements) for invalid bytes."""

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        """Write the value into a frame; after an error the frame is unchanged.

        Raises:
            ValueRangeError: The value does not fit the type, or an array has the wrong shape.
        """


@lru_cache(maxsize=65_536)
def codec(register: Register, byte_order: ByteOrder = "big") -> RegisterCodec:
    """Return the register's codec; it is cached."""
    if register.type == "BOOL":
        return _BoolArray(register) if register.dims else _Bool(register)
    return _Array(register, byte_order) if register.dims else _Single(register, byte_order)


class _Bool:
    """Codec of a single BOOL."""

    def __init__(self, register: Register) -> None:
        self._offset, self._mask = register.offset, 1 << (register.bit or 0)

    def decode(self, data: Buffer) -> bool:
        return bool(data[self._offset] & self._mask)

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        if to_bool(value, "BOOL"):
            frame[self._offset] |= self._mask
        else:
            frame[self._offset] &= ~self._mask


class _Single:
    """Codec of any other elementary value."""

    def __init__(self, register: Register, byte_order: ByteOrder) -> None:
        self._scalar = scalar_codec(register.element, byte_order)
        self._offset, self._stop = register.offset, register.offset + register.size

    def decode(self, data: Buffer) -> Scalar:
        return self._scalar.decode(data, self._offset)

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        frame[self._offset : self._stop] = self._scalar.encode(value)


class _Array:
    """Codec of an array of anything but BOOL; it unpacks numbers all at once."""

    def __init__(self, register: Register, byte_order: ByteOrder) -> None:
        element = register.element
        self._name, self._shape = register.path, register.shape
        self._scalar = scalar_codec(element, byte_order)
        self._offset, self._stop = register.offset, register.offset + register.size
        self._size = element.size
        self._starts = range(0, register.count * element.stride, element.stride)
        order = ">" if byte_order == "big" else "<"
        self._bulk = struct.Struct(f"{order}{register.count}{self._scalar.plain}") if self._scalar.plain else None
        self._row = self._bulk if len(self._shape) == 1 else None

    def decode(self, data: Buffer) -> list[Value]:
        flat: list[Value]
        if self._bulk is not None:
            flat = list(self._bulk.unpack_from(data, self._offset))
        else:
            flat = [self._scalar.decode(data, self._offset + start) for start in self._starts]
        return nest(flat, self._shape)

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        if self._row is not None and isinstance(value, list | tuple) and {float, int}.issuperset(map(type, value)):
            with suppress(struct.error, OverflowError):  # the loop below finds the wrong element
                frame[self._offset : self._stop] = self._row.pack(*value)
                return
        image = bytearray(frame[self._offset : self._stop])
        for start, item in zip(self._starts, flatten(value, self._shape, self._name), strict=True):
            image[start : start + self._size] = self._scalar.encode(item)
        frame[self._offset : self._stop] = image


class _BoolArray:
    """Codec of an array of BOOL: eight bits to a byte, and each row begins at a new byte."""

    def __init__(self, register: Register) -> None:
        self._name, self._shape = register.path, register.shape
        self._offset, self._stop = register.offset, register.offset + register.size
        self._places = [(byte, 1 << bit) for byte, bit in bit_positions(register)]

    def decode(self, data: Buffer) -> list[Value]:
        image = bytes(data[self._offset : self._stop])
        return nest([image[byte] & mask != 0 for byte, mask in self._places], self._shape)

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        image = bytearray(frame[self._offset : self._stop])
        for (byte, mask), item in zip(self._places, flatten(value, self._shape, self._name), strict=True):
            if to_bool(item, "BOOL"):
                image[byte] |= mask
            else:
                image[byte] &= ~mask
        frame[self._offset : self._stop] = image


def nest(flat: list[Value], shape: tuple[int, ...]) -> list[Value]:
    """Return a flat list as nested lists of this shape; the last index runs fastest."""
    for length in reversed(shape[1:]):
        flat = [flat[start : start + length] for start in range(0, len(flat), length)]
    return flat


def flatten(value: object, shape: tuple[int, ...], name: str) -> Iterator[object]:
    """Yield the elements of nested lists; the last index runs fastest.

    Raises:
        ValueRangeError: The lists do not have this shape.
    """
    if not shape:
        yield value
        return
    if not isinstance(value, list | tuple) or len(value) != shape[0]:
        found = f"{len(value)}" if isinstance(value, list | tuple) else brief(value)
        raise ValueRangeError(f"{name}: expected a list of {shape[0]} elements, found {found}")
    for item in value:
        yield from flatten(item, shape[1:], name)
