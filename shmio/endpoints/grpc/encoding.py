"""Encodes images of blocks as messages, in Protobuf's wire format.

A message may be the concatenation of serialised fields (protobuf.dev, "Encoding"). So messages are
built from parts that all listeners share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence, Sized
from dataclasses import dataclass
from dataclasses import field as attribute
from typing import Final, NamedTuple, Protocol, TypeVar

from shmio.layout.model import Layout, Register
from shmio.model.statuses import status_area
from shmio.model.values import Quality

M = TypeVar("M", bound=Sized)


class BlockImage(Protocol):
    """An image of a block, with the number and time of its frame, step or write."""

    @property
    def number(self) -> int:
        """Number of the frame, step or write."""

    @property
    def clock_ns(self) -> int:
        """Instance time of the image, in ns."""

    @property
    def image(self) -> bytes:
        """The block's bytes, as consumers see them."""


class ShownImage(NamedTuple):
    """A :class:`BlockImage` that is not a frame, such as a frame's image with writes applied."""

    number: int
    clock_ns: int
    image: bytes


class SourceImage(BlockImage, Protocol):
    """An image that also has the bytes that the source delivered."""

    @property
    def raw(self) -> bytes:
        """The block's bytes as the source delivered them, without injections."""


Encode = Callable[[BlockImage], Sized | None]
"""Function that encodes an image as a message; it returns None if the bytes are not a valid value.

``len`` of the message is its size in bytes.
"""


@dataclass(frozen=True, slots=True)
class Subject:
    """A register, an array element or a structure, in the encoding of one service.

    Equal subjects are encoded once for all listeners.

    Attributes:
        wire: Name of the encoding.
        path: Canonical path in the block.
        registers: The registers of the subject.
        encode: Encodes the subject, from an image of the block, as a message.
        changed: Returns whether the subject differs between two images; if None, the registers are
            compared as consumers see them.

    """

    wire: str
    path: str
    registers: tuple[Register, ...] = attribute(compare=False)
    encode: Encode = attribute(compare=False)
    changed: Callable[[SourceImage, SourceImage], bool] | None = attribute(default=None, compare=False)


def unless_bad(
    encode: Callable[[BlockImage], M | None], registers: Sequence[Register], layout: Layout
) -> Callable[[BlockImage], M | None]:
    """Return a function that encodes like ``encode``, but returns None if the quality of a register is bad.

    Args:
        encode: Encodes an image as a message.
        registers: The registers whose quality counts.
        layout: The layout of the block.
    """
    area = status_area(layout)
    if area is None:
        return encode
    indices = area.indices(registers)

    def encode_unless_bad(image: BlockImage) -> M | None:
        if any(area.quality(image.image, index) is Quality.BAD for index in indices):
            return None
        return encode(image)

    return encode_unless_bad


_SHORT: Final = [bytes((number,)) for number in range(0x80)]


def varint(number: int) -> bytes:
    """Encode a non-negative integer as a varint."""
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
    """Return bytes, preceded by their length as a varint."""
    return varint(len(data)) + data


def field(field_number: int, data: bytes) -> bytes:
    """Encode a field that holds bytes, a text, a message, or packed numbers."""
    return varint(field_number << 3 | 2) + varint(len(data)) + data


def number(field_number: int, value: int) -> bytes:
    """Encode a field whose value is an enum or a non-negative integer."""
    return varint(field_number << 3) + varint(value)
