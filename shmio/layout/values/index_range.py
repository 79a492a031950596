"""Index ranges of OPC UA, which name a part of an array, a text or a byte string (OPC 10000-4, section 7.27)."""

from __future__ import annotations

import re
from typing import Any, Final

Ranges = tuple[tuple[int, int], ...]
"""For each dimension, the first and the last index, from 0."""

_RANGES: Final = re.compile(r"[0-9]{1,10}(:[0-9]{1,10})?(,[0-9]{1,10}(:[0-9]{1,10})?){0,31}")


class NoDataError(Exception):
    """The value has nothing in an index range."""


class ShapeError(Exception):
    """New contents do not have the shape of the index range."""


def parse(text: str) -> Ranges:
    """Return the ranges in a text such as ``2``, ``2:5`` or ``1,0:2``.

    Raises:
        ValueError: The text is no index range.
    """
    if not _RANGES.fullmatch(text):
        raise ValueError("an index range is an index or two, such as 2 or 2:5, for each dimension")
    found = []
    for part in text.split(","):
        first, colon, last = part.partition(":")
        low, high = int(first), int(last or first)
        if (colon and low >= high) or high > 0xFFFFFFFF:
            raise ValueError("the second index of a range is larger than the first")
        found.append((low, high))
    return tuple(found)


def select(value: Any, ranges: Ranges) -> Any:
    """Return the part of a value that ranges name. A part beyond the end of the value is missing in the result.

    Raises:
        NoDataError: The value has nothing there, or another number of dimensions.
    """
    (first, last), rest = ranges[0], ranges[1:]
    if not isinstance(value, list | str | bytes) or first >= len(value):
        raise NoDataError
    part = value[first : last + 1]
    if not isinstance(part, list):
        if rest:
            raise NoDataError
        return part
    if rest:
        return _each(part, rest)
    if any(isinstance(one, list) for one in part):
        raise NoDataError
    return part


def _each(part: list[Any], rest: Ranges) -> list[Any]:
    """Select from each element. In an array of texts, a text may be too short, but not every one."""
    if not all(isinstance(one, str | bytes) for one in part):
        return [select(one, rest) for one in part]
    (first, last), more = rest[0], rest[1:]
    found = [one[first : last + 1] for one in part]
    if more or not any(found):
        raise NoDataError
    return found


def replace(value: Any, ranges: Ranges, part: Any) -> Any:
    """Return a value in which ranges have other contents.

    Raises:
        NoDataError: The ranges are not all inside the value.
        ShapeError: The new contents do not have the shape of the ranges.
    """
    (first, last), rest = ranges[0], ranges[1:]
    if not isinstance(value, list | str | bytes) or last >= len(value):
        raise NoDataError
    if type(part) is not type(value) or len(part) != last - first + 1:
        raise ShapeError
    if not isinstance(value, list):
        if rest:
            raise NoDataError
        empty: Any = type(value)()
        return empty.join((value[:first], part, value[last + 1 :]))
    inner = any(isinstance(one, list) for one in value)
    if inner and not rest:
        raise NoDataError
    if rest:
        changed = [replace(old, rest, new) for old, new in zip(value[first : last + 1], part, strict=True)]
    else:
        changed = list(part)
    return [*value[:first], *changed, *value[last + 1 :]]


def sizes_of(part: Any) -> list[int]:
    """Return the sizes of the dimensions of an array; none for another value."""
    sizes = []
    while isinstance(part, list):
        sizes.append(len(part))
        part = part[0] if part else None
    return sizes
