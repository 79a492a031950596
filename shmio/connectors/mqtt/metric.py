"""Decodes and encodes the values of Sparkplug B metrics (Eclipse Sparkplug Specification 3.0.0, 6.4.16)."""

from __future__ import annotations

import math
import struct
from typing import Any, Final

import numpy as np

from shmio.connectors.mqtt.faults import ValueFaultError
from shmio.model.statuses import (
    BAD_DECODING_ERROR,
    BAD_NO_DATA,
    BAD_NOT_SUPPORTED,
    BAD_OUT_OF_RANGE,
    BAD_TYPE_MISMATCH,
)
from shmio.wire import sparkplug_b_pb2 as wire

BOOLEAN: Final = 11
_SIGNED: Final = {1: 8, 2: 16, 3: 32, 4: 64}
_UNSIGNED: Final = {5: 8, 6: 16, 7: 32, 8: 64, 13: 64}  # 13: DateTime, ms since 1970
_FLOAT: Final = 9
_DOUBLE: Final = 10
_TEXTS: Final = frozenset({12, 14, 15})  # String, Text, UUID
_ARRAYS: Final = {
    22: "<i1", 23: "<i2", 24: "<i4", 25: "<i8", 26: "<u1", 27: "<u2", 28: "<u4", 29: "<u8", 30: "<f4", 31: "<f8",
    34: "<u8",
}  # fmt: skip
_BOOLEANS: Final = 32
_STRINGS: Final = 33
_COUNT: Final = struct.Struct("<I")  # the number of bits, which precedes them
_FLOAT32_MAX: Final = 3.4028234663852886e38


def decode(metric: wire.Metric, datatype: int) -> Any:
    """Return the value of a metric as a JSON value.

    Args:
        metric: The metric.
        datatype: The metric's data type, as its birth states it.

    Raises:
        ValueFaultError: The metric has no value, or its value does not fit the data type.

    """
    field = metric.WhichOneof("value")
    if metric.is_null or field is None:
        raise ValueFaultError(BAD_NO_DATA, "the metric is null")
    if metric.datatype not in (0, datatype):
        raise ValueFaultError(
            BAD_TYPE_MISMATCH, f"the metric has data type {metric.datatype}, but its birth has {datatype}"
        )
    found = getattr(metric, field)
    if datatype in _SIGNED or datatype in _UNSIGNED:
        if isinstance(found, int) and not isinstance(found, bool):
            number = _signed(found, _SIGNED[datatype], field) if datatype in _SIGNED else found
            _check_range(number, datatype)
            return number
    elif datatype in (_FLOAT, _DOUBLE):
        if isinstance(found, float):
            return found
    elif datatype == BOOLEAN:
        if isinstance(found, bool):
            return found
    elif datatype in _TEXTS:
        if isinstance(found, str):
            return found
    elif datatype in _ARRAYS or datatype in (_BOOLEANS, _STRINGS):
        if isinstance(found, bytes):
            return _decode_array(found, datatype)
    else:
        raise ValueFaultError(BAD_NOT_SUPPORTED, f"metrics of data type {datatype} cannot be read")
    raise ValueFaultError(
        BAD_DECODING_ERROR, f"the metric has its value in {field}, which data type {datatype} does not use"
    )


def _signed(found: int, bits: int, field: str) -> int:
    """Return the signed number that an unsigned field contains.

    Some implementations of Sparkplug extend a negative number only to the bits of its type, others
    to all bits of the field.
    """
    wide = 32 if field == "int_value" else 64
    if found >> (wide - 1):
        return found - (1 << wide)
    return found - (1 << bits) if found >> (bits - 1) == 1 else found


def _range(datatype: int) -> tuple[int, int]:
    """Return the least and the greatest number of a data type of whole numbers."""
    if datatype in _SIGNED:
        return -(1 << _SIGNED[datatype] - 1), (1 << _SIGNED[datatype] - 1) - 1
    return 0, (1 << _UNSIGNED[datatype]) - 1


def _check_range(number: int, datatype: int) -> None:
    least, most = _range(datatype)
    if not least <= number <= most:
        raise ValueFaultError(BAD_OUT_OF_RANGE, f"{number} does not fit the metric's data type {datatype}")


def _decode_array(data: bytes, datatype: int) -> list[Any]:
    if datatype == _STRINGS:
        if data and not data.endswith(b"\0"):
            raise ValueFaultError(BAD_DECODING_ERROR, "the array of texts does not end in a zero byte")
        try:
            return [one.decode() for one in data.split(b"\0")[:-1]]
        except UnicodeDecodeError:
            raise ValueFaultError(BAD_DECODING_ERROR, "the array contains text that is not UTF-8") from None
    if datatype == _BOOLEANS:
        count = _COUNT.unpack_from(data)[0] if len(data) >= _COUNT.size else -1
        if len(data) != _COUNT.size + -(-count // 8):
            raise ValueFaultError(BAD_DECODING_ERROR, "the array of bits does not have the length that it states")
        bits: list[Any] = (
            np.unpackbits(np.frombuffer(data, np.uint8, offset=_COUNT.size), count=count).astype(bool).tolist()
        )
        return bits
    kind = np.dtype(_ARRAYS[datatype])
    if len(data) % kind.itemsize:
        raise ValueFaultError(BAD_DECODING_ERROR, "the array ends within an element")
    numbers: list[Any] = np.frombuffer(data, kind).tolist()
    return numbers


def encode(metric: wire.Metric, datatype: int, value: Any, field: str | None) -> None:
    """Set the value of a metric in a command.

    Args:
        metric: The metric of the command.
        datatype: The metric's data type, as its birth states it.
        value: The value.
        field: The field of the protobuf message in which the birth had the value; None if unknown.

    Raises:
        ValueError: The value does not fit the data type.

    """
    metric.datatype = datatype
    if datatype in _SIGNED or datatype in _UNSIGNED:
        _encode_whole(metric, datatype, value, field)
    elif datatype in (_FLOAT, _DOUBLE) and _is_number(value):
        if datatype == _DOUBLE:
            metric.double_value = value
        elif math.isfinite(value) and abs(value) > _FLOAT32_MAX:
            raise ValueError(f"{value} does not fit the metric, which is a Float")
        else:
            metric.float_value = value
    elif datatype == BOOLEAN and isinstance(value, bool):
        metric.boolean_value = value
    elif datatype in _TEXTS and isinstance(value, str):
        metric.string_value = value
    elif isinstance(value, list):
        metric.bytes_value = _encode_array(datatype, value)
    else:
        raise ValueError(f"the metric has data type {datatype}, which does not fit the register")


def _encode_whole(metric: wire.Metric, datatype: int, value: Any, field: str | None) -> None:
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool):
        raise ValueError(f"the metric is a whole number (data type {datatype}), but the written value is {value!r}")
    least, most = _range(datatype)
    if not least <= value <= most:
        raise ValueError(f"{value} does not fit the metric, whose range is from {least} to {most}")
    if 64 in (_SIGNED.get(datatype), _UNSIGNED.get(datatype)) or field == "long_value":
        metric.long_value = value & ((1 << 64) - 1)
    else:
        metric.int_value = value & ((1 << 32) - 1)


def _encode_array(datatype: int, value: list[Any]) -> bytes:
    flat = np.array(value).reshape(-1).tolist()
    if datatype == _BOOLEANS and all(isinstance(one, bool) for one in flat):
        return _COUNT.pack(len(flat)) + np.packbits(np.array(flat, bool)).tobytes()
    if datatype == _STRINGS and all(isinstance(one, str) for one in flat):
        return b"".join(one.encode() + b"\0" for one in flat)
    if datatype in _ARRAYS and all(_is_number(one) for one in flat):
        kind = np.dtype(_ARRAYS[datatype])
        packed = np.array(flat).astype(kind)
        if kind.kind != "f" and packed.tolist() != flat:
            raise ValueError(f"the array does not fit the metric (data type {datatype})")
        return packed.tobytes()
    raise ValueError(f"the metric has data type {datatype}, which does not fit the register")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
