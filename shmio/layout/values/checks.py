"""Checks that the codecs of several types share; each raises ValueRangeError with the type's name."""

from __future__ import annotations

import math
import operator
from typing import Any

from shmio.errors import ValueRangeError


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

    Raises ValueRangeError: not a number; OverflowError: too large for any float.
    """
    number: Any = value
    if isinstance(value, bool | str | bytes) or not hasattr(value, "__float__"):
        raise ValueRangeError(f"{name}: expected a number, found {brief(value)}")
    return float(number)


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


def out_of_range(value: object, name: str, least: object, most: object) -> ValueRangeError:
    """Return the error for a value outside the type's range."""
    return ValueRangeError(f"{name}: {brief(value)} is out of range {least}..{most}")


def brief(value: object) -> str:
    """Return a value's text, short enough for a message; a huge integer is not converted."""
    if isinstance(value, int) and not -(1 << 128) < value < 1 << 128:
        return f"an integer of {math.ceil(value.bit_length() / 8)} bytes"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:59]}…"
