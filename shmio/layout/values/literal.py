"""Convert S7 literals, from sources and from users, to values, and values to literals.

Examples are ``16#FF``, ``INT#-5``, ``1.5e3``, ``TRUE``, ``T#1h30m``, ``S5T#10s``, ``D#2024-02-29``,
``TOD#12:00:00``, ``DT#2024-02-29-12:00:00``, ``'text$N'``, ``WSTRING#'…'``, and arrays ``[1, 2, 5(0)]``
of any of these. ``codec.py`` lists the Python type of each value.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from fractions import Fraction

from shmio.errors import ValueRangeError
from shmio.layout.encodings import text_encoding
from shmio.layout.model import INTEGERS, ByteOrder, ElementType, Register
from shmio.layout.values import calendar
from shmio.layout.values.codec import Scalar, Value, nest, scalar_codec
from shmio.layout.values.text import to_text
from shmio.wording import brief

MAX_LITERAL = 100  # characters, except for text

_INTEGER = re.compile(r"([+-]?)(?:(2|8|16)#)?([0-9A-Fa-f]+(?:_[0-9A-Fa-f]+)*)")
_REAL = re.compile(r"[+-]?[0-9]+(?:_[0-9]+)*(?:\.[0-9]+(?:_[0-9]+)*)?(?:[eE][+-]?[0-9]+)?")
REPEAT = re.compile(r"([0-9]{1,10})\s*\((.*)\)", re.DOTALL)  # 3(0)
_DURATION_PART = re.compile(r"([0-9]+(?:\.[0-9]+)?)(d|h|ms|us|ns|m|s)_?", re.IGNORECASE)
_CLOCK = re.compile(r"([0-9]{1,2}):([0-9]{1,2})(?::([0-9]{1,2})(?:\.([0-9]{1,9}))?)?")
_SHORT_YEAR = re.compile(r"[0-9]{2}(?=-)")
_BYTES = re.compile(r"B#\s*\((.*)\)", re.IGNORECASE)
_BYTES_BITS = {"WORD": 16, "DWORD": 32}
_COUNT = re.compile(r"C#([0-9]{1,3})", re.IGNORECASE)
_NUMBERED = re.compile(r"(?:T|C|Z|FB|FC|DB|SDB)\s*([0-9]{1,5})", re.IGNORECASE)
_ESCAPE = re.compile(r"\$([LlNnPpRrTt$'])|((?:\$[0-9A-Fa-f]{2})+)")  # bytes in the register's encoding
_WIDE_ESCAPE = re.compile(r"\$([LlNnPpRrTt$'])|((?:\$[0-9A-Fa-f]{4})+)|\$([0-9A-Fa-f]{2})")  # units of UTF-16
_ESCAPED = {"L": "\n", "N": "\r\n", "P": "\f", "R": "\r", "T": "\t", "$": "$", "'": "'"}

_NS = {
    "d": calendar.NS_PER_DAY,
    "h": 3600 * calendar.NS_PER_SECOND,
    "m": 60 * calendar.NS_PER_SECOND,
    "s": calendar.NS_PER_SECOND,
    "ms": calendar.NS_PER_MS,
    "us": 1000,
    "ns": 1,
}
_SIGNED_BITS = {"SINT": 8, "INT": 16, "DINT": 32, "LINT": 64}
_UNIT_NS = {
    **dict.fromkeys(("TIME", "S5TIME", "TIME_OF_DAY"), calendar.NS_PER_MS),
    **dict.fromkeys(("LTIME", "LTOD"), 1),
}
_DURATIONS = frozenset({"TIME", "LTIME", "S5TIME"})
_MOMENTS = frozenset({"DATE", "DATE_AND_TIME", "LDT", "DTL"})
_PREFIXES = {
    **dict.fromkeys(INTEGERS, INTEGERS | {"B", "W", "DW", "LW", "L"}),
    "BOOL": frozenset({"BOOL"}),
    "REAL": frozenset({"REAL", "LREAL"}),
    "LREAL": frozenset({"REAL", "LREAL"}),
    **dict.fromkeys(_DURATIONS, frozenset({"T", "TIME", "LT", "LTIME", "S5T", "S5TIME"})),
    **dict.fromkeys(("TIME_OF_DAY", "LTOD"), frozenset({"TOD", "TIME_OF_DAY", "LTOD", "LTIME_OF_DAY"})),
    **dict.fromkeys(_MOMENTS, frozenset({"D", "DATE", "DT", "DATE_AND_TIME", "LDT", "DATE_AND_LTIME", "DTL"})),
    **dict.fromkeys(("CHAR", "WCHAR", "STRING", "WSTRING"), frozenset({"CHAR", "WCHAR", "STRING", "WSTRING"})),
}
_DEFAULTS = {
    "BOOL": "FALSE",
    "REAL": "0.0",
    "LREAL": "0.0",
    "TIME": "T#0ms",
    "LTIME": "LT#0ns",
    "S5TIME": "S5T#0ms",
    "TIME_OF_DAY": "TOD#00:00:00",
    "LTOD": "LTOD#00:00:00",
    "DATE": "D#1990-01-01",
    "DATE_AND_TIME": "DT#1990-01-01-00:00:00",
    "LDT": "LDT#1970-01-01-00:00:00",
    "DTL": "DTL#1970-01-01-00:00:00",
    "CHAR": "' '",
    "WCHAR": "WCHAR#' '",
    "STRING": "''",
    "WSTRING": "WSTRING#''",
    "POINTER": "00" * 6,
    "ANY": "00" * 10,
}
_WRITTEN = {
    "TIME": "T",
    "LTIME": "LT",
    "S5TIME": "S5T",
    "TIME_OF_DAY": "TOD",
    "LTOD": "LTOD",
    "DATE": "D",
    "DATE_AND_TIME": "DT",
    "LDT": "LDT",
    "DTL": "DTL",
}
"""Prefix of the literals that :func:`literal_text` writes, by type."""


def default_text(element: ElementType) -> str:
    """Return the literal of a type's default value."""
    return _DEFAULTS.get(element.base, "0")


def parse_literal(text: str, register: Register, byte_order: ByteOrder = "big") -> Value:
    """Convert a literal to a value for a register.

    Array elements that the literal leaves out have their type's default.

    Raises:
        ValueRangeError: The text is not a literal of the register's type, or is out of range.
    """
    if not register.dims:
        return scalar_literal(text, register.element, byte_order)
    default = scalar_literal(default_text(register.element), register.element, byte_order)
    flat: list[Value] = [default] * register.count
    for start, count, item in split_array(text, register.shape):
        flat[start : start + count] = [scalar_literal(item, register.element, byte_order)] * count
    return nest(flat, register.shape)


def scalar_literal(text: str, element: ElementType, byte_order: ByteOrder = "big") -> Scalar:
    """Convert a literal to a value of an elementary type.

    Raises:
        ValueRangeError: The text is not a literal of the type, or is out of range.
    """
    text = text.strip()
    value = _read(text, element)
    if value is None:
        wanted = "TRUE, FALSE, 1 or 0" if element.base == "BOOL" else f"a literal such as {default_text(element)}"
        raise ValueRangeError(f"{element.name}: expected {wanted}, found {brief(text)}")
    if element.base != "BOOL":
        scalar_codec(element, byte_order).encode(value)  # only to check the range
    return value


def _read(text: str, element: ElementType) -> Scalar:
    base = element.base
    if text.endswith("'"):
        return _text(text, element)
    if len(text) > MAX_LITERAL:
        return None
    written = text
    prefix, separator, rest = text.partition("#")
    if separator and prefix.upper() in _PREFIXES.get(base, ()):
        text = rest
    if base == "BOOL":
        return {"TRUE": True, "1": True, "2#1": True, "16#1": True}.get(
            text.upper(), False if text.upper() in ("FALSE", "0", "2#0", "16#0") else None
        )
    if base in INTEGERS:
        value = _integer(text, _SIGNED_BITS.get(base))
        return _classic(written, base) if value is None else value
    if base in ("REAL", "LREAL"):
        number = float(text.replace("_", "")) if _REAL.fullmatch(text) else math.inf
        return number if math.isfinite(number) else None
    if base in _MOMENTS:
        if short := _SHORT_YEAR.match(text):  # STEP 7 writes 90 to 99 and 00 to 89
            text = f"{19 if short[0] >= '90' else 20}{text}"
        ns = calendar.parse_moment(text)
        return None if ns is None else _moment(ns, base)
    if base in _UNIT_NS:
        if not separator:
            plain = _integer(text, None)  # a bare number, in the type's unit
            if plain is not None:
                return plain
        ns = _duration(text) if base in _DURATIONS else _clock(text)
        return None if ns is None or ns % _UNIT_NS[base] else ns // _UNIT_NS[base]
    return text if base in ("POINTER", "ANY") else None


def _integer(text: str, signed_bits: int | None) -> int | None:
    match = _INTEGER.fullmatch(text)
    if match is None:
        return None
    try:
        value = int(match[3].replace("_", ""), int(match[2] or 10))
    except ValueError:
        return None
    if match[2] and not match[1] and signed_bits and value >> signed_bits - 1 == 1:
        value -= 1 << signed_bits  # a bit pattern: INT#16#FFFF is -1
    return -value if match[1] == "-" else value


def _classic(text: str, base: str) -> int | None:
    """Read STEP 7's notations for words (``B#(1, 2)``, ``C#100``) and parameters (``T 5``, ``FB 7``)."""
    if match := _BYTES.fullmatch(text):
        values = [_integer(item, None) for item in split_items(match[1])]
        if len(values) * 8 == _BYTES_BITS.get(base) and all(value is not None and 0 <= value < 256 for value in values):
            return int.from_bytes(bytes(value or 0 for value in values))
    elif base == "WORD" and (match := _COUNT.fullmatch(text)):
        return int(match[1], 16)  # BCD
    elif base == "UINT" and (match := _NUMBERED.fullmatch(text)):
        return int(match[1])
    return None


def _duration(text: str) -> int | None:
    """Return a duration in nanoseconds; None if it is malformed or not a whole number of them."""
    sign = -1 if text.startswith("-") else 1
    text = text.lstrip("+-")
    total, position = Fraction(0), 0
    while position < len(text):
        part = _DURATION_PART.match(text, position)
        if part is None:
            return None
        total += Fraction(part[1]) * _NS[part[2].lower()]
        position = part.end()
    return sign * total.numerator if text and total.denominator == 1 else None


def _clock(text: str) -> int | None:
    match = _CLOCK.fullmatch(text)
    if match is None:
        return None
    hour, minute, second = (int(match[group] or 0) for group in (1, 2, 3))
    if hour > 23 or minute > 59 or second > 59:
        return None
    return ((hour * 60 + minute) * 60 + second) * calendar.NS_PER_SECOND + int((match[4] or "").ljust(9, "0"))


def _moment(ns: int, base: str) -> str | None:
    if base == "DATE":
        day, rest = divmod(ns, calendar.NS_PER_DAY)
        return None if rest else calendar.format_day(day)
    digits = 3 if base == "DATE_AND_TIME" and ns % calendar.NS_PER_MS == 0 else 9
    return calendar.format_moment(ns, digits)


def _text(text: str, element: ElementType) -> str | None:
    prefix, separator, rest = text.partition("#'")
    if separator and prefix.upper() in _PREFIXES.get(element.base, ()):
        text = f"'{rest}"
    if len(text) < 2 or text[0] != "'" or element.base not in ("CHAR", "WCHAR", "STRING", "WSTRING"):
        return None
    wide = element.base.startswith("W")

    def unescape(match: re.Match[str]) -> str:
        if match[1]:
            return _ESCAPED[match[1].upper()]
        if match[2]:
            encoding = text_encoding("utf-16-be" if wide else element.encoding)
            return encoding.decode(bytes.fromhex(match[2].replace("$", "")))
        return chr(int(match[3], 16))

    return (_WIDE_ESCAPE if wide else _ESCAPE).sub(unescape, text[1:-1])


# -- writing literals ----------------------------------------------------------------------------------------


def literal_text(value: Value, register: Register) -> str:
    """Return a value as text for people, which :func:`parse_literal` converts back.

    Times and dates become S7 literals (``T#1s500ms``, ``TOD#12:00:00``, ``D#2026-11-22``); all
    other values are as ``to_text`` writes them.
    """
    element = register.element
    return _literal_text(value, element) if element.base in _WRITTEN else to_text(value, register)


def _literal_text(value: Value, element: ElementType) -> str:
    if isinstance(value, list):
        return f"[{','.join(_literal_text(item, element) or 'null' for item in value)}]"
    base, text = element.base, ""
    if value is None:
        return ""
    if isinstance(value, str):
        day, _, clock = value.partition("T")
        text = f"{day}-{_without_zeros(clock)}" if clock else day
    elif base in _DURATIONS:
        text = _duration_text(int(value) * _UNIT_NS[base], "ns" if base == "LTIME" else "ms")
    else:
        text = _without_zeros(calendar.format_moment(int(value) * _UNIT_NS[base], 9).partition("T")[2])
    return f"{_WRITTEN[base]}#{text}"


def _without_zeros(clock: str) -> str:
    """Remove trailing zeros of a fraction: ``12:00:00.500`` becomes ``12:00:00.5``."""
    return clock.rstrip("0").rstrip(".") if "." in clock else clock


def _duration_text(ns: int, finest: str) -> str:
    rest, parts = abs(ns), []
    for unit, length_ns in _NS.items():
        count, rest = divmod(rest, length_ns)
        if count:
            parts.append(f"{count}{unit}")
    return "-" * (ns < 0) + ("".join(parts) or f"0{finest}")


# -- lists of values -----------------------------------------------------------------------------------------


def split_array(text: str, shape: tuple[int, ...]) -> list[tuple[int, int, str]]:
    """Split an array literal into values; return (first element, number of elements, text) of each.

    The literal has the form ``[1, 2, 3(0)]``, with or without the brackets, or has each row in
    brackets. Values beyond the end of the array are ignored.
    """
    runs: list[tuple[int, int, str]] = []
    _fill(text, shape, 0, runs)
    return runs


def _fill(text: str, shape: tuple[int, ...], start: int, runs: list[tuple[int, int, str]]) -> None:
    text = text.strip()
    if text.startswith("[") and text.endswith("]"):
        text = text[1:-1]
    row = math.prod(shape[1:])
    position, stop = start, start + math.prod(shape)
    for item in split_items(text):
        times, inner = 1, [item]
        if repeat := REPEAT.fullmatch(item):
            times, inner = int(repeat[1]), list(split_items(repeat[2]))
        if len(inner) == 1 and not inner[0].startswith("["):
            count = min(times, stop - position)
            if count:
                runs.append((position, count, inner[0]))
            position += count
            continue
        while times and inner and position < stop:
            times -= 1
            for part in inner:
                if position >= stop:
                    break
                if part.startswith("[") and len(shape) > 1:
                    _fill(part, shape[1:], position, runs)
                    position += row
                else:
                    runs.append((position, 1, part))
                    position += 1


def split_items(text: str) -> Iterator[str]:
    """Split a text at the commas outside brackets, strings and quoted names."""
    depth, start, quote = 0, 0, ""
    position = 0
    while position < len(text):
        char = text[position]
        if quote:
            position += char == "$" and quote == "'"
            quote = "" if char == quote else quote
        elif char in "'\"":
            quote = char
        elif char in "([":
            depth += 1
        elif char in ")]":
            depth -= 1
        elif char == "," and depth == 0:
            yield text[start:position].strip()
            start = position + 1
        position += 1
    if text[start:].strip():
        yield text[start:].strip()
