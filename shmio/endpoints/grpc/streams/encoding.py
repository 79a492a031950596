"""Protobuf's wire format, for messages that are put together of parts which many share.

Serialised fields may be concatenated: together they are a message (protobuf.dev, "Encoding").
"""

from __future__ import annotations

from typing import Final

_SHORT: Final = [bytes((number,)) for number in range(0x80)]


def varint(number: int) -> bytes:
    """A number from 0 on."""
    if number < 0x80:
        return _SHORT[number]
    if number < 0x4000:
        return bytes((number & 0x7F | 0x80, number >> 7))
    data = bytearray()
    while number > 0x7F:
        data.append(number & 0x7F | 0x80)
        number >>= 7
    data.append(number)
    return bytes(data)


def delimited(data: bytes) -> bytes:
    """Bytes behind their length."""
    return varint(len(data)) + data


def field(field_number: int, data: bytes) -> bytes:
    """A field of this number that is bytes, text, a message, or packed numbers."""
    return varint(field_number << 3 | 2) + varint(len(data)) + data


def number(field_number: int, value: int) -> bytes:
    """A field of this number that is a whole number from 0 on, or an enum's."""
    return varint(field_number << 3) + varint(value)
