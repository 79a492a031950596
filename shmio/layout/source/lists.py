"""Split lists of values in a source: arrays, structures and repetitions."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

REPEAT = re.compile(r"([0-9]{1,10})\s*\((.*)\)", re.DOTALL)  # 3(0)


def split_array(text: str, shape: tuple[int, ...]) -> list[tuple[int, int, str]]:
    """Return (first element, number, text) of each value in an array literal, in order.

    The literal is ``[1, 2, 3(0)]``, the same without brackets, or has each row in brackets. Values
    beyond the end of the array are left out.
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
    """Split at the commas that are outside brackets, strings and quoted names."""
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
