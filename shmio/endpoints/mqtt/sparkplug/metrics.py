"""Registers as metrics of Sparkplug B (Eclipse Sparkplug Specification 3.0.0, 6.4).

===================================  ==========================================================================
BOOL                                 Boolean
SINT, INT, DINT, TIME, S5TIME        Int32
LINT, LTIME, UDINT, DWORD, TOD       Int64
BYTE, USINT; WORD, UINT              UInt8; UInt16
ULINT, LWORD, LTOD                   UInt64
REAL; LREAL                          Float; Double
texts, dates, POINTER, ANY           String
===================================  ==========================================================================

Types on whose field or sign implementations disagree are not used: Int8, Int16 and UInt32. An array of numbers or bits
is one metric, with the array type of its own width; one of anything else is a metric for each element.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from shmio.errors import ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.values.write import elements
from shmio.local.reading import holds_none
from shmio.segment import Quality
from shmio.wire import sparkplug_b_pb2 as wire

INT32: Final = 3
INT64: Final = 4
BOOLEAN: Final = 11
BOOLEANS: Final = 32
_COUNT: Final = struct.Struct("<I")  # of bits, before them
_QUALITY: Final = {Quality.BAD: 0, Quality.UNCERTAIN: 500, Quality.GOOD: 192}  # 6.4.8.1: bad, stale, good


class _Datatype(NamedTuple):
    """Sparkplug's representation of a type: data type and protobuf field of a single value.

    For an array, it also has the data type of the array and of its elements.
    """

    datatype: int
    field: str
    array: int = 0
    element: str = ""


_STRING: Final = _Datatype(12, "string_value")
_DATATYPES: Final[Mapping[str, _Datatype]] = {
    "BOOL": _Datatype(BOOLEAN, "boolean_value", BOOLEANS, "?"),
    "SINT": _Datatype(INT32, "int_value", 22, "<i1"),
    "INT": _Datatype(INT32, "int_value", 23, "<i2"),
    "DINT": _Datatype(INT32, "int_value", 24, "<i4"),
    "TIME": _Datatype(INT32, "int_value", 24, "<i4"),
    "S5TIME": _Datatype(INT32, "int_value", 24, "<i4"),
    "LINT": _Datatype(INT64, "long_value", 25, "<i8"),
    "LTIME": _Datatype(INT64, "long_value", 25, "<i8"),
    "BYTE": _Datatype(5, "int_value", 26, "<u1"),
    "USINT": _Datatype(5, "int_value", 26, "<u1"),
    "WORD": _Datatype(6, "int_value", 27, "<u2"),
    "UINT": _Datatype(6, "int_value", 27, "<u2"),
    "UDINT": _Datatype(INT64, "long_value", 28, "<u4"),
    "DWORD": _Datatype(INT64, "long_value", 28, "<u4"),
    "TIME_OF_DAY": _Datatype(INT64, "long_value", 28, "<u4"),
    "ULINT": _Datatype(8, "long_value", 29, "<u8"),
    "LWORD": _Datatype(8, "long_value", 29, "<u8"),
    "LTOD": _Datatype(8, "long_value", 29, "<u8"),
    "REAL": _Datatype(9, "float_value", 30, "<f4"),
    "LREAL": _Datatype(10, "double_value", 31, "<f8"),
}
_BITS: Final = {INT32: 32, INT64: 64}


class Metric:
    """A metric: a register, or an element of an array.

    ``alias`` is unique in its edge node.
    """

    def __init__(self, register: Register, alias: int) -> None:
        kind = _DATATYPES.get(register.element.base, _STRING)
        self.register = register
        self.name = register.path
        self.alias = alias
        self.datatype = kind.array if register.dims else kind.datatype
        self._field = "bytes_value" if register.dims else kind.field
        self._element = kind.element
        self._bits = 0 if register.dims else _BITS.get(kind.datatype, 0)

    def put(self, metric: wire.Metric, value: Any) -> None:
        """Write a value to a message; None, also as an element, becomes null."""
        data: Any = self._packed(value) if self.register.dims else value
        if data is None:
            metric.is_null = True
        else:
            setattr(metric, self._field, data & ((1 << self._bits) - 1) if self._bits else data)

    def take(self, metric: wire.Metric) -> Any:
        """Read the register's value from a message.

        Raises:
            ValueRangeError: There is no value, or it has the wrong type.

        """
        field = metric.WhichOneof("value")
        if field is None or metric.is_null:
            raise ValueRangeError(f"{self.name}: there is no value")
        value = getattr(metric, field)
        expected = {self._field}
        if self._field in ("int_value", "long_value"):  # clients differ in which
            expected = {"int_value", "long_value"}
        elif self._field in ("float_value", "double_value"):
            expected = {"float_value", "double_value"}
        if field not in expected:
            raise ValueRangeError(f"{self.name}: {field} is not a value of {self.register.type}")
        if self.register.dims:
            return self._unpacked(value)
        bits = 32 if field == "int_value" else 64
        return value - (1 << bits) if self._bits and value >> (bits - 1) else value

    def _packed(self, value: Any) -> bytes | None:
        if holds_none(value):
            return None
        if self.datatype == BOOLEANS:
            flat = np.array(value, bool).reshape(-1)
            return _COUNT.pack(len(flat)) + np.packbits(flat).tobytes()
        return np.array(value, self._element).tobytes()  # by its type at once: no float has all digits of a ULINT

    def _unpacked(self, data: bytes) -> list[Any]:
        count = self.register.count
        if self.datatype == BOOLEANS:
            if len(data) != _COUNT.size + -(-count // 8) or _COUNT.unpack_from(data)[0] != count:
                raise ValueRangeError(f"{self.name}: expected {count} bits after their number")
            flat = np.unpackbits(np.frombuffer(data, np.uint8, offset=_COUNT.size), count=count).astype(bool)
        else:
            if len(data) != count * np.dtype(self._element).itemsize:
                raise ValueRangeError(f"{self.name}: expected all of the array's {count} elements")
            flat = np.frombuffer(data, self._element)
        shaped: list[Any] = flat.reshape(self.register.shape).tolist()
        return shaped


def parts_of(layout: Layout, registers: Iterable[Register], *, single: bool = False) -> Iterator[Register]:
    """Yield the registers, and the elements of arrays, to publish as metrics.

    An array of numbers or bits is one metric; others are split up into their elements.
    ``single``: split up all arrays.
    """
    for register in registers:
        if register.dims and (single or register.element.base not in _DATATYPES):
            yield from elements(layout, register)
        else:
            yield register


def put_quality(metric: wire.Metric, quality: Quality, reason: str) -> None:
    """Add quality and reason to a value; nothing if it is good (6.4.8.1)."""
    if quality is not Quality.GOOD:
        metric.properties.keys.extend(("Quality", "Reason"))
        metric.properties.values.add(type=INT32, int_value=_QUALITY[quality])
        metric.properties.values.add(type=_STRING.datatype, string_value=reason)
