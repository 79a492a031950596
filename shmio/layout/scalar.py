"""One element of each type: bytes to a Python value and back, exact and range-checked.

===================================  ==========================================================================
BOOL                                 bool
BYTE … LWORD, SINT … ULINT           int
REAL, LREAL                          float
CHAR, STRING                         str, ISO 8859-1, so that every byte has its character
WCHAR, WSTRING                       str, UTF-16; a lone surrogate reads as U+FFFD
TIME, S5TIME                         int, milliseconds
LTIME                                int, nanoseconds
TIME_OF_DAY                          int, milliseconds since midnight
LTOD                                 int, nanoseconds since midnight
DATE                                 str, ``2024-02-29``
DATE_AND_TIME                        str, ``2024-02-29T12:34:56.789``
LDT, DTL                             str, ``2024-02-29T12:34:56.123456789``
POINTER, ANY                         str, the bytes in hexadecimal
===================================  ==========================================================================

Bytes that are no value of the type (a month 13, a BCD digit above 9, a STRING longer than its maximum) decode
to None: a controller may hold such bytes, and one register must not spoil a frame. Encoding never writes them.

Formats: Siemens, "STEP 7 Professional", chapter "Data types".
"""

from __future__ import annotations

import math
import operator
import struct
from collections.abc import Callable
from typing import Any, Protocol

from shmio.errors import ValueRangeError
from shmio.layout import calendar
from shmio.layout.types import ElementType

Scalar = bool | int | float | str | None
Buffer = bytes | bytearray | memoryview

MAX_TOD_MS = 86_399_999
MAX_LTOD_NS = calendar.NS_PER_DAY - 1
_S5_BASES_MS = (10, 100, 1000, 10_000)


class ScalarCodec(Protocol):
    """One element. ``plain`` is the struct format when the value is just that, else empty."""

    plain: str

    def decode(self, data: Buffer, offset: int) -> Scalar:
        """Return the value at a byte offset, None for bytes that are none of the type."""

    def encode(self, value: object) -> bytes:
        """Return the element's bytes; raises ValueRangeError."""


class _Number:
    """Integers, also those that count milliseconds or nanoseconds, and floats."""

    def __init__(self, name: str, order: str, code: str, limit: int | None = None) -> None:
        self.plain = code if limit is None else ""
        self._name = name
        self._struct = struct.Struct(order + code)
        self._limit = limit
        self._convert: Callable[[object, str], float] = to_float if code in "fd" else to_int

    def decode(self, data: Buffer, offset: int) -> float | None:
        value: float = self._struct.unpack_from(data, offset)[0]
        return value if self._limit is None or value <= self._limit else None

    def encode(self, value: object) -> bytes:
        number = self._convert(value, self._name)
        try:
            if self._limit is None or number <= self._limit:
                return self._struct.pack(number)
        except (struct.error, OverflowError):
            pass
        raise out_of_range(value, self._name)


class _Text:
    """CHAR and WCHAR: exactly one character, one code unit."""

    plain = ""

    def __init__(self, name: str, encoding: str, size: int) -> None:
        self._name, self._encoding, self._size = name, encoding, size

    def decode(self, data: Buffer, offset: int) -> str:
        return bytes(data[offset : offset + self._size]).decode(self._encoding, "replace")

    def encode(self, value: object) -> bytes:
        data = encode_text(value, self._encoding, self._name)
        if len(data) != self._size:
            raise ValueRangeError(f"{self._name}: expected one character, found {brief(value)}")
        return data


class _String:
    """STRING and WSTRING: greatest length, actual length, characters."""

    plain = ""

    def __init__(self, element: ElementType, order: str, encoding: str, unit: int) -> None:
        self._name, self._length, self._size = element.name, element.length, element.size
        self._head = struct.Struct(order + ("BB" if unit == 1 else "HH"))
        self._encoding, self._unit = encoding, unit

    def decode(self, data: Buffer, offset: int) -> str | None:
        # The declared length rules: the greatest length in the data is 0 until the controller has set it.
        actual = self._head.unpack_from(data, offset)[1]
        if actual > self._length:
            return None
        start = offset + self._head.size
        return bytes(data[start : start + actual * self._unit]).decode(self._encoding, "replace")

    def encode(self, value: object) -> bytes:
        text = encode_text(value, self._encoding, self._name)
        actual = len(text) // self._unit
        if actual > self._length:
            raise ValueRangeError(f"{self._name}: {actual} characters do not fit")
        return (self._head.pack(self._length, actual) + text).ljust(self._size, b"\0")


class _S5Time:
    """A BCD number of 0-999 and a time base in the bits 12 and 13."""

    plain = ""

    def __init__(self, order: str) -> None:
        self._struct = struct.Struct(order + "H")

    def decode(self, data: Buffer, offset: int) -> int | None:
        word = self._struct.unpack_from(data, offset)[0]
        count = from_bcd(word >> 8 & 0xF, word & 0xFF)
        return None if count is None else count * _S5_BASES_MS[word >> 12 & 3]

    def encode(self, value: object) -> bytes:
        ms = to_int(value, "S5TIME")
        for code, base in enumerate(_S5_BASES_MS):  # the finest base that can hold it
            if 0 <= ms <= 999 * base and ms % base == 0:
                return self._struct.pack(code << 12 | int(str(ms // base), 16))
        if 0 <= ms <= 9_990_000:
            raise ValueRangeError(f"S5TIME: {ms} ms needs more than three digits of any time base")
        raise out_of_range(value, "S5TIME")


class _Moment:
    """DATE, DATE_AND_TIME, LDT and DTL: ISO text outside, one of four formats inside."""

    plain = ""

    def __init__(
        self,
        name: str,
        bounds_ns: tuple[int, int],
        step_ns: int,
        to_ns: Callable[[Buffer, int], int | None],
        from_ns: Callable[[int], bytes],
    ) -> None:
        self._name, self._bounds, self._step = name, bounds_ns, step_ns
        self._to_ns, self._from_ns = to_ns, from_ns
        self._digits = {calendar.NS_PER_MS: 3, 1: 9}.get(step_ns)

    def decode(self, data: Buffer, offset: int) -> str | None:
        ns = self._to_ns(data, offset)
        if ns is None or not self._bounds[0] <= ns <= self._bounds[1]:
            return None
        if self._digits is None:
            return calendar.format_day(ns // calendar.NS_PER_DAY)
        return calendar.format_moment(ns, self._digits)

    def encode(self, value: object) -> bytes:
        ns = calendar.parse_moment(value) if isinstance(value, str) else None
        if ns is None:
            example = "2024-02-29" + ("" if self._digits is None else "T12:34:56.789")
            raise ValueRangeError(f"{self._name}: expected text such as {example!r}, found {brief(value)}")
        if not self._bounds[0] <= ns <= self._bounds[1] or ns % self._step:
            raise out_of_range(value, self._name)
        return self._from_ns(ns)


class _Opaque:
    """POINTER and ANY: hexadecimal text."""

    plain = ""

    def __init__(self, element: ElementType) -> None:
        self._name, self._size = element.name, element.size

    def decode(self, data: Buffer, offset: int) -> str:
        return bytes(data[offset : offset + self._size]).hex()

    def encode(self, value: object) -> bytes:
        try:
            data = bytes.fromhex(value) if isinstance(value, str) else b""
        except ValueError:
            data = b""
        if len(data) != self._size:
            raise ValueRangeError(f"{self._name}: expected {self._size} bytes in hexadecimal, found {brief(value)}")
        return data


# -- the four formats of a moment ----------------------------------------------------------------------------


def date_to_ns(unpack: struct.Struct) -> Callable[[Buffer, int], int]:
    """DATE: 16 bits, days since 1990-01-01."""
    return lambda data, at: (unpack.unpack_from(data, at)[0] + calendar.DATE_EPOCH_DAYS) * calendar.NS_PER_DAY


def date_from_ns(pack: struct.Struct) -> Callable[[int], bytes]:
    """DATE, the other way."""
    return lambda ns: pack.pack(ns // calendar.NS_PER_DAY - calendar.DATE_EPOCH_DAYS)


def dt_to_ns(data: Buffer, offset: int) -> int | None:
    """DATE_AND_TIME: BCD bytes year, month, day, hour, minute, second, ms; the last half-byte is the weekday."""
    digits = [from_bcd(0, byte) for byte in data[offset : offset + 7]]
    last = data[offset + 7] >> 4
    if None in digits or last > 9:
        return None
    year, month, day, hour, minute, second, hundredths = (digit or 0 for digit in digits)
    date_days = calendar.days(year + (1900 if year >= 90 else 2000), month, day)
    if date_days is None or hour > 23 or minute > 59 or second > 59:
        return None
    ms = ((hour * 60 + minute) * 60 + second) * 1000 + hundredths * 10 + int(last)
    return int(date_days * calendar.NS_PER_DAY + ms * calendar.NS_PER_MS)


def dt_from_ns(ns: int) -> bytes:
    """DATE_AND_TIME, the other way."""
    text = calendar.format_moment(ns, 3)  # 2024-02-29T12:34:56.789
    digits = text[2:].translate(str.maketrans("", "", "-T:."))
    return bytes.fromhex(f"{digits}{calendar.weekday(ns)}")


def dtl_to_ns(layout: struct.Struct) -> Callable[[Buffer, int], int | None]:
    """DTL: UINT year; USINT month, day, weekday, hour, minute, second; UDINT nanosecond."""

    def decode(data: Buffer, offset: int) -> int | None:
        year, month, day, _, hour, minute, second, ns = layout.unpack_from(data, offset)
        date_days = calendar.days(year, month, day)
        if date_days is None or hour > 23 or minute > 59 or second > 59 or ns >= calendar.NS_PER_SECOND:
            return None
        seconds = (hour * 60 + minute) * 60 + second
        return int((date_days * 86_400 + seconds) * calendar.NS_PER_SECOND + ns)

    return decode


def dtl_from_ns(layout: struct.Struct) -> Callable[[int], bytes]:
    """DTL, the other way."""

    def encode(ns: int) -> bytes:
        text = calendar.format_moment(ns, 0)
        year, month, day, hour, minute, second = (
            int(text[a:b]) for a, b in ((0, 4), (5, 7), (8, 10), (11, 13), (14, 16), (17, 19))
        )
        rest = ns % calendar.NS_PER_SECOND
        return layout.pack(year, month, day, calendar.weekday(ns), hour, minute, second, rest)

    return encode


# -- choosing ------------------------------------------------------------------------------------------------

_CODES = {
    "BYTE": "B",
    "WORD": "H",
    "DWORD": "I",
    "LWORD": "Q",
    "USINT": "B",
    "UINT": "H",
    "UDINT": "I",
    "ULINT": "Q",
    "SINT": "b",
    "INT": "h",
    "DINT": "i",
    "LINT": "q",
    "REAL": "f",
    "LREAL": "d",
    "TIME": "i",
    "LTIME": "q",
}


def scalar_codec(element: ElementType, byte_order: str = "big") -> ScalarCodec:
    """Return the codec of one element of any type but BOOL, which is not whole bytes."""
    base, order = element.base, ">" if byte_order == "big" else "<"
    utf16 = "utf-16-be" if byte_order == "big" else "utf-16-le"
    if base in _CODES:
        return _Number(base, order, _CODES[base])
    factories: dict[str, Callable[[], ScalarCodec]] = {
        "TIME_OF_DAY": lambda: _Number(base, order, "I", MAX_TOD_MS),
        "LTOD": lambda: _Number(base, order, "Q", MAX_LTOD_NS),
        "CHAR": lambda: _Text(base, "latin-1", 1),
        "WCHAR": lambda: _Text(base, utf16, 2),
        "STRING": lambda: _String(element, order, "latin-1", 1),
        "WSTRING": lambda: _String(element, order, utf16, 2),
        "S5TIME": lambda: _S5Time(order),
        "DATE": lambda: _date(order),
        "DATE_AND_TIME": lambda: _Moment(
            base, (calendar.FIRST_DT_NS, calendar.LAST_DT_NS), calendar.NS_PER_MS, dt_to_ns, dt_from_ns
        ),
        "LDT": lambda: _ldt(order),
        "DTL": lambda: _dtl(order),
        "POINTER": lambda: _Opaque(element),
        "ANY": lambda: _Opaque(element),
    }
    return factories[base]()


def _date(order: str) -> _Moment:
    form = struct.Struct(order + "H")
    first = calendar.FIRST_DT_NS
    bounds = (first, first + 0xFFFF * calendar.NS_PER_DAY)
    return _Moment("DATE", bounds, calendar.NS_PER_DAY, date_to_ns(form), date_from_ns(form))


def _ldt(order: str) -> _Moment:
    form = struct.Struct(order + "q")
    return _Moment("LDT", (0, calendar.LAST_NS), 1, lambda data, at: int(form.unpack_from(data, at)[0]), form.pack)


def _dtl(order: str) -> _Moment:
    form = struct.Struct(order + "HBBBBBBI")
    return _Moment("DTL", (0, calendar.LAST_NS), 1, dtl_to_ns(form), dtl_from_ns(form))


# -- checks that several share -------------------------------------------------------------------------------


def to_int(value: object, name: str) -> int:
    """Return a whole number; a float without fraction is one, a bool is none.

    Raises ValueRangeError: it is not.
    """
    if not isinstance(value, bool):
        if isinstance(value, float) and value.is_integer():
            return int(value)
        try:
            return operator.index(value)  # type: ignore[arg-type]  # the attempt is the check
        except TypeError:
            pass
    raise ValueRangeError(f"{name}: expected a whole number, found {brief(value)}")


def to_float(value: object, name: str) -> float:
    """Return a float; whole numbers are taken, bools are not.

    Raises ValueRangeError: not a number, or too large.
    """
    number: Any = value
    if isinstance(value, bool | str | bytes) or not hasattr(value, "__float__"):
        raise ValueRangeError(f"{name}: expected a number, found {brief(value)}")
    try:
        return float(number)
    except OverflowError:
        raise out_of_range(value, name) from None


def to_bool(value: object, name: str) -> bool:
    """Return a bool; 0 and 1 are taken.

    Raises ValueRangeError: it is neither.
    """
    if isinstance(value, bool) or (not isinstance(value, str) and value in (0, 1)):
        return bool(value)
    raise ValueRangeError(f"{name}: expected true or false, found {brief(value)}")


def encode_text(value: object, encoding: str, name: str) -> bytes:
    """Return text in the type's encoding.

    Raises ValueRangeError: not text, or with a character the encoding has not.
    """
    if not isinstance(value, str):
        raise ValueRangeError(f"{name}: expected text, found {brief(value)}")
    try:
        return value.encode(encoding)
    except UnicodeEncodeError as error:
        raise ValueRangeError(f"{name}: cannot hold the character {value[error.start]!r}") from None


def from_bcd(hundreds: int, byte: int) -> int | None:
    """Return the number of two BCD digits and a third before them, None if one is above 9."""
    tens, ones = byte >> 4, byte & 0xF
    return None if max(hundreds, tens, ones) > 9 else int(hundreds * 100 + tens * 10 + ones)


def out_of_range(value: object, name: str) -> ValueRangeError:
    """Return the error for a value outside the type's range."""
    return ValueRangeError(f"{name}: {brief(value)} is out of range")


def brief(value: object) -> str:
    """Return a value's text, short enough for a message; a huge integer is not converted."""
    if isinstance(value, int) and not -(1 << 128) < value < 1 << 128:
        return f"an integer of {math.ceil(value.bit_length() / 8)} bytes"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:59]}…"
