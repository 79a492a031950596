"""Protobuf's wire format, for messages that are assembled from shared parts.

Serialised fields may be concatenated to a message (protobuf.dev, "Encoding").
"""

from __future__ import annotations

from typing import Final

_SHORT: Final = [bytes((number,)) for number in range(0x80)]


def varint(number: int) -> bytes:
    """Encode a number that is not negative."""
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
    """Encode bytes with their length in front."""
    return varint(len(data)) + data


def field(field_number: int, data: bytes) -> bytes:
    """Encode a field that is bytes, text, a message, or packed numbers."""
    return varint(field_number << 3 | 2) + varint(len(data)) + data


def number(field_number: int, value: int) -> bytes:
    """Encode a field that is an enum or a whole number that is not negative."""
    return varint(field_number << 3) + varint(value)
