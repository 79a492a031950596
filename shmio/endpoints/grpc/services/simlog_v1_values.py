"""Values of SimlogAPI version 1: ROSMessages.

A register is a text; a recognised structure has a message type of its own. Serialised fields
may be concatenated, so constant fields are encoded once, and the time once per frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

from google.protobuf.message import Message

from shmio.endpoints.grpc.encoding import BlockImage, Encode, delimited, varint
from shmio.endpoints.grpc.topics import Shape
from shmio.errors import ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.structures import CONTENTS, Found, recognise
from shmio.layout.topic import shorten
from shmio.layout.values.codec import codec
from shmio.layout.values.literal import default_text, scalar_literal
from shmio.layout.values.text import from_text, to_text, wire_type
from shmio.wire import simlog_v1_pb2 as wire

_Fill = Callable[[bytes, Any], None]
"""Fills a message from an image."""

_BITS: Final = {"seq": 32, "sec": 64, "nsec": 64, "msec": 64}


def message_type(found: Shape) -> str:
    """Return version 1's name of a type. ValueRangeError: a structure without a message type."""
    return wire_type(found.registers[0]) if found.whole else _known(found)[0]


def encoder(found: Shape, layout: Layout) -> Encode:
    """Return a function that encodes an image as a ROSMessage, or as None if it holds no value.

    ValueRangeError as for :func:`message_type`.
    """
    return _text(found.registers[0], layout) if found.whole else _structure(found, layout)


def read(data: wire.ROSMessage, found: Shape) -> Mapping[str, object]:
    """Read a client's message as values by register path. ValueRangeError: it does not fit."""
    content = data.WhichOneof("content")
    if found.whole:
        (register,) = found.registers
        if content not in (None, "timeStamp"):
            raise ValueRangeError(f"{shorten(found.path)}: expected a text, found a {content}")
        return {register.path: from_text(data.value, register)}
    shape, members = _known(found)
    if content != CONTENTS[shape]:
        what = f"a {content}" if content else "a text"
        raise ValueRangeError(f"{shorten(found.path)}: expected a {CONTENTS[shape]}, found {what}")
    return dict(_values(getattr(data, content), members))


def _known(found: Shape) -> tuple[str, Found]:
    known = recognise(found.path, found.registers)
    if known is None:
        raise ValueRangeError(
            f"{shorten(found.path)}: version 1 has no message for this structure; use its members as topics"
        )
    return known


def _text(register: Register, layout: Layout) -> Encode:
    kind = wire.ROSMessage(type=wire_type(register)).SerializeToString()
    decode = codec(register, layout.byte_order).decode

    def encode(frame: BlockImage) -> bytes | None:
        value = decode(frame.image)
        if value is None:
            return None
        text = to_text(value, register).encode()
        return kind + (b"\x12" + delimited(text) if text else b"") + time_stamp(frame.number, frame.clock_ns)

    return encode


@lru_cache(maxsize=64)  # a frame or two for each feed
def time_stamp(number: int, clock_ns: int) -> bytes:
    """Encode the time stamp content: number of the frame or step, and time in ns."""
    seconds = clock_ns // 1_000_000_000
    stamp = (b"\x08" + varint(seconds) if seconds else b"") + b"\x10" + varint(clock_ns)
    return b"\x4a" + delimited(b"\x08" + varint(number & 0xFFFFFFFF) + b"\x12" + delimited(stamp))


def _structure(found: Shape, layout: Layout) -> Encode:
    shape, members = _known(found)
    kind = wire.ROSMessage(type=shape).SerializeToString()
    fill = _filler(members, layout)

    def encode(frame: BlockImage) -> bytes:
        message = wire.ROSMessage()
        content = getattr(message, CONTENTS[shape])
        content.SetInParent()  # present, even if all of it is zero
        fill(frame.image, content)
        return kind + message.SerializeToString()

    return encode


def _filler(members: Found, layout: Layout) -> _Fill:
    parts = [_member(name, member, layout) for name, member in members.items()]

    def fill(image: bytes, message: Message) -> None:
        for part in parts:
            part(image, message)

    return fill


def _member(name: str, member: Register | Found | Sequence[Found], layout: Layout) -> _Fill:
    if isinstance(member, Register):
        decode: Callable[[bytes], Any] = codec(member, layout.byte_order).decode
        convert = _converter(name, member)
        if member.dims:
            return lambda image, message: getattr(message, name).extend(map(convert, decode(image)))
        return lambda image, message: setattr(message, name, convert(decode(image)))
    if isinstance(member, Mapping):
        inner = _filler(member, layout)
        return lambda image, message: inner(image, _present(getattr(message, name)))
    each = [_filler(element, layout) for element in member]

    def fill(image: bytes, message: Any) -> None:
        for element in each:
            element(image, getattr(message, name).add())

    return fill


def _present(message: Any) -> Any:
    message.SetInParent()
    return message


def _converter(name: str, register: Register) -> Callable[[Any], Any]:
    """Return the conversion from a register's value to a field's; invalid texts become empty."""
    if wire_type(register) == "string":
        return lambda value: value or ""
    if name in _BITS:
        most = (1 << _BITS[name]) - 1
        return lambda value: value & most
    return float


def _values(message: Any, members: Found) -> Iterator[tuple[str, object]]:
    """Yield a message's values by register path; absent inner messages give no values."""
    for name, member in members.items():
        value = getattr(message, name)
        if isinstance(member, Register):
            yield member.path, _filled(value, member) if member.dims else value
        elif isinstance(member, Mapping):
            if message.HasField(name):
                yield from _values(value, member)
        else:
            if len(value) > len(member):
                raise ValueRangeError(f"{name}: expected at most {len(member)}, found {len(value)}")
            for place, element in enumerate(member):
                yield from _values(value[place] if place < len(value) else wire.JointTrajectoryPoint(), element)


def _filled(values: Sequence[object], register: Register) -> list[object]:
    """Return a value for each of an array's elements; missing ones get the type's default."""
    if len(values) > register.count:
        raise ValueRangeError(f"{register.path}: expected at most {register.count} elements, found {len(values)}")
    default = scalar_literal(default_text(register.element), register.element)
    return [*values, *[default] * (register.count - len(values))]
