"""Convert values to and from the text of SimlogAPI version 1.

A number becomes the shortest text from which the register's type gets the same value: ``0.1`` for a
REAL. In the other direction, numbers may also be as Java prints them.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable
from decimal import ROUND_UP, Context, Decimal
from functools import partial
from typing import Any, Final, Literal

import msgspec

from shmio.errors import ValueRangeError
from shmio.layout.model import ElementType, Register
from shmio.layout.values.codec import Scalar, Value, bounds, flatten, out_of_range, scalar_codec, to_bool
from shmio.wording import brief

WireType = Literal["double", "int", "bool", "string"]

MAX_NUMBER = 100  # characters
MAX_TEXT = 1 << 20

_FLOATS = frozenset({"REAL", "LREAL"})
_STRINGS = frozenset(["CHAR", "WCHAR", "STRING", "WSTRING", "DATE", "DATE_AND_TIME", "LDT", "DTL", "POINTER", "ANY"])
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,4})?")
_NON_FINITE = {"nan": math.nan} | {
    f"{sign}{word}": -math.inf if sign == "-" else math.inf for sign in ("", "+", "-") for word in ("inf", "infinity")
}
"""NaN and infinities, by their texts in lower case."""


def wire_type(register: Register) -> WireType:
    """Return the type of a register, or of its elements, as version 1 names it."""
    base = register.element.base
    if base == "BOOL":
        return "bool"
    if base in _FLOATS:
        return "double"
    return "string" if base in _STRINGS else "int"


def to_text(value: Value, register: Register) -> str:
    """Return a register's decoded value as text.

    Examples are ``true``, ``-3``, ``0.1`` and ``NaN``; text is unchanged, and arrays are JSON. A
    value of None (invalid bytes) becomes empty text, and ``null`` in an array.
    """
    return _text(register.element, value)


def texts(register: Register) -> Callable[[Value], str]:
    """Return a function that converts values of one register as ``to_text`` does, but faster."""
    element = register.element
    return _real_text if element.base == "REAL" and not register.dims else partial(_text, element)


def _text(element: ElementType, value: Value) -> str:
    if isinstance(value, list):
        return msgspec.json.encode(json_value(value, element) if element.base in _FLOATS else value).decode()
    return _scalar_text(value, element)


def _real_text(value: Any) -> str:
    return repr(_shortest_real(value)) if math.isfinite(value) else _non_finite_text(value)


def shortest(value: float, element: ElementType) -> float:
    """Return the float with the fewest digits that becomes the same REAL; an LREAL is returned unchanged."""
    return _shortest_real(value) if element.base == "REAL" and math.isfinite(value) else value


def _shortest_real(value: float) -> float:
    """Do what ``float(str(numpy.float32(value)))`` does: a command prints a value before it has imported numpy."""
    try:
        (value,) = _REAL.unpack(_REAL.pack(value))
    except OverflowError:
        return math.copysign(math.inf, value)
    if abs(value) <= _EXACT and value.is_integer():
        return value
    digits = 7  # most values need 7 or 8
    while not _is_real(near := float(f"{value:.{digits}g}"), value):
        # The next REAL toward 0 is nearer to a power of two than the next one away from it.
        if math.frexp(value)[0] in (0.5, -0.5) and _is_real(near := _away(value, digits), value):
            return near
        digits += 1
    if digits == 7 and _is_real(shorter := float(f"{value:.6g}"), value):
        near, digits = shorter, 6
    if abs(value) < _LEAST_NORMAL:
        while digits > 1 and _is_real(shorter := float(f"{value:.{digits - 1}g}"), value):
            near, digits = shorter, digits - 1
    return near  # numbers of up to 6 digits are different REALs from _LEAST_NORMAL on


_EXACT: Final = 1 << 24
"""Up to this number, all integers are different REALs."""
_LEAST_NORMAL: Final = 2.0**-126
_REAL: Final = struct.Struct("<f")


def _is_real(near: float, value: float) -> bool:
    """Return whether a float becomes the REAL ``value``."""
    try:
        return _REAL.unpack(_REAL.pack(near))[0] == value  # type: ignore[no-any-return]
    except OverflowError:
        return False


def _away(value: float, digits: int) -> float:
    """Return the next number of so many digits whose absolute value is not less than that of ``value``."""
    return float(Context(digits, ROUND_UP).create_decimal(value))


def from_text(text: str, register: Register) -> Value:
    """Convert a text to a value, the reverse of :func:`to_text`. Numbers may also be as Java prints them.

    Raises:
        ValueRangeError: The text is not a value of the register's type, or is out of range.

    """
    if len(text) > MAX_TEXT:
        raise ValueRangeError(f"{register.path}: the text is longer than {MAX_TEXT} characters")
    element = register.element
    if not register.dims:
        return _read(text, element)
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueRangeError(f"{register.path}: expected a JSON array, found {brief(text)}") from None
    if element.base in _FLOATS:
        value = _finite_or_not(value)
    for item in flatten(value, register.shape, register.path):
        _check(item, element)
    return value  # type: ignore[no-any-return]  # flatten has seen to its shape, _check to its elements


def json_value(value: Value, element: ElementType) -> Value:
    """Convert a value for JSON: give a REAL the fewest digits, and make NaN and infinities text."""
    if isinstance(value, list):
        return [json_value(item, element) for item in value]
    if isinstance(value, float):
        return shortest(value, element) if math.isfinite(value) else _scalar_text(value, element)
    return value


def _finite_or_not(value: object) -> object:
    """Convert a text that ``json_value`` returns for NaN or an infinity back to a float."""
    if isinstance(value, list):
        return [_finite_or_not(item) for item in value]
    return _NON_FINITE.get(value.lower(), value) if isinstance(value, str) else value


def _scalar_text(value: Scalar, element: ElementType) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        if math.isfinite(value):
            return repr(shortest(value, element))
        return _non_finite_text(value)
    return str(value)


def _non_finite_text(value: float) -> str:
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def _read(text: str, element: ElementType) -> Scalar:
    base = element.base
    if base in _STRINGS:
        _check(text, element)
        return text
    text = text.strip()
    if base == "BOOL":
        value: bool | None = {"true": True, "1": True, "false": False, "0": False}.get(text.lower())
        if value is None:
            raise ValueRangeError(f"BOOL: expected true or false, found {brief(text)}")
        return value
    if base in _FLOATS and text.lower() in _NON_FINITE:
        return _NON_FINITE[text.lower()]
    if len(text) > MAX_NUMBER or not _NUMBER.fullmatch(text):
        raise ValueRangeError(f"{element.name}: expected a number, found {brief(text)}")
    if base in _FLOATS:
        number = float(text)
        if math.isinf(number):
            raise out_of_range(text, element.name, *bounds("f" if base == "REAL" else "d"))
        _check(number, element)
        return number
    exact = Decimal(text)  # "5.0" and "1.0E2" are whole numbers, and 2^63-1 keeps all its digits
    if exact != exact.to_integral_value():
        raise ValueRangeError(f"{element.name}: expected a whole number, found {brief(text)}")
    _check(int(exact), element)
    return int(exact)


def _check(value: object, element: ElementType) -> None:
    """Raise ValueRangeError unless the type can hold the value."""
    if element.base == "BOOL":
        to_bool(value, "BOOL")
    else:
        scalar_codec(element).encode(value)
