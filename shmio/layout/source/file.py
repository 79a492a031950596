"""Decode the bytes of a source file, and recognise files that are not sources.

TIA Portal writes UTF-8 with a byte order mark, STEP 7 classic uses the Windows code page of its PC,
and some editors write UTF-16 with a mark. Files without a mark are read as UTF-8 or, if they are
not in UTF-8, as Windows-1252.
"""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass
from typing import Final

HEAD_BYTES: Final = 4096
_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_NEWLINE = re.compile(r"\r\n|\r|\n")
_AS_WINDOWS = (
    "the file is not UTF-8, so shmio reads it as Windows-1252, and letters with accents may be wrong in names and "
    "comments; save it as UTF-8 to be sure"
)
_INSTEAD: Final = (
    "in TIA Portal, open the context menu of the data block, choose 'Generate source from blocks', and name the "
    ".db file that it writes"
)
_CONVERT: Final = "'shmio-layout import' makes a tag table of it; for a data block, "
_ZIP: Final = b"PK\x03\x04"
_OLD_OFFICE: Final = b"\xd0\xcf\x11\xe0"
_CONTROLS: Final = bytes({*range(32)} - {*b"\t\n\f\r"})
_MARKUP: Final = re.compile(r"\s*<[?!A-Za-z]")
_SOURCE: Final = re.compile(r"\b(?:DATA_BLOCK|END_TYPE|FUNCTION_BLOCK|END_VAR)\b", re.IGNORECASE)
_SEPARATORS: Final = re.compile(r"[;,\t]")


@dataclass(frozen=True, slots=True)
class Decoded:
    """The text of a source.

    ``problem`` is a warning (an error if ``fatal``) about the bytes at ``line`` and ``column``;
    empty if there is none.
    """

    text: str
    problem: str = ""
    line: int = 1
    column: int = 1
    fatal: bool = False


def decode(data: bytes) -> Decoded:
    """Decode a source: by its byte order mark, or else as UTF-8, or else as Windows-1252."""
    mark, encoding = next(((mark, name) for mark, name in _MARKS if data.startswith(mark)), (b"", "utf-8"))
    data = data[len(mark) :]
    try:
        return Decoded(data.decode(encoding))
    except UnicodeDecodeError as error:
        line, column = _place(data[: error.start].decode(encoding))
    if encoding != "utf-8":
        problem = f"the file has the byte order mark of {encoding.upper()}, but other bytes follow; "
        return Decoded("", f"{problem}export the source again", line, column, fatal=True)
    try:
        text = data.decode("cp1252")
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # because five bytes have no character in Windows-1252
    return Decoded(text, _AS_WINDOWS, line, column)


def _place(before: str) -> tuple[int, int]:
    lines = _NEWLINE.split(before)
    return len(lines), len(lines[-1]) + 1


def foreign(file: str, data: bytes) -> str:
    """Return a message that names the kind of a file and the remedy; "" if the file may be a source."""
    name = file.lower()
    head = data[:HEAD_BYTES]
    if head.startswith((_ZIP, _OLD_OFFICE)) or name.endswith((".xlsx", ".xls", ".ods")):
        return f"this is a spreadsheet or an archive, which shmio cannot read; {_INSTEAD}"
    wide = head.startswith((b"\xff\xfe", b"\xfe\xff"))
    text = decode(head[: len(head) & ~1] if wide else head).text
    if _MARKUP.match(text) or name.endswith(".xml"):
        return f"this is XML, as TIA Portal Openness exports blocks; {_CONVERT}{_INSTEAD}"
    if name.endswith((".csv", ".sdf", ".tsv")) or _is_table(text, data):
        return f"this is a table of tags without their places in a data block; {_CONVERT}{_INSTEAD}"
    controls = len(head) - len(head.translate(None, _CONTROLS))
    if not wide and controls > max(len(head) // 20, 8):
        return f"this is not a text file; {_INSTEAD}"
    return ""


def _is_table(text: str, data: bytes) -> bool:
    """Return whether the text looks like a table of separated values and declares no block."""
    lines = [line for line in text.splitlines() if line.strip()][:3]
    if len(lines) < 2 or ":" in lines[0] or _SOURCE.search(decode(data).text):
        return False
    counts = [len(_SEPARATORS.findall(line)) for line in lines]
    return counts[0] >= 2 and len({*counts[:2]}) == 1
