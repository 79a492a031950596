"""Decode the bytes of a source.

TIA Portal writes UTF-8 with a byte order mark, STEP 7 classic writes the Windows code page of its
PC, and some editors write UTF-16 with a mark. Without a mark, bytes that are not UTF-8 are read as
Windows-1252.
"""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass

_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_NEWLINE = re.compile(r"\r\n|\r|\n")
_AS_WINDOWS = (
    "not UTF-8: read as Windows-1252, so letters with accents may be wrong in names and comments; "
    "save the file as UTF-8 to be sure"
)


@dataclass(frozen=True, slots=True)
class Decoded:
    """Text of a source.

    ``problem`` is a warning, or an error if ``fatal``, about the bytes at ``line`` and ``column``.
    """

    text: str
    problem: str = ""
    line: int = 1
    column: int = 1
    fatal: bool = False


def decode(data: bytes) -> Decoded:
    """Decode a source by its byte order mark, as UTF-8, or as Windows-1252."""
    mark, encoding = next(((mark, name) for mark, name in _MARKS if data.startswith(mark)), (b"", "utf-8"))
    data = data[len(mark) :]
    try:
        return Decoded(data.decode(encoding))
    except UnicodeDecodeError as error:
        line, column = _place(data[: error.start].decode(encoding))
    if encoding != "utf-8":
        problem = f"expected {encoding.upper()}, as the byte order mark says, found other bytes; "
        return Decoded("", f"{problem}export the source again", line, column, fatal=True)
    try:
        text = data.decode("cp1252")
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # five bytes have no character in Windows-1252
    return Decoded(text, _AS_WINDOWS, line, column)


def _place(before: str) -> tuple[int, int]:
    lines = _NEWLINE.split(before)
    return len(lines), len(lines[-1]) + 1
