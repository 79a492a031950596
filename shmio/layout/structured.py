"""Initial values of structures: ``(1, 2)``, ``(a := 1, b := 2)``, and arrays of these.

In a list by position, ``()`` leaves a member at the value its own declaration gives it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

from shmio.errors import ValueRangeError
from shmio.layout.checks import brief
from shmio.layout.lists import REPEAT, split_array, split_items
from shmio.layout.model import Dims
from shmio.layout.placed import Group

_NAMED = re.compile(r'\s*(?:"([^"]*)"|(\w+))\s*:=(.*)', re.DOTALL)
_BRACKETS = {"(": ")", "[": "]"}


def member_values(text: str, group: Group) -> dict[str, str]:
    """Return the text for each member that is given one, by name in lower case.

    Raises ValueRangeError: not such a list, an unknown member, or too many values.
    """
    inner = _inside(text)
    if inner is None:
        raise ValueRangeError(f"expected a value such as (1, 2) or (a := 1, b := 2), found {brief(text)}")
    items = list(split_items(inner))
    if items and all(_NAMED.fullmatch(item) for item in items):
        return dict(_by_name(items, group))
    values: dict[str, str] = {}
    names = iter(group.fields)
    for item in _repeated(items, len(group.fields)):
        name = next(names, None)
        if name is None:
            raise ValueRangeError(f"expected at most {len(group.fields)} values, found {brief(text)}")
        if item not in ("", "()"):
            values[name] = item
    return values


def element_values(text: str, dims: Dims) -> list[str | None]:
    """Return the text for each element of an array of structures, None where none is given."""
    shape = tuple(high - low + 1 for low, high in dims)
    values: list[str | None] = [None] * math.prod(shape)
    if text.strip().startswith("("):
        text = f"[{_inside(text) or ''}]"
    for start, count, item in split_array(text, shape):
        if item not in ("", "()"):
            values[start : start + count] = [item] * count
    return values


def _by_name(items: list[str], group: Group) -> Iterator[tuple[str, str]]:
    for item in items:
        if match := _NAMED.fullmatch(item):
            name = match[1] or match[2] or ""
            if name.lower() not in group.fields:
                raise ValueRangeError(f"expected a member of the structure, found {name!r}")
            yield name.lower(), match[3].strip()


def _repeated(items: list[str], most: int) -> Iterator[str]:
    for item in items:
        if match := REPEAT.fullmatch(item):
            inner = list(split_items(match[2]))
            for _ in range(min(int(match[1]), most + 1)):
                yield from inner
        else:
            yield item


def _inside(text: str) -> str | None:
    """Return what is between the brackets around a text, None if it has none."""
    text = text.strip()
    return text[1:-1] if len(text) >= 2 and _BRACKETS.get(text[0]) == text[-1] else None
