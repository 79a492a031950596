"""Import symbol tables of STEP 7 classic, and lists of the same columns, also of TIA Portal's tag editor.

The formats are ``.sdf`` (quoted texts with commas; 4 columns, or 9 from TIA Portal), ``.asc`` (columns
of fixed width), ``.seq`` (texts with tabs), and rows ``symbol;address;type;comment``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final

from shmio.layout.foreign import COLUMNS, FIXED, MAX_PROBED, OPERAND, headings, is_header
from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.importing.plc_tag import CONSTANT, NO_ADDRESS, add_plc_tag
from shmio.layout.rows import delimiter_of, rows
from shmio.layout.s7.notation import from_classic

_NOT_A_VALUE: Final = "the symbol is not that of an input, output, bit memory, timer or counter"


def read(text: str) -> Found:
    """Return the symbols that stand for values; raise ImportingError if the file is not such a list."""
    found = Found("a symbol table of STEP 7")
    if text.lstrip("\r\n").startswith(FIXED):
        symbols = _fixed(found, text)
    elif text.lstrip("\r\n").startswith("\t"):
        symbols = _assignments(text)
    else:
        symbols = _separated(found, text)
    for line, symbol in symbols:
        name, address, kind = symbol["name"], symbol["address"], symbol["type"]
        place = from_classic(address)
        if not name:
            found.skip("a row", "the row has no symbol", line)
        elif address.upper() == "CONSTANT":
            found.skip(name, CONSTANT, line)
        elif not address:
            found.skip(name, NO_ADDRESS, line)
        elif place is None:
            found.skip(name, _NOT_A_VALUE if OPERAND.fullmatch(address) else f"{address!r} is not an address", line)
        else:
            writable = symbol.get("writable", "").lower() == "true"
            add_plc_tag(found, name, kind or _type_of(place), place, line, comment=symbol["comment"], writable=writable)
    return found


def _fixed(found: Found, text: str) -> Iterator[tuple[int, dict[str, str]]]:
    for line, row in enumerate(text.split("\n"), 1):
        if not row.strip("\r\x1a\0 "):
            continue
        if not row.startswith(FIXED):
            found.skip(row.strip(), f"the row does not begin with {FIXED}, as in an .asc file", line)
            continue
        columns = row.rstrip("\r")[len(FIXED) :]
        cells = columns[:24], columns[24:36], columns[36:46], columns[46:]
        yield line, dict(zip(COLUMNS[4], map(str.strip, cells), strict=True))


def _assignments(text: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the rows of an assignment list: nothing, address, symbol, comment."""
    for line, row in enumerate(text.split("\n"), 1):
        if row.strip("\r\x1a\0\t "):
            _, address, name, comment = [*map(str.strip, row.split("\t", 3)), "", "", ""][:4]
            yield line, {"name": name, "address": address, "type": "", "comment": comment}


def _separated(found: Found, text: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield rows whose cells a delimiter separates. The first row may be a header."""
    first = next((line for line in text.split("\n") if line.strip()), "")
    table = list(rows(text, delimiter_of(first)))
    if table and is_header(table[0][1]):
        columns: Sequence[str] = headings(table.pop(0)[1])
    else:
        counts = Counter(len(cells) for _, cells in table[:MAX_PROBED] if len(cells) in COLUMNS)
        if not counts:
            raise ImportingError(
                "expected rows of symbol, address, type and comment, or the nine columns of TIA Portal; found "
                f"{len(table[0][1]) if table else 0} cells"
            )
        columns = COLUMNS[counts.most_common(1)[0][0]]
    for line, cells in table:
        if len(cells) != len(columns):
            found.skip(cells[0], f"expected {len(columns)} cells, found {len(cells)}", line)
        else:
            yield line, {"type": "", "comment": ""} | dict(zip(columns, cells, strict=True))


def _type_of(address: str) -> str:
    """Return a type that fits an address; used where a list has no types."""
    if address[1] in "TC":
        return "TIMER" if address[1] == "T" else "COUNTER"
    width = address.partition(".DB")[2] or address[2:]
    return {"B": "BYTE", "W": "WORD", "D": "DWORD"}.get(width[0], "BOOL")
