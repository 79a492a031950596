"""Values of SimlogAPI version 2: ``google.protobuf.Value``.

Serialised fields may be concatenated, so what all listeners share is encoded once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from typing import Any, Final

import numpy as np
from google.protobuf.struct_pb2 import NULL_VALUE, ListValue
from google.protobuf.struct_pb2 import Value as WireValue

from shmio.endpoints.grpc.encoding import BlockImage, Subject, delimited, varint
from shmio.endpoints.grpc.streams.feed import Moment
from shmio.endpoints.grpc.topics import Shape, TimeTopic
from shmio.errors import ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import decode_segment, encode_segment, shorten
from shmio.layout.values.codec import Value, codec, scalar_codec
from shmio.layout.values.text import from_text, wire_type
from shmio.wire import simlog_v2_pb2 as wire

MAX_ELEMENTS: Final = 1 << 16
"""Most numbers, bits or texts in one value."""
MAX_MEMBERS: Final = 4096
"""Most registers in one structure."""
MAX_LEVELS: Final = 24
"""Deepest nesting of structures: messages nest three times as deep, and readers stop at 100."""

_DOUBLE: Final = struct.Struct("<Bd")
_TYPES: Final = {"bool": wire.BOOL, "double": wire.NUMBER, "int": wire.NUMBER, "string": wire.STRING}


class EncodedMessage:
    """A SimlogMessage without its path: the header's time stamp, and the later fields."""

    __slots__ = ("_last", "rest", "stamp")

    def __init__(self, stamp: bytes, rest: bytes) -> None:
        self.stamp = stamp
        self.rest = rest
        self._last: tuple[bytes | None, bytes] = None, b""

    def __len__(self) -> int:
        return len(self.stamp) + len(self.rest)

    def under(self, path: bytes) -> bytes:
        """Return the message with a path, which is encoded by :func:`path_field`."""
        last, whole = self._last
        if last != path:  # most listeners use the same path
            header = self.stamp + path
            whole = b"\x0a" + varint(len(header)) + header + self.rest
            self._last = path, whole
        return whole


def value_type(found: Shape) -> wire.ValueType:
    """Return the type of a topic's values."""
    if not found.whole:
        return wire.STRUCT
    (register,) = found.registers
    return wire.LIST if register.dims else _TYPES[wire_type(register)]


def subject(found: Shape, layout: Layout) -> Subject:
    """Return the subject to listen to. ValueRangeError as for :func:`encoder`."""
    return Subject("v2", found.path, found.registers, encoder(found, layout))


def encoder(found: Shape, layout: Layout) -> Callable[[BlockImage], EncodedMessage | None]:
    """Return a function that encodes an image as a message, or as None if it holds no value.

    ValueRangeError: the topic is too large or nested too deeply for a message.
    """
    members, elements = len(found.registers), found.elements
    if members > MAX_MEMBERS or elements > MAX_ELEMENTS:
        raise ValueRangeError(
            f"{shorten(found.path)}: {members} registers with {elements} elements are too many for one value, "
            f"at most {MAX_MEMBERS} with {MAX_ELEMENTS} are allowed; its members are topics, too"
        )
    head = wire.SimlogMessage(type=value_type(found)).SerializeToString() + b"\x1a"
    serialise = _whole(found.registers[0], layout) if found.whole else _structure(found, layout)

    def encode(picture: BlockImage) -> EncodedMessage | None:
        value = serialise(picture.image)
        return None if value is None else EncodedMessage(time_stamp(picture.clock_ns), head + delimited(value))

    return encode


def path_field(path: str) -> bytes:
    """Encode a header's path."""
    return b"\x12" + delimited(path.encode())


@lru_cache(maxsize=64)  # a frame or two for each feed
def time_stamp(clock_ns: int) -> bytes:
    """Encode a header's time, from ns of the instance's clock."""
    seconds, nanos = divmod(clock_ns, 1_000_000_000)
    whole = b"\x08" + varint(seconds) if seconds else b""
    return b"\x0a" + delimited(whole + b"\x10" + varint(nanos) if nanos else whole)


def nothing(stamp: bytes) -> EncodedMessage:
    """Return the message of a missing value."""
    return EncodedMessage(stamp, wire.SimlogMessage(type=wire.NULL, value=to_wire(None)).SerializeToString())


def time_message(topic: TimeTopic, moment: Moment) -> EncodedMessage:
    """Return the message of a topic of time: a step's number, or the time in s."""
    value = moment.number if topic is TimeTopic.STEP else moment.clock_ns / 1e9
    message = wire.SimlogMessage(type=wire.NUMBER, value=to_wire(value))
    return EncodedMessage(time_stamp(moment.clock_ns), message.SerializeToString())


def repeated(messages: Iterable[bytes]) -> bytes:
    """Encode a message whose repeated field 1 has these messages."""
    return b"".join(b"\x0a" + delimited(message) for message in messages)


def to_wire(value: Value) -> WireValue:
    """Convert a decoded value: numbers become doubles, a missing value null."""
    found = WireValue()
    _put(value, found)
    return found


def from_wire(value: WireValue, found: Shape) -> dict[str, object]:
    """Read a client's value as values by register path; a structure may lack members.

    A text for a register that is not a text is read as in version 1, so that 64-bit numbers keep
    all their digits. ValueRangeError: the value does not fit.
    """
    if found.whole:
        (register,) = found.registers
        return {register.path: _read(value, register)}
    values: dict[str, object] = {}
    by_path = {register.path: register for register in found.registers}
    _read_members(value, found.path, by_path, values)
    if not values:
        raise ValueRangeError(f"{found.path}: expected a structure with some of its members, found none")
    return values


def _read_members(value: WireValue, path: str, by_path: Mapping[str, Register], values: dict[str, object]) -> None:
    """Collect a structure's values, no deeper than the registers' paths."""
    if value.WhichOneof("kind") != "struct_value":
        raise ValueRangeError(f"{path}: expected a structure")
    for name, member in value.struct_value.fields.items():
        inner = f"{path}/{encode_segment(name)}"
        if inner in by_path:
            values[inner] = _read(member, by_path[inner])
        elif any(other.startswith(f"{inner}/") for other in by_path):
            _read_members(member, inner, by_path, values)
        else:
            raise ValueRangeError(f"{shorten(inner)}: the structure has no such member")


def _read(value: WireValue, register: Register) -> object:
    kind = value.WhichOneof("kind")
    if kind == "string_value" and (register.dims or wire_type(register) != "string"):
        return from_text(value.string_value, register)
    return _plain(value, register.path)


def _plain(value: WireValue, name: str) -> object:
    kind = value.WhichOneof("kind")
    if kind == "list_value":
        return [_plain(item, name) for item in value.list_value.values]
    if kind in ("number_value", "bool_value", "string_value"):
        plain: object = getattr(value, kind)
        return plain
    raise ValueRangeError(f"{name}: expected a value, found {'a structure' if kind == 'struct_value' else 'none'}")


def _whole(register: Register, layout: Layout) -> Callable[[bytes], bytes | None]:
    """Return a function that encodes a register as a Value, or as None if it holds no value."""
    element, order = register.element, layout.byte_order
    code = "" if element.base == "BOOL" else scalar_codec(element, order).plain
    if code and len(register.dims) == 1:
        return _numbers(register, np.dtype(code).newbyteorder(order))
    decode = codec(register, order).decode
    if code and not register.dims:
        return lambda image: _DOUBLE.pack(0x11, decode(image))  # field 1 of a Value

    def serialise(image: bytes) -> bytes | None:
        value = decode(image)
        return None if value is None else to_wire(value).SerializeToString()

    return serialise


def _numbers(register: Register, kind: np.dtype[Any]) -> Callable[[bytes], bytes]:
    """Return such a function for an array of numbers; a hundred times as fast as one by one."""
    one = ListValue(values=[WireValue(number_value=0)]).SerializeToString()  # ends in its double
    size = register.count * len(one)
    head = b"\x32" + varint(size)
    template = np.zeros(register.count, [("head", f"V{len(one) - 8}"), ("value", "<f8")])
    template["head"] = np.void(one[:-8])

    def serialise(image: bytes) -> bytes:
        values = template.copy()
        values["value"] = np.frombuffer(image, kind, register.count, register.offset)
        return head + values.tobytes()

    return serialise


def _structure(found: Shape, layout: Layout) -> Callable[[bytes], bytes]:
    """Return such a function for a structure. ValueRangeError: it is nested too deeply."""
    start = len(found.path) + 1
    fill = _members([(register.path[start:].split("/"), register) for register in found.registers], layout, MAX_LEVELS)

    def serialise(image: bytes) -> bytes:
        value = WireValue()
        fill(image, value)
        return value.SerializeToString(deterministic=True)  # equal values are equal bytes: maps have no order

    return serialise


def _members(
    parts: list[tuple[list[str], Register]], layout: Layout, levels: int
) -> Callable[[bytes, WireValue], None]:
    """Return a function that fills in a structure; ``parts``: each register's remaining names."""
    if not levels:
        raise ValueRangeError(f"{shorten(parts[0][1].path)}: more than {MAX_LEVELS} nested structures")
    groups: dict[str, list[tuple[list[str], Register]]] = {}
    for (name, *rest), register in parts:
        groups.setdefault(decode_segment(name), []).append((rest, register))
    members: list[tuple[str, Callable[[bytes, WireValue], None]]] = []
    for name, inner in groups.items():
        rest, register = inner[0]
        members.append((name, _members(inner, layout, levels - 1) if rest else _member(register, layout)))

    def fill(image: bytes, value: WireValue) -> None:
        fields = value.struct_value.fields
        for name, put in members:
            put(image, fields[name])

    return fill


def _member(register: Register, layout: Layout) -> Callable[[bytes, WireValue], None]:
    decode = codec(register, layout.byte_order).decode
    return lambda image, value: _put(decode(image), value)


def _put(item: Value, value: WireValue) -> None:
    if isinstance(item, bool):
        value.bool_value = item
    elif isinstance(item, int | float):
        value.number_value = item
    elif isinstance(item, str):
        value.string_value = item
    elif item is None:
        value.null_value = NULL_VALUE
    else:
        values = value.list_value.values
        for inner in item:
            _put(inner, values.add())
