"""Reads JSON as devices write it: also with NaN and Infinity, which JSON does not have."""

from __future__ import annotations

import json
import math
from typing import Any

import msgspec


def read(text: bytes | msgspec.Raw) -> Any:
    """Return the document in a text. NaN, Infinity and -Infinity are numbers, as Python's ``json`` writes them.

    Raises:
        ValueError: The text is not JSON. The message says why.
        RecursionError: The document is nested too deeply.

    """
    try:
        return msgspec.json.decode(text)
    except msgspec.DecodeError as error:
        reason = error
    try:
        return json.loads(bytes(text), parse_float=_finite)
    except ValueError:
        raise ValueError(str(reason)) from None


def _finite(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        raise ValueError("larger than all numbers")
    return number
