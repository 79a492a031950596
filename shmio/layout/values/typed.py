"""Read values that a user has typed, as JSON or as an S7 literal."""

from __future__ import annotations

import json
from typing import Final

from shmio.errors import ValueRangeError
from shmio.layout.model import Register
from shmio.layout.values.codec import Value
from shmio.layout.values.literal import parse_literal, split_array
from shmio.layout.values.text import from_text, wire_type

_QUOTED: Final = frozenset({"CHAR", "WCHAR", "STRING", "WSTRING"})


def read_value(text: str, register: Register) -> Value:
    """Convert JSON or an S7 literal to a value for a register.

    A literal of an array must have all elements, because missing elements would be written as 0.

    Raises:
        ValueRangeError: The text is not a value, or does not fit the register.

    """
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return _literal(text, register)
    if register.dims:
        try:
            return from_text(text, register)
        except ValueRangeError:
            return _literal(text, register)
    if isinstance(value, str) and wire_type(register) != "double":
        return value
    if isinstance(value, (str, int, float)) and wire_type(register) != "string":
        return from_text(value if isinstance(value, str) else text, register)
    if isinstance(value, (dict, list)) or value is None:
        raise ValueRangeError(f"expected one {register.type}, found {text[:60]!r}")
    return _literal(text, register)


def _literal(text: str, register: Register) -> Value:
    if register.dims:
        # With the second, larger shape, too many elements show as another number.
        given = [
            sum(count for _, count, _ in split_array(text, shape))
            for shape in (register.shape, tuple(length + 1 for length in register.shape))
        ]
        if given != [register.count] * 2:
            raise ValueRangeError(f"expected all of the array's {register.count} elements, found {max(given)}")
    try:
        return parse_literal(text, register)
    except ValueRangeError as error:
        if register.element.base in _QUOTED and "'" not in text and '"' not in text:
            raise ValueRangeError(
                f"{error}; put text in quotes, and these in quotes for the shell: '\"text\"'"
            ) from None
        raise
