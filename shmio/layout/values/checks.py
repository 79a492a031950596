"""Checks shared by the codecs; each raises ValueRangeError with the name of the type."""

from __future__ import annotations

import math
import operator
from typing import Any

from shmio.errors import ValueRangeError


def to_int(value: object, name: str) -> int:
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


def to_float(value: object, name: str) -> float:
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
        ValueRangeError: The value is anything else.
    """
    if isinstance(value, bool) or (not isinstance(value, str) and value in (0, 1)):
        return bool(value)
    raise ValueRangeError(f"{name}: expected true or false, found {brief(value)}")


def encode_text(value: object, encoding: str, name: str) -> bytes:
    """Return text in the type's encoding.

    Raises:
        ValueRangeError: The value is not text, or has a character that the encoding lacks.
    """
    if not isinstance(value, str):
        raise ValueRangeError(f"{name}: expected text, found {brief(value)}")
    try:
        return value.encode(encoding)
    except UnicodeEncodeError as error:
        raise ValueRangeError(f"{name}: cannot hold the character {value[error.start]!r}") from None


def out_of_range(value: object, name: str, least: object, most: object) -> ValueRangeError:
    """Return the error for a value outside the type's range."""
    return ValueRangeError(f"{name}: {brief(value)} is out of range {least}..{most}")


def brief(value: object) -> str:
    """Return a value's text, short enough for a message; a huge integer is not converted."""
    if isinstance(value, int) and not -(1 << 128) < value < 1 << 128:
        return f"an integer of {math.ceil(value.bit_length() / 8)} bytes"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:59]}…"
