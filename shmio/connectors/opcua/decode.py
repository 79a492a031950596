"""Reads values from a server's read responses and publish responses, and encodes single values.

The library's own decoding builds an object for each field, which is too slow for thousands of values a
cycle, and sets no limit to the memory that a short message can demand. This decoder reads only what a
source needs, and checks each length against the received bytes. Encoding: OPC 10000-6, section 5.2.
"""

from __future__ import annotations

import base64
import struct
import uuid
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from shmio.errors import ConnectorError
from shmio.model.statuses import BAD_DECODING_ERROR

BOOLEAN, SBYTE, BYTE, INT16, UINT16, INT32, UINT32, INT64, UINT64, FLOAT, DOUBLE, STRING, DATE_TIME, GUID = range(1, 15)
BYTE_STRING, XML, NODE_ID, EXPANDED_NODE_ID, STATUS_CODE, QUALIFIED_NAME, LOCALIZED_TEXT, EXTENSION = range(15, 23)
DATA_VALUE, VARIANT, DIAGNOSTICS = range(23, 26)
NAMES: Final = (
    "null", "Boolean", "SByte", "Byte", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Float", "Double",
    "String", "DateTime", "Guid", "ByteString", "XmlElement", "NodeId", "ExpandedNodeId", "StatusCode", "QualifiedName",
    "LocalizedText", "structure", "DataValue", "Variant", "DiagnosticInfo",
)  # fmt: skip
"""Names of the built-in types, indexed by their numbers."""

_FIXED: Final = {
    BOOLEAN: "?", SBYTE: "b", BYTE: "B", INT16: "h", UINT16: "H", INT32: "i", UINT32: "I", INT64: "q", UINT64: "Q",
    FLOAT: "f", DOUBLE: "d", STATUS_CODE: "I",
}  # fmt: skip
_STRUCTS: Final = {kind: struct.Struct(f"<{code}") for kind, code in _FIXED.items()}
_INT, _UINT, _TIME, _WORD = struct.Struct("<i"), struct.Struct("<I"), struct.Struct("<q"), struct.Struct("<H")
_EPOCH: Final = 116_444_736_000_000_000  # 1970 in units of 100 ns since 1601
_LAST_TICK: Final = 2_650_467_743_990_000_000
"""9999-12-31T23:59:59: the standard represents later times by the greatest number (OPC 10000-6, section 5.2.2.5)."""
_LAST_STAMP_NS: Final = (1 << 63) - 1
"""The last timestamp, in 2262, that the status of a register can hold."""
_MAX_DEPTH: Final = 8
_SERVICE_FAULT, _READ_RESPONSE, _PUBLISH_RESPONSE = 397, 634, 829
_DATA_CHANGE, _STATUS_CHANGE = 811, 820


class MalformedError(ConnectorError):
    """A message does not follow the protocol."""

    def __init__(self, what: str = "the server's answer is malformed") -> None:
        super().__init__(what)


class FaultError(ConnectorError):
    """The server refuses a request; ``code`` is its status code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"the server refuses a request with 0x{code:08X}")
        self.code = code


class Extension(NamedTuple):
    """A structure as the server encodes it: the node id of the encoding, and the bytes."""

    encoding: bytes
    body: bytes


class Sample(NamedTuple):
    """A value that the server sent.

    Attributes:
        kind: Number of the built-in type; 0 if there is no value.
        value: The value; for an array, a flat list. Times are ns since 1970, texts are str, byte
            strings are bytes.
        dims: Sizes of an array's dimensions; None for a scalar.
        code: Status code.
        source_ns: The source's timestamp, or else the server's, in ns since 1970 UTC; 0 if there is
            neither.

    """

    kind: int
    value: Any
    dims: tuple[int, ...] | None
    code: int
    source_ns: int


class Publication(NamedTuple):
    """Content of a publish response.

    ``keep_alive`` is true if the response has no notifications, and only shows that the server is
    alive. ``values`` are pairs of a monitored item's number and its sample. ``closed`` is the
    status code with which the server ended the subscription, or 0.
    """

    subscription: int
    sequence: int
    keep_alive: bool
    values: list[tuple[int, Sample]]
    closed: int


def check_fault(data: bytes) -> None:
    """Raise FaultError if the server refuses the request, or MalformedError if the response is malformed."""
    Reader(data).header(None)


def read_response(data: bytes) -> list[Sample]:
    """Return the values of a read response. Raise FaultError or MalformedError."""
    reader = Reader(data)
    reader.header(_READ_RESPONSE)
    return [reader.data_value(0) for _ in range(reader.count())]


def publish_response(data: bytes) -> Publication:
    """Return the content of a publish response. Raise FaultError or MalformedError."""
    reader = Reader(data)
    reader.header(_PUBLISH_RESPONSE)
    subscription = reader.u32()
    reader.skip(4 * reader.count(4))
    reader.skip(1)  # whether there are more notifications
    sequence = reader.u32()
    reader.skip(8)
    values: list[tuple[int, Sample]] = []
    closed = 0
    count = reader.count()
    for _ in range(count):
        kind, body = reader.extension_parts()
        if kind == _DATA_CHANGE:
            inner = Reader(body)
            values += inner.monitored(inner.count(5))
        elif kind == _STATUS_CHANGE:
            closed = Reader(body).u32() or 0x80000000
    return Publication(subscription, sequence, not count, values, closed)


NodeKey = tuple[int, int, int | str | bytes]
"""A node id that can be compared: the type of its identifier (2 for a number), its namespace and its identifier."""


def node_key(found: tuple[int, int, int | str | bytes]) -> NodeKey:
    """Convert a node id to the form that can be compared, in which all numbers have the same type."""
    form, namespace, identifier = found
    return max(form, 2), namespace, identifier


class Reader:
    """Reads a message, or a part of one, from its beginning. Each method reads the item that it is named after."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def header(self, expected: int | None) -> None:
        """Read the type and the header of a response.

        Args:
            expected: Number of the response's type; None: any type is right.

        Raises:
            FaultError: The server refuses the request.
            MalformedError: The response has another type, or is malformed.

        """
        kind = self.type_id()
        self.skip(12)  # time, and the request's handle
        code = self.u32()
        self.diagnostics(0)
        for _ in range(self.count(4)):
            self.chunk()
        self.extension_parts()
        if kind == _SERVICE_FAULT or code >> 30:
            raise FaultError(code or 0x80000000)
        if expected is not None and kind != expected:
            raise MalformedError

    @property
    def left(self) -> int:
        """Number of bytes not yet read."""
        return len(self._data) - self._at

    def skip(self, size: int) -> None:
        """Skip bytes."""
        self._at += size
        if self._at > len(self._data):
            raise MalformedError

    def take(self, size: int) -> bytes:
        """Read bytes."""
        start = self._at
        self.skip(size)
        return self._data[start : self._at]

    def u8(self) -> int:
        """Read a Byte."""
        self.skip(1)
        return self._data[self._at - 1]

    def u32(self) -> int:
        """Read a UInt32."""
        self.skip(4)
        return int(_UINT.unpack_from(self._data, self._at - 4)[0])

    def i32(self) -> int:
        """Read an Int32."""
        self.skip(4)
        return int(_INT.unpack_from(self._data, self._at - 4)[0])

    def count(self, least: int = 1) -> int:
        """Read the length of an array; return 0 for a null array.

        Args:
            least: Minimum number of bytes of an element.

        Raises:
            MalformedError: The message is too short for the array.

        """
        self.skip(4)
        count = int(_INT.unpack_from(self._data, self._at - 4)[0])
        if count <= 0:
            return 0
        if count * least > len(self._data) - self._at:
            raise MalformedError
        return count

    def chunk(self) -> bytes | None:
        """Read a length, and that number of bytes; return None if the length stands for null."""
        self.skip(4)
        size = int(_INT.unpack_from(self._data, self._at - 4)[0])
        return None if size < 0 else self.take(size)

    def text(self) -> str:
        """Read a String; return "" for a null String."""
        return (self.chunk() or b"").decode("utf-8", "replace")

    def time(self) -> int:
        """Read a time; return ns since 1970."""
        self.skip(8)
        ticks = int(_TIME.unpack_from(self._data, self._at - 8)[0])
        return (min(max(ticks, 0), _LAST_TICK) - _EPOCH) * 100

    def node_id(self) -> tuple[int, int, int | str | bytes]:
        """Read a node id, expanded or not; return the type of its identifier, its namespace and the identifier."""
        mask = self.u8()
        form = mask & 0x3F
        found: tuple[int, int, int | str | bytes]
        if form == 0:
            found = form, 0, self.u8()
        elif form == 1:
            found = form, self.u8(), int(_WORD.unpack(self.take(2))[0])
        else:
            namespace = int(_WORD.unpack(self.take(2))[0])
            if form == 2:
                found = form, namespace, self.u32()
            elif form == 3:
                found = form, namespace, self.text()
            elif form == 4:
                found = form, namespace, self.take(16)
            elif form == 5:
                found = form, namespace, self.chunk() or b""
            else:
                raise MalformedError
        if mask & 0x80:
            self.chunk()
        if mask & 0x40:
            self.skip(4)
        return found

    def type_id(self) -> int:
        """Read a node id; return its number if it is a number in the standard's namespace, or else -1."""
        form, namespace, identifier = self.node_id()
        return int(identifier) if form < 3 and namespace == 0 else -1

    def extension_parts(self) -> tuple[int, bytes]:
        """Read a structure; return the number of its type, as :meth:`type_id` does, and its bytes."""
        kind = self.type_id()
        return kind, (self.chunk() or b"") if self.u8() else b""

    def extension(self) -> Extension:
        """Read a structure; return the node id of its encoding, and its bytes."""
        start = self._at
        self.node_id()
        encoding = self._data[start : self._at]
        return Extension(encoding, (self.chunk() or b"") if self.u8() else b"")

    def diagnostics(self, depth: int) -> None:
        """Skip a DiagnosticInfo."""
        mask = self.u8()
        self.skip(4 * (mask & 0x0F).bit_count())
        if mask & 0x10:
            self.chunk()
        if mask & 0x20:
            self.skip(4)
        if mask & 0x40:
            if depth >= _MAX_DEPTH:
                raise MalformedError
            self.diagnostics(depth + 1)

    def monitored(self, count: int) -> list[tuple[int, Sample]]:
        """Read the notifications of monitored items."""
        return [(self.u32(), self.data_value(0)) for _ in range(count)]

    def data_value(self, depth: int) -> Sample:
        """Read a DataValue."""
        mask = self.u8()
        kind, value, dims = self.variant(depth) if mask & 1 else (0, None, None)
        code = self.u32() if mask & 2 else 0
        source_ns = server_ns = 0
        if mask & 4:
            source_ns = self.time()
        if mask & 0x10:
            self.skip(2)
        if mask & 8:
            server_ns = self.time()
        if mask & 0x20:
            self.skip(2)
        return sample(kind, value, dims, code, _stamp(source_ns) or _stamp(server_ns))

    def variant(self, depth: int) -> tuple[int, Any, tuple[int, ...] | None]:
        """Read a variant; return the number of its built-in type, its value and its dimensions.

        The dimensions may not fit the number of elements: :func:`sample` makes a bad value of that.
        """
        mask = self.u8()
        kind = mask & 0x3F
        if not mask & 0x80:
            return kind, self.value(kind, depth), None
        if not kind:  # an array of nulls takes no bytes, so it could have any length
            raise MalformedError
        values = self.elements(kind, self.count(size_of(kind)), depth)
        dims: tuple[int, ...] = (len(values),)
        if mask & 0x40 and (count := self.count(4)):
            dims = struct.unpack(f"<{count}i", self.take(4 * count))
        return kind, values, dims

    def value(self, kind: int, depth: int) -> Any:
        """Read a value of a built-in type."""
        if kind in _STRUCTS:
            layout = _STRUCTS[kind]
            self.skip(layout.size)
            return layout.unpack_from(self._data, self._at - layout.size)[0]
        return self.scalar(kind, depth)

    def elements(self, kind: int, count: int, depth: int) -> list[Any]:
        """Read values of a built-in type."""
        if kind in _STRUCTS:
            layout = struct.Struct(f"<{count}{_FIXED[kind]}")
            return list(layout.unpack(self.take(layout.size)))
        return [self.scalar(kind, depth) for _ in range(count)]

    def scalar(self, kind: int, depth: int) -> Any:
        """Read a value of a type that has no fixed size."""
        if kind in (STRING, XML):
            return self.text()
        if kind == DATE_TIME:
            return self.time()
        if kind == GUID:
            return str(uuid.UUID(bytes_le=self.take(16)))
        if kind in (NODE_ID, EXPANDED_NODE_ID):
            return _node_text(*self.node_id())
        if kind == QUALIFIED_NAME:
            self.skip(2)
            return self.text()
        if kind == LOCALIZED_TEXT:
            mask = self.u8()
            if mask & 1:
                self.chunk()
            return self.text() if mask & 2 else ""
        if kind == EXTENSION:
            return self.extension()
        if kind == DIAGNOSTICS:
            return self.diagnostics(depth)
        if kind in (DATA_VALUE, VARIANT):
            if depth >= _MAX_DEPTH:
                raise MalformedError
            return self.data_value(depth + 1) if kind == DATA_VALUE else self.variant(depth + 1)
        if kind == BYTE_STRING or 26 <= kind <= 31:
            return self.chunk() or b""
        if kind == 0:
            return None
        raise MalformedError


def sample(kind: int, value: Any, dims: tuple[int, ...] | None, code: int = 0, source_ns: int = 0) -> Sample:
    """Return a sample; it is bad, without a value, if its dimensions do not fit the number of its elements.

    OPC 10000-6, section 5.2.2.16 makes such a value a decoding error. Its length is known all the
    same, so that the rest of the message can be read.
    """
    if dims is not None and not _fit(dims, len(value)):
        return Sample(0, None, None, code if code >> 30 == 2 else BAD_DECODING_ERROR, source_ns)
    return Sample(kind, value, dims, code, source_ns)


def _fit(dims: tuple[int, ...], count: int) -> bool:
    product = int(min(dims) > 0)
    for size in dims:
        product *= size
        if product > count:
            return False
    return product == count


def _stamp(ns: int) -> int:
    """Return a timestamp, or 0 if a status cannot hold it."""
    return ns if 0 < ns <= _LAST_STAMP_NS else 0


def encoded(kind: int, value: Any) -> bytes:
    """Encode a value of a built-in type, as :meth:`Reader.value` returns it.

    Raises:
        ValueError: Values of this type cannot be encoded.

    """
    if kind in _STRUCTS:
        try:
            return _STRUCTS[kind].pack(value)
        except (struct.error, OverflowError):
            raise ValueError(f"{value} does not fit a {NAMES[kind]}") from None
    if kind == DATE_TIME:
        return _TIME.pack(value // 100 + _EPOCH)
    if kind == GUID:
        return uuid.UUID(value).bytes_le
    if kind in (STRING, XML, LOCALIZED_TEXT, BYTE_STRING):
        data = value if kind == BYTE_STRING else value.encode()
        return (b"\2" if kind == LOCALIZED_TEXT else b"") + _INT.pack(len(data)) + data
    raise ValueError(f"a {NAMES[kind]} in a structure cannot be written")


def size_of(kind: int) -> int:
    """Return the minimum size in bytes of a value of a built-in type."""
    return _STRUCTS[kind].size if kind in _STRUCTS else 1


_TEXTS_OF_IDS: Final[dict[int, Callable[[Any], str]]] = {
    3: lambda name: f"s={name}",
    4: lambda data: f"g={uuid.UUID(bytes_le=data)}",
    5: lambda data: f"b={base64.b64encode(data).decode()}",
}


def _node_text(form: int, namespace: int, identifier: int | str | bytes) -> str:
    text = _TEXTS_OF_IDS.get(form, "i={}".format)(identifier)
    return f"ns={namespace};{text}" if namespace else text
