"""Convert one element of each type between bytes and a Python value, with range checks.

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

Bytes that are not a valid value of the type (month 13, a BCD digit above 9, a STRING longer than
its maximum) decode to None: a controller may hold such bytes, and one bad register must not make a
whole frame unreadable. Encoding never writes them.

Formats: Siemens, "STEP 7 Professional", chapter "Data types".
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from typing import Any, Protocol

from shmio.errors import ValueRangeError
from shmio.layout.types import ElementType
from shmio.layout.values import calendar
from shmio.layout.values.checks import brief, encode_text, out_of_range, to_float, to_int
from shmio.layout.values.date_types import Buffer, from_bcd, moment_codec

Scalar = bool | int | float | str | None

REAL_MAX = 3.4028235e38  # greatest 32-bit float, in its fewest digits
MAX_TOD_MS = 86_399_999
MAX_LTOD_NS = calendar.NS_PER_DAY - 1
MAX_S5_MS = 9_990_000
_S5_BASES_MS = (10, 100, 1000, 10_000)


class ScalarCodec(Protocol):
    """Codec of one element.

    ``plain`` is the ``struct`` format if that alone decodes the value, else empty.
    """

    plain: str

    def decode(self, data: Buffer, offset: int) -> Scalar:
        """Return the value at a byte offset, or None for bytes that are not a valid value."""

    def encode(self, value: object) -> bytes:
        """Return the element's bytes; ValueRangeError if the type cannot hold the value."""


class _Number:
    """Codec of floats and integers, including times in milliseconds or nanoseconds."""

    def __init__(self, name: str, order: str, code: str, limit: int | None = None) -> None:
        self.plain = code if limit is None else ""
        self._name, self._code = name, code
        self._struct = struct.Struct(order + code)
        self._limit = limit
        self._convert: Callable[[object, str], float] = to_float if code in "fd" else to_int
        self._native = frozenset({int, float} if code in "fd" else {int})  # types that are packed as they are

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
    """Return the least and greatest number of a ``struct`` code; ``limit`` lowers the greatest."""
    if code in "fd":
        most = REAL_MAX if code == "f" else sys.float_info.max
        return -most, most
    bits = 8 * struct.calcsize(f"={code}")
    least, most = (-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1)
    return least, most if limit is None else limit


class _Text:
    """Codec of CHAR and WCHAR: one character in one code unit."""

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
    """Codec of STRING and WSTRING: maximum length, actual length, characters."""

    plain = ""

    def __init__(self, element: ElementType, order: str, encoding: str, unit: int) -> None:
        self._name, self._length, self._size = element.name, element.length, element.size
        self._head = struct.Struct(order + ("BB" if unit == 1 else "HH"))
        self._encoding, self._unit = encoding, unit

    def decode(self, data: Buffer, offset: int) -> str | None:
        # The declared length counts: the maximum length in the data is 0 until the controller
        # sets it.
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
    """Codec of S5TIME: a BCD number of 0-999, and a time base in bits 12 and 13."""

    plain = ""

    def __init__(self, order: str) -> None:
        self._struct = struct.Struct(order + "H")

    def decode(self, data: Buffer, offset: int) -> int | None:
        word = self._struct.unpack_from(data, offset)[0]
        count = from_bcd(word >> 8 & 0xF, word & 0xFF)
        return None if count is None else count * _S5_BASES_MS[word >> 12 & 3]

    def encode(self, value: object) -> bytes:
        ms = to_int(value, "S5TIME")
        for code, base in enumerate(_S5_BASES_MS):  # the finest base that fits
            if 0 <= ms <= 999 * base and ms % base == 0:
                return self._struct.pack(code << 12 | int(str(ms // base), 16))
        if 0 <= ms <= MAX_S5_MS:
            raise ValueRangeError(f"S5TIME: {ms} ms needs more than three digits of any time base")
        raise out_of_range(value, "S5TIME", 0, MAX_S5_MS)


class _Opaque:
    """Codec of POINTER and ANY: hexadecimal text."""

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
    """Return the codec of one element of any type except BOOL."""
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
        **dict.fromkeys(("DATE", "DATE_AND_TIME", "LDT", "DTL"), lambda: moment_codec(base, order)),
        "POINTER": lambda: _Opaque(element),
        "ANY": lambda: _Opaque(element),
    }
    return factories[base]()
