"""Read rows of separated values. A damaged row costs only itself, because each line is a row."""

from __future__ import annotations

import csv
from collections.abc import Iterator


def rows(text: str, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells of each line that is not empty."""
    for line, row in enumerate(text.split("\n"), 1):
        if row.strip("\r\x1a\0 "):
            yield line, cells_of(row.rstrip("\r\x1a\0"), delimiter)


def cells_of(row: str, delimiter: str) -> list[str]:
    """Return the cells of a row, without white space around them.

    Some tools do not double the quotes within a quoted cell. Then quotes with a delimiter between
    them separate cells, as long as all cells are quoted.
    """
    try:
        cells = next(csv.reader([row], delimiter=delimiter, skipinitialspace=True, strict=True), [])
    except csv.Error:
        inner = row.strip().removeprefix('"').removesuffix('"')
        cells = inner.split(f'"{delimiter}"')
    return [cell.strip() for cell in cells]


def delimiter_of(row: str) -> str:
    """Return the character that separates the cells of a row: a comma, semicolon or tab outside of quotes."""
    outside = "".join(row.split('"')[::2])
    return max(",;\t", key=outside.count)
