"""Import symbol tables of STEP 7 classic.

The formats are ``.sdf`` (quoted texts with commas), ``.asc`` (columns of fixed width) and ``.seq``
(texts with tabs).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from typing import Final

from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.importing.s7_address import from_classic, value_type
from shmio.layout.source.file import decode

FIRST: Final = "126,"
"""Start of each line of an ``.asc`` file; columns of 24, 12, 10 and 80 characters follow."""
_Symbol = tuple[str, str, str, str]


def read(data: bytes) -> Found:
    """Return the symbols that stand for values; raise ImportingError if the file is not a symbol table."""
    text = decode(data).text
    found = Found("a symbol table of STEP 7")
    for line, (name, address, kind, comment) in _symbols(text):
        place = from_classic(address)
        if not name:
            found.skip(f"line {line}", "the line has no symbol")
        elif place is None:
            found.skip(name, "the symbol is not that of an input, output, bit memory, timer or counter")
        else:
            found.add((name,), value_type(kind or _type_of(place)), address=place, comment=comment)
    return found


def _symbols(text: str) -> Iterator[tuple[int, _Symbol]]:
    """Yield the number and the symbol of each line; raise ImportingError if a line has other columns."""
    if text.startswith(FIRST):
        for line, row in enumerate(text.splitlines(), 1):
            if row.strip("\x1a\0 "):
                if not row.startswith(FIRST):
                    raise ImportingError(f"line {line}: expected {FIRST} at its start, as in all lines of an .asc file")
                columns = row[len(FIRST) :]
                yield line, _stripped(columns[:24], columns[24:36], columns[36:46], columns[46:])
        return
    if text.startswith("\t"):
        for line, row in enumerate(text.splitlines(), 1):
            cells = [*row.split("\t"), "", "", ""]
            if row.strip():
                yield line, _stripped(cells[2], cells[1], "", cells[3])
        return
    first = text.partition("\n")[0]
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=max(",;", key=first.count), skipinitialspace=True)
    try:
        for line, cells in enumerate(reader, 1):
            if not any(cell.strip("\x1a\0 ") for cell in cells):
                continue
            if len(cells) != 4:
                raise ImportingError(f"row {line}: expected symbol, address, type, comment; found {len(cells)} cells")
            yield line, _stripped(*cells)
    except csv.Error as error:
        raise ImportingError(f"the file is not a symbol table: {error}") from None


def _stripped(name: str, address: str, kind: str, comment: str) -> _Symbol:
    return name.strip(), address.strip(), kind.strip().strip('"'), comment.strip()


def _type_of(address: str) -> str:
    """Return a type that fits an address; used because an assignment list (``.seq``) has no types."""
    if address[1] in "TC":
        return "TIMER" if address[1] == "T" else "COUNTER"
    return {"B": "BYTE", "W": "WORD", "D": "DWORD"}.get(address[2], "BOOL")
