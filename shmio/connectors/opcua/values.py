"""Converts values of OPC UA nodes to values of registers, and back.

The conversion depends on the node's type, because servers represent the same type differently. An
S7-1500 represents a DATE as a UInt16, a DATE_AND_TIME as eight bytes and a DTL as a structure; shmio's
own server represents dates as texts. For the mapping of Siemens, see the function manual
"Communication", table "SIMATIC and OPC UA data types".
"""

from __future__ import annotations

import math
import struct
import uuid
from collections.abc import Callable
from typing import Any, Final

from shmio.connectors.opcua import decode as ua
from shmio.connectors.opcua.decode import Extension, Sample
from shmio.errors import ValueRangeError
from shmio.layout.model import INTEGERS, Register
from shmio.layout.values import calendar
from shmio.layout.values.codec import REAL_MAX, Scalar, Value, flatten, nest, scalar_codec

_INTEGERS: Final = {ua.SBYTE: 8, ua.BYTE: 8, ua.INT16: 16, ua.UINT16: 16, ua.INT32: 32, ua.UINT32: 32, ua.INT64: 64,
                    ua.UINT64: 64, ua.STATUS_CODE: 32}  # fmt: skip
_UNSIGNED: Final = frozenset({ua.BYTE, ua.UINT16, ua.UINT32, ua.UINT64, ua.STATUS_CODE})
_FLOATS: Final = frozenset({ua.FLOAT, ua.DOUBLE})
_NUMBERS: Final = _FLOATS | _INTEGERS.keys()
_TEXTS: Final = frozenset({
    ua.STRING, ua.XML, ua.GUID, ua.NODE_ID, ua.EXPANDED_NODE_ID, ua.QUALIFIED_NAME, ua.LOCALIZED_TEXT
})  # fmt: skip
_OF_BYTES: Final = {"DATE_AND_TIME": 8, "POINTER": 6, "ANY": 10}
"""Types that some servers represent as arrays of bytes, with their sizes."""
_AS_NUMBERS: Final = {"S5TIME": ua.UINT16, "CHAR": ua.BYTE, "WCHAR": ua.UINT16}
"""Types whose own format some servers represent as a number, with the type of the number."""
_CHARACTERS: Final = frozenset({"BYTE", "USINT", "CHAR"})
_DTL: Final = struct.Struct("<HBBBBBBI")
_DTL_THERE: Final = struct.Struct(">HBBBBBBI")
_DEFAULTS: Final = {
    "BOOL": ua.BOOLEAN, "BYTE": ua.BYTE, "USINT": ua.BYTE, "SINT": ua.SBYTE, "WORD": ua.UINT16, "UINT": ua.UINT16,
    "INT": ua.INT16, "DWORD": ua.UINT32, "UDINT": ua.UINT32, "DINT": ua.INT32, "LWORD": ua.UINT64, "ULINT": ua.UINT64,
    "LINT": ua.INT64, "REAL": ua.FLOAT, "LREAL": ua.DOUBLE, "TIME": ua.INT32, "LTIME": ua.INT64,
    "TIME_OF_DAY": ua.UINT32, "LTOD": ua.UINT64, "STRING": ua.STRING, "WSTRING": ua.STRING, "LDT": ua.DATE_TIME,
}  # fmt: skip
"""The type that a node without a value is assumed to have, by the register's type, unless servers differ in it."""


class MismatchError(ValueError):
    """The type of a node does not fit its register."""


class ValueConverter:
    """Converts between the values of a node and those of its register."""

    def __init__(self, register: Register) -> None:
        self._register = register
        self._base = register.element.base
        self._kind = -1
        self._element: Callable[[Any], Scalar] | None = None
        self._raw = scalar_codec(register.element, "big") if self._base != "BOOL" else None

    def value(self, sample: Sample) -> Value:
        """Return the register's value for a sample.

        Raises:
            MismatchError: The sample's type does not fit the register.
            ValueRangeError: The register cannot hold the value.

        """
        register = self._register
        kind, found, dims = sample.kind, sample.value, sample.dims
        if kind != self._kind:
            self._kind, self._element = kind, self._converter(kind)
        if not register.dims and dims is None and self._element is not None:
            return self._element(found)
        if kind == ua.BYTE_STRING and dims is None and self._base in _CHARACTERS and register.dims:
            kind, found, dims = ua.BYTE, list(found), (len(found),)
            element = self._converter(ua.BYTE)
        elif self._base in _OF_BYTES and ((kind, dims) == (ua.BYTE_STRING, None) or (kind == ua.BYTE and dims)):
            found, dims = self._groups(bytes(found), dims)
            element = self._bytes
            if not register.dims and len(found) == 1:
                return element(found[0])
        else:
            element = self._element
        if element is None or (dims is None) == bool(register.dims):
            raise MismatchError(f"the node is {_named(sample)}, which does not fit {_type(register)}")
        if len(found) != register.count or (dims and len(dims) > 1 and dims != register.shape):
            raise MismatchError(f"the node is {_named(sample)}, but the register is {_type(register)}")
        return nest([element(one) for one in found], register.shape) if register.dims else element(found[0])

    def _groups(self, data: bytes, dims: tuple[int, ...] | None) -> tuple[list[bytes], tuple[int, ...] | None]:
        """Split bytes into the elements of an array; return them and the array's dimensions."""
        size = _OF_BYTES[self._base]
        if len(data) % size:
            raise MismatchError(f"the node has {len(data)} bytes, which does not fit {_type(self._register)}")
        return [data[at : at + size] for at in range(0, len(data), size)], (dims or ())[:-1] or (len(data) // size,)

    def _bytes(self, data: bytes) -> Scalar:
        return self._decoded(data)

    def _decoded(self, data: bytes) -> Scalar:
        """Decode an element from bytes in the controller's own format."""
        assert self._raw is not None  # noqa: S101 - for the type checker
        value = self._raw.decode(data, 0)
        if value is None:
            raise ValueRangeError(f"{self._base}: {data.hex()} is not a valid value")
        return value

    def _converter(self, kind: int) -> Callable[[Any], Scalar] | None:
        """Return the function that converts an element of node type ``kind``; None if the type does not fit."""
        base, scale = self._base, self._register.scale
        if kind == _AS_NUMBERS.get(base):
            return lambda number: self._decoded(number.to_bytes(self._register.element.size, "big"))
        if base == "BOOL":
            return bool if kind == ua.BOOLEAN else None
        if base in INTEGERS or base in ("REAL", "LREAL"):
            whole = base in INTEGERS
            if kind not in _NUMBERS or (whole and kind in _FLOATS and scale is None):
                return None
            if scale is None:
                return _same
            factor, offset = scale
            return (lambda number: _rounded(number * factor + offset)) if whole else (
                lambda number: float(number * factor + offset)
            )  # fmt: skip
        if base in ("TIME", "LTIME", "TIME_OF_DAY", "LTOD", "S5TIME"):
            if kind in _INTEGERS:
                return _same
            return _rounded if kind in _FLOATS and base == "TIME" else None
        if base in ("STRING", "WSTRING"):
            return str if kind in _TEXTS else None
        if kind == ua.STRING:
            return str
        if kind == ua.DATE_TIME and base in ("DATE", "DATE_AND_TIME", "LDT", "DTL"):
            return self._moment
        if base == "DATE" and kind == ua.UINT16:
            return lambda days: calendar.format_day(calendar.DATE_EPOCH_DAYS + days)
        if base == "DTL" and kind == ua.EXTENSION:
            return self._dtl
        return None

    def _moment(self, ns: int) -> str:
        if ns < 0:
            raise ValueRangeError(f"{self._base}: the time is before 1970")
        if self._base == "DATE":
            return calendar.format_day(ns // calendar.NS_PER_DAY)
        return calendar.format_moment(ns, 3 if self._base == "DATE_AND_TIME" else 9)

    def _dtl(self, found: Extension) -> Scalar:
        if len(found.body) != _DTL.size:
            raise MismatchError(f"the node is a structure of {len(found.body)} bytes, but a DTL has {_DTL.size}")
        return self._decoded(_DTL_THERE.pack(*_DTL.unpack(found.body)))

    # -- writing -------------------------------------------------------------------------------------------------------

    def sample(self, value: Value, like: Sample | None) -> Sample:
        """Convert a whole value of the register to the node's type.

        Args:
            value: The value.
            like: The last value of the node; None if there is none.

        Raises:
            ValueError: The node cannot hold the value, or its type is unknown.

        """
        register = self._register
        flat: list[Any] = list(flatten(value, register.shape, register.path)) if register.dims else [value]
        kind = like.kind if like is not None and like.kind else _DEFAULTS.get(self._base, 0)
        if not kind:
            raise ValueError(f"the node has no value yet, so the type to write for a {register.type} is unknown")
        if self._base in _OF_BYTES and kind in (ua.BYTE, ua.BYTE_STRING):
            data = b"".join(self._encoded(one) for one in flat)
            dims = None if kind == ua.BYTE_STRING else (len(data),) if not register.dims else (*register.shape, 8)
            return Sample(kind, data if kind == ua.BYTE_STRING else list(data), dims, 0, 0)
        if kind == ua.BYTE_STRING and self._base in _CHARACTERS:
            return Sample(kind, b"".join(self._encoded(one) for one in flat), None, 0, 0)
        there = [self._there(one, kind, like) for one in flat]
        return Sample(kind, there if register.dims else there[0], self.shape(like) if register.dims else None, 0, 0)

    def shape(self, like: Sample | None) -> tuple[int, ...]:
        """Return the sizes of the node's dimensions: some servers have one dimension for all elements."""
        known = like.dims if like is not None else None
        return known if known is not None and len(known) == 1 else self._register.shape

    def elements(self, values: list[Any], like: Sample | None) -> Sample:
        """Convert consecutive elements of an array to the node's type. Raise ValueError if this is impossible."""
        kind = like.kind if like is not None and like.kind else _DEFAULTS.get(self._base, 0)
        if not kind or kind == ua.BYTE_STRING or self._base in _OF_BYTES:
            raise ValueError("the node has no single elements; write the whole array")
        return Sample(kind, [self._there(one, kind, like) for one in values], (len(values),), 0, 0)

    def _encoded(self, value: Any) -> bytes:
        assert self._raw is not None  # noqa: S101 - for the type checker
        return self._raw.encode(value)

    def _there(self, value: Any, kind: int, like: Sample | None) -> Any:
        """Convert an element to a node's type."""
        base, scale = self._base, self._register.scale
        if kind == ua.BOOLEAN and base == "BOOL":
            return bool(value)
        if kind == _AS_NUMBERS.get(base):
            return int.from_bytes(self._encoded(value), "big")
        if base == "DATE" and kind == ua.UINT16:
            return (calendar.parse_moment(value) or 0) // calendar.NS_PER_DAY - calendar.DATE_EPOCH_DAYS
        if base == "DTL" and kind == ua.EXTENSION and like is not None:
            known = like.value[0] if isinstance(like.value, list) else like.value
            return Extension(known.encoding, _DTL.pack(*_DTL_THERE.unpack(self._encoded(value))))
        if kind == ua.DATE_TIME and isinstance(value, str) and (ns := calendar.parse_moment(value)) is not None:
            if ns % 1000:
                raise ValueError(f"{value} is too precise; only whole microseconds can be written")
            return ns
        if kind in (ua.STRING, ua.LOCALIZED_TEXT, ua.XML) and isinstance(value, str):
            return value
        if kind == ua.GUID and isinstance(value, str):
            return _guid(value)
        if kind not in _NUMBERS or not isinstance(value, int | float) or isinstance(value, bool):
            raise ValueError(f"a {self._register.type} cannot be written to a node of type {ua.NAMES[kind]}")
        number = value if scale is None else (value - scale[1]) / scale[0]
        if kind in _FLOATS:
            if kind == ua.FLOAT and math.isfinite(number) and abs(number) > REAL_MAX:
                raise ValueError(f"{number} does not fit the node's {ua.NAMES[kind]}")
            return float(number)
        return _whole(number, kind)


def _guid(text: str) -> str:
    try:
        return str(uuid.UUID(text))
    except ValueError:
        raise ValueError(f"{text!r} is not a Guid, which has 32 hexadecimal digits") from None


def _same(value: Any) -> Scalar:
    return value


def _rounded(number: float) -> Scalar:
    if not math.isfinite(number):
        raise ValueRangeError(f"{number} is not a whole number")
    return round(number)


def _whole(number: float, kind: int) -> int:
    bits = _INTEGERS[kind]
    least, most = (0, (1 << bits) - 1) if kind in _UNSIGNED else (-(1 << bits - 1), (1 << bits - 1) - 1)
    if not math.isfinite(number) or not least <= round(number) <= most:
        raise ValueError(f"{number} does not fit the node's {ua.NAMES[kind]}")
    return round(number)


def _named(sample: Sample) -> str:
    name = ua.NAMES[sample.kind] if sample.kind < len(ua.NAMES) else f"type {sample.kind}"
    return name if sample.dims is None else f"{name}[{','.join(map(str, sample.dims))}]"


def _type(register: Register) -> str:
    return register.type + (f"[{','.join(map(str, register.shape))}]" if register.dims else "")
