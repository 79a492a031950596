"""Convert registers between a frame's bytes and Python values, with range checks.

===================================  ==========================================================================
BOOL                                 bool
BYTE … LWORD, SINT … ULINT           int
REAL, LREAL                          float
CHAR, STRING                         str, in the register's encoding; every byte has a character, or a stand-in
WCHAR, WSTRING                       str, UTF-16; a lone surrogate has a stand-in
TIME, S5TIME                         int, milliseconds
LTIME                                int, nanoseconds
TIME_OF_DAY                          int, milliseconds since midnight
LTOD                                 int, nanoseconds since midnight
DATE                                 str, ``2024-02-29``
DATE_AND_TIME                        str, ``2024-02-29T12:34:56.789``
LDT, DTL                             str, ``2024-02-29T12:34:56.123456789``
POINTER, ANY                         str, the bytes in hexadecimal
===================================  ==========================================================================

An array is a list; with several dimensions, a list of lists.

Bytes that are not a valid value of the type (month 13, a BCD digit above 9, a STRING longer than
its maximum) decode to None. A controller may hold such bytes, and one bad register must not make a
whole frame unreadable. Encoding never creates such bytes.

Formats: Siemens, "STEP 7 Professional", chapter "Data types".
"""

from __future__ import annotations

import math
import operator
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from typing import Any, Protocol

from shmio.errors import CharacterError, ValueRangeError
from shmio.layout.encodings import TextEncoding, text_encoding
from shmio.layout.model import ByteOrder, ElementType, Register, bit_positions
from shmio.layout.values import calendar
from shmio.wording import brief, counted

Buffer = bytes | bytearray | memoryview
Scalar = bool | int | float | str | None
Value = Scalar | list["Value"]
REAL_MAX = 3.4028235e38  # greatest 32-bit float, in as few digits as possible
MAX_TOD_MS = 86_399_999
MAX_LTOD_NS = calendar.NS_PER_DAY - 1
_MAX_S5_MS = 9_990_000
_S5_BASES_MS = (10, 100, 1000, 10_000)


class ScalarCodec(Protocol):
    """Decodes and encodes one element.

    ``plain`` is a format of ``struct`` if unpacking with it is all that decoding takes; else it is
    empty.
    """

    plain: str

    def decode(self, data: Buffer, offset: int) -> Scalar:
        """Return the value at a byte offset, or None for bytes that are not a valid value."""

    def encode(self, value: object) -> bytes:
        """Return the element's bytes; raise ValueRangeError if the value does not fit the type."""


class RegisterCodec(Protocol):
    """Decodes and encodes one register of a frame; ``codec`` returns it."""

    def decode(self, data: Buffer) -> Value:
        """Return the register's value in a frame. Elements, or a scalar, whose bytes are invalid become None."""

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        """Write the value into a frame; after an error the frame is unchanged.

        Raises:
            ValueRangeError: The value does not fit the type, or an array has the wrong shape.
        """


# -- registers -----------------------------------------------------------------------------------------------


@lru_cache(maxsize=65_536)
def codec(register: Register, byte_order: ByteOrder = "big") -> RegisterCodec:
    """Return the codec of a register. Results are cached."""
    if register.type == "BOOL":
        return _BoolArray(register) if register.dims else _Bool(register)
    if register.dims:
        return _Array(register, byte_order)
    return (_SingleNumber if register.type in _CODES else _Single)(register, byte_order)


class _Bool:
    """Codec of a single BOOL."""

    def __init__(self, register: Register) -> None:
        self._offset, self._mask = register.offset, 1 << (register.bit or 0)

    def decode(self, data: Buffer) -> bool:
        return bool(data[self._offset] & self._mask)

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        if to_bool(value, "BOOL"):
            frame[self._offset] |= self._mask
        else:
            frame[self._offset] &= ~self._mask


class _Single:
    """Codec of a scalar of any type except BOOL."""

    def __init__(self, register: Register, byte_order: ByteOrder) -> None:
        self._scalar = scalar_codec(register.element, byte_order)
        self._offset, self._stop = register.offset, register.offset + register.size

    def decode(self, data: Buffer) -> Scalar:
        return self._scalar.decode(data, self._offset)

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        frame[self._offset : self._stop] = self._scalar.encode(value)


class _SingleNumber(_Single):
    """Codec of a scalar number, which most registers are: it encodes most values without calling another codec."""

    def __init__(self, register: Register, byte_order: ByteOrder) -> None:
        super().__init__(register, byte_order)
        code = _CODES[register.type]
        self._pack = struct.Struct((">" if byte_order == "big" else "<") + code).pack
        self._native = float if code in "fd" else int

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        if type(value) is self._native:
            try:
                frame[self._offset : self._stop] = self._pack(value)
                return
            except (struct.error, OverflowError):  # the other codec raises its error
                pass
        super().encode_into(value, frame)


class _Array:
    """Codec of an array of any type except BOOL; it unpacks numbers all at once."""

    def __init__(self, register: Register, byte_order: ByteOrder) -> None:
        element = register.element
        self._name, self._shape = register.path, register.shape
        self._scalar = scalar_codec(element, byte_order)
        self._offset, self._stop = register.offset, register.offset + register.size
        self._size = element.size
        self._starts = range(0, register.count * element.stride, element.stride)
        order = ">" if byte_order == "big" else "<"
        self._bulk = struct.Struct(f"{order}{register.count}{self._scalar.plain}") if self._scalar.plain else None
        self._row = self._bulk if len(self._shape) == 1 else None

    def decode(self, data: Buffer) -> list[Value]:
        flat: list[Value]
        if self._bulk is not None:
            flat = list(self._bulk.unpack_from(data, self._offset))
        else:
            flat = [self._scalar.decode(data, self._offset + start) for start in self._starts]
        return nest(flat, self._shape)

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        if self._row is not None and isinstance(value, list | tuple) and {float, int}.issuperset(map(type, value)):
            with suppress(struct.error, OverflowError):  # the loop below finds the wrong element and raises its error
                frame[self._offset : self._stop] = self._row.pack(*value)
                return
        image = bytearray(frame[self._offset : self._stop])
        for start, item in zip(self._starts, flatten(value, self._shape, self._name), strict=True):
            image[start : start + self._size] = self._scalar.encode(item)
        frame[self._offset : self._stop] = image


class _BoolArray:
    """Codec of an array of BOOL, which has eight bits in a byte and begins each row at a new byte."""

    def __init__(self, register: Register) -> None:
        self._name, self._shape = register.path, register.shape
        self._offset, self._stop = register.offset, register.offset + register.size
        self._places = [(byte, 1 << bit) for byte, bit in bit_positions(register)]

    def decode(self, data: Buffer) -> list[Value]:
        image = bytes(data[self._offset : self._stop])
        return nest([image[byte] & mask != 0 for byte, mask in self._places], self._shape)

    def encode_into(self, value: object, frame: bytearray | memoryview) -> None:
        image = bytearray(frame[self._offset : self._stop])
        for (byte, mask), item in zip(self._places, flatten(value, self._shape, self._name), strict=True):
            if to_bool(item, "BOOL"):
                image[byte] |= mask
            else:
                image[byte] &= ~mask
        frame[self._offset : self._stop] = image


def nest(flat: list[Value], shape: tuple[int, ...]) -> list[Value]:
    """Return a flat list as nested lists with the lengths ``shape``; the last index varies fastest."""
    for length in reversed(shape[1:]):
        flat = [flat[start : start + length] for start in range(0, len(flat), length)]
    return flat


def flatten(value: object, shape: tuple[int, ...], name: str) -> Iterator[object]:
    """Yield the elements of nested lists; the last index varies fastest.

    Raises:
        ValueRangeError: The lists do not have this shape.
    """
    if not shape:
        yield value
        return
    if not isinstance(value, list | tuple) or len(value) != shape[0]:
        found = f"{len(value)}" if isinstance(value, list | tuple) else brief(value)
        raise ValueRangeError(f"{name}: expected a list of {shape[0]} elements, found {found}")
    for item in value:
        yield from flatten(item, shape[1:], name)


def unfold(found: list[Any], shape: tuple[int, ...]) -> list[Any]:
    """Return the elements of a device's array, which is flat, or nested with exactly the lengths ``shape``.

    Raises:
        ValueRangeError: The array has another shape.
    """
    if len(shape) > 1 and any(isinstance(one, list) for one in found):
        return list(flatten(found, shape, "the array has another shape"))
    if len(found) != math.prod(shape):
        raise ValueRangeError(f"the array has {len(found)} elements, but the register has {math.prod(shape)}")
    return found


# -- single elements -----------------------------------------------------------------------------------------


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
    """Return the codec of one element of any type except BOOL."""
    base, order = element.base, ">" if byte_order == "big" else "<"
    utf16 = text_encoding("utf-16-be" if byte_order == "big" else "utf-16-le")
    if base in _CODES:
        return _Number(base, order, _CODES[base])
    factories: dict[str, Callable[[], ScalarCodec]] = {
        "TIME_OF_DAY": lambda: _Number(base, order, "I", MAX_TOD_MS),
        "LTOD": lambda: _Number(base, order, "Q", MAX_LTOD_NS),
        "CHAR": lambda: _Text(base, text_encoding(element.encoding), 1),
        "WCHAR": lambda: _Text(base, utf16, 2),
        "STRING": lambda: _String(element, order, text_encoding(element.encoding), 1),
        "WSTRING": lambda: _String(element, order, utf16, 2),
        "S5TIME": lambda: _S5Time(order),
        **dict.fromkeys(("DATE", "DATE_AND_TIME", "LDT", "DTL"), lambda: _moment_codec(base, order)),
        "POINTER": lambda: _Opaque(element),
        "ANY": lambda: _Opaque(element),
    }
    return factories[base]()


class _Number:
    """Codec of floats and integers, including times in milliseconds or nanoseconds."""

    def __init__(self, name: str, order: str, code: str, limit: int | None = None) -> None:
        self.plain = code if limit is None else ""
        self._name, self._code = name, code
        self._struct = struct.Struct(order + code)
        self._limit = limit
        self._convert: Callable[[object, str], float] = _to_float if code in "fd" else _to_int
        self._native = frozenset({int, float} if code in "fd" else {int})  # types that need no conversion

    def decode(self, data: Buffer, offset: int) -> float | None:
        value: float = self._struct.unpack_from(data, offset)[0]
        return value if self._limit is None or value <= self._limit else None

    def encode(self, value: Any) -> bytes:
        try:
            number = value if type(value) in self._native else self._convert(value, self._name)
            if self._limit is None or number <= self._limit:
                return self._struct.pack(number)
        except (struct.error, OverflowError):
            pass
        raise out_of_range(value, self._name, *bounds(self._code, self._limit))


def bounds(code: str, limit: int | None = None) -> tuple[float, float]:
    """Return the least and the greatest number that a ``struct`` code can hold; the greatest is at most ``limit``."""
    if code in "fd":
        most = REAL_MAX if code == "f" else sys.float_info.max
        return -most, most
    bits = 8 * struct.calcsize(f"={code}")
    least, most = (-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1)
    return least, most if limit is None else limit


class _Text:
    """Codec of CHAR and WCHAR, which hold one character in one code unit."""

    plain = ""

    def __init__(self, name: str, encoding: TextEncoding, size: int) -> None:
        self._name, self._encoding, self._size = name, encoding, size

    def decode(self, data: Buffer, offset: int) -> str:
        return self._encoding.decode(bytes(data[offset : offset + self._size]))

    def encode(self, value: object) -> bytes:
        data = encode_text(value, self._encoding, self._name)
        if len(data) != self._size:
            size = counted(self._size, "byte")
            raise ValueRangeError(
                f"{self._name}: expected one character of {size} in {self._encoding.name}, found {brief(value)}"
            )
        return data


class _String:
    """Codec of STRING and WSTRING, which hold a maximum length, the actual length, and characters."""

    plain = ""

    def __init__(self, element: ElementType, order: str, encoding: TextEncoding, unit: int) -> None:
        self._name, self._length, self._size = element.name, element.length, element.size
        self._head = struct.Struct(order + ("BB" if unit == 1 else "HH"))
        self._encoding, self._unit = encoding, unit

    def decode(self, data: Buffer, offset: int) -> str | None:
        # Use the declared length, because the maximum length in the data is 0 until the controller
        # sets it.
        actual = self._head.unpack_from(data, offset)[1]
        if actual > self._length:
            return None
        start = offset + self._head.size
        return self._encoding.decode(bytes(data[start : start + actual * self._unit]))

    def encode(self, value: object) -> bytes:
        text = encode_text(value, self._encoding, self._name)
        actual = len(text) // self._unit
        if actual > self._length:
            units = "bytes" if self._unit == 1 else "units of UTF-16"
            what = "characters" if actual == len(str(value)) else units
            raise ValueRangeError(f"{self._name}: the text has {actual} {what}, but at most {self._length} are allowed")
        return (self._head.pack(self._length, actual) + text).ljust(self._size, b"\0")


class _S5Time:
    """Codec of S5TIME, which holds a BCD number of 0-999, and a time base in bits 12 and 13."""

    plain = ""

    def __init__(self, order: str) -> None:
        self._struct = struct.Struct(order + "H")

    def decode(self, data: Buffer, offset: int) -> int | None:
        word = self._struct.unpack_from(data, offset)[0]
        count = _from_bcd(word >> 8 & 0xF, word & 0xFF)
        return None if count is None else count * _S5_BASES_MS[word >> 12 & 3]

    def encode(self, value: object) -> bytes:
        ms = _to_int(value, "S5TIME")
        for code, base in enumerate(_S5_BASES_MS):  # the finest base that fits
            if 0 <= ms <= 999 * base and ms % base == 0:
                return self._struct.pack(code << 12 | int(str(ms // base), 16))
        if 0 <= ms <= _MAX_S5_MS:
            raise ValueRangeError(f"S5TIME: {ms} ms cannot be stored exactly, because an S5TIME has three digits")
        raise out_of_range(value, "S5TIME", 0, _MAX_S5_MS)


class _Opaque:
    """Codec of POINTER and ANY; their values are hexadecimal text."""

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


# -- dates and times -----------------------------------------------------------------------------------------


def _moment_codec(base: str, order: str) -> _Moment:
    """Return the codec of DATE, DATE_AND_TIME, LDT or DTL; ``order`` is ``>`` or ``<``."""
    if base == "DATE":
        days = struct.Struct(order + "H")
        bounds = (calendar.FIRST_DT_NS, calendar.FIRST_DT_NS + 0xFFFF * calendar.NS_PER_DAY)
        return _Moment(base, bounds, calendar.NS_PER_DAY, _date_to_ns(days), _date_from_ns(days))
    if base == "DATE_AND_TIME":
        return _Moment(base, (calendar.FIRST_DT_NS, calendar.LAST_DT_NS), calendar.NS_PER_MS, _dt_to_ns, _dt_from_ns)
    if base == "LDT":
        ns = struct.Struct(order + "q")
        return _Moment(base, (0, calendar.LAST_NS), 1, lambda data, at: int(ns.unpack_from(data, at)[0]), ns.pack)
    fields = struct.Struct(order + "HBBBBBBI")
    return _Moment(base, (0, calendar.LAST_DTL_NS), 1, _dtl_to_ns(fields), _dtl_from_ns(fields))


class _Moment:
    """Codec of DATE, DATE_AND_TIME, LDT or DTL; its values are ISO 8601 text."""

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
        """Return the text, or None for bytes that are not a valid date or time."""
        ns = self._to_ns(data, offset)
        if ns is None or not self._bounds[0] <= ns <= self._bounds[1]:
            return None
        return self._text(ns)

    def _text(self, ns: int) -> str:
        if self._digits is None:
            return calendar.format_day(ns // calendar.NS_PER_DAY)
        return calendar.format_moment(ns, self._digits)

    def encode(self, value: object) -> bytes:
        """Return the bytes of an ISO text; raise ValueRangeError if it does not fit the type."""
        ns = calendar.parse_moment(value) if isinstance(value, str) else None
        if ns is None:
            example = "2024-02-29" + ("" if self._digits is None else "T12:34:56.789")
            raise ValueRangeError(f"{self._name}: expected text such as {example!r}, found {brief(value)}")
        if not self._bounds[0] <= ns <= self._bounds[1]:
            raise out_of_range(value, self._name, *map(self._text, self._bounds))
        if ns % self._step:
            raise ValueRangeError(f"{self._name}: {brief(value)} is too precise; {self._text(ns)} fits")
        return self._from_ns(ns)


def _date_to_ns(unpack: struct.Struct) -> Callable[[Buffer, int], int]:
    """Return the decoder of DATE, which has 16 bits: days since 1990-01-01."""
    return lambda data, at: (unpack.unpack_from(data, at)[0] + calendar.DATE_EPOCH_DAYS) * calendar.NS_PER_DAY


def _date_from_ns(pack: struct.Struct) -> Callable[[int], bytes]:
    """Return the encoder of DATE."""
    return lambda ns: pack.pack(ns // calendar.NS_PER_DAY - calendar.DATE_EPOCH_DAYS)


def _dt_to_ns(data: Buffer, offset: int) -> int | None:
    """Decode DATE_AND_TIME to nanoseconds since 1970; None for an invalid time.

    Its BCD bytes are year, month, day, hour, minute, second and milliseconds; the last half-byte is
    the day of the week.
    """
    digits = [_from_bcd(0, byte) for byte in data[offset : offset + 7]]
    last = data[offset + 7] >> 4
    if None in digits or last > 9:
        return None
    year, month, day, hour, minute, second, hundredths = (digit or 0 for digit in digits)
    date_days = calendar.days(year + (1900 if year >= 90 else 2000), month, day)
    if date_days is None or hour > 23 or minute > 59 or second > 59:
        return None
    ms = ((hour * 60 + minute) * 60 + second) * 1000 + hundredths * 10 + int(last)
    return int(date_days * calendar.NS_PER_DAY + ms * calendar.NS_PER_MS)


def _dt_from_ns(ns: int) -> bytes:
    """Encode nanoseconds since 1970 as DATE_AND_TIME."""
    text = calendar.format_moment(ns, 3)  # 2024-02-29T12:34:56.789
    digits = text[2:].translate(str.maketrans("", "", "-T:."))
    return bytes.fromhex(f"{digits}{calendar.weekday(ns)}")


def _dtl_to_ns(layout: struct.Struct) -> Callable[[Buffer, int], int | None]:
    """Return the decoder of DTL.

    Its fields are UINT year; USINT month, day, weekday, hour, minute, second; UDINT nanosecond.
    """

    def decode(data: Buffer, offset: int) -> int | None:
        year, month, day, _, hour, minute, second, ns = layout.unpack_from(data, offset)
        date_days = calendar.days(year, month, day)
        if date_days is None or hour > 23 or minute > 59 or second > 59 or ns >= calendar.NS_PER_SECOND:
            return None
        seconds = (hour * 60 + minute) * 60 + second
        return int((date_days * 86_400 + seconds) * calendar.NS_PER_SECOND + ns)

    return decode


def _dtl_from_ns(layout: struct.Struct) -> Callable[[int], bytes]:
    """Return the encoder of DTL."""

    def encode(ns: int) -> bytes:
        text = calendar.format_moment(ns, 0)
        year, month, day, hour, minute, second = (
            int(text[a:b]) for a, b in ((0, 4), (5, 7), (8, 10), (11, 13), (14, 16), (17, 19))
        )
        rest = ns % calendar.NS_PER_SECOND
        return layout.pack(year, month, day, calendar.weekday(ns), hour, minute, second, rest)

    return encode


def _from_bcd(hundreds: int, byte: int) -> int | None:
    """Return ``hundreds`` plus the number of two BCD digits, or None if a digit is above 9."""
    tens, ones = byte >> 4, byte & 0xF
    return None if max(hundreds, tens, ones) > 9 else int(hundreds * 100 + tens * 10 + ones)


# -- checks --------------------------------------------------------------------------------------------------


def _to_int(value: object, name: str) -> int:
    """Return the value as an int; accept floats without a fraction, but not bools.

    Raises:
        ValueRangeError: The value is not a whole number.
    """
    if not isinstance(value, bool):
        if isinstance(value, float) and value.is_integer():
            return int(value)
        try:
            return operator.index(value)  # type: ignore[arg-type]  # the attempt is the check
        except TypeError:
            pass
    raise ValueRangeError(f"{name}: expected a whole number, found {brief(value)}")


def _to_float(value: object, name: str) -> float:
    """Return the value as a float; accept whole numbers, but not bools.

    Raises:
        ValueRangeError: The value is not a number.
        OverflowError: The value is too large for any float.
    """
    number: Any = value
    if isinstance(value, bool | str | bytes) or not hasattr(value, "__float__"):
        raise ValueRangeError(f"{name}: expected a number, found {brief(value)}")
    return float(number)


def to_bool(value: object, name: str) -> bool:
    """Return the value as a bool; accept 0 and 1.

    Raises:
        ValueRangeError: The value is neither a bool nor 0 or 1.
    """
    if isinstance(value, bool) or (not isinstance(value, str) and value in (0, 1)):
        return bool(value)
    raise ValueRangeError(f"{name}: expected true or false, found {brief(value)}")


def encode_text(value: object, encoding: TextEncoding, name: str) -> bytes:
    """Encode a text.

    Raises:
        ValueRangeError: The value is not a text.
        CharacterError: The encoding lacks a character of the text.

    """
    if not isinstance(value, str):
        raise ValueRangeError(f"{name}: expected text, found {brief(value)}")
    try:
        return encoding.encode(value)
    except UnicodeEncodeError:
        at = encoding.missing(value)
        character, place = value[at], at + 1
        what = f"the register's encoding ({encoding.name}) cannot hold {character!r}, character {place} of the text"
        raise CharacterError(f"{name}: {what}", character, place) from None


def out_of_range(value: object, name: str, least: object, most: object) -> ValueRangeError:
    """Create the error for a value outside the range of its type."""
    return ValueRangeError(f"{name}: {brief(value)} is out of range {least}..{most}")
