"""Recognise files that hold blocks or tags but are not sources, and say what to do instead."""

from __future__ import annotations

import re
from typing import Final

from shmio.layout.source.text_encoding import decode

HEAD_BYTES: Final = 4096
_INSTEAD: Final = (
    "in TIA Portal, open the context menu of the data block, choose 'Generate source from blocks', and name the "
    ".db file that it writes"
)
_ZIP: Final = b"PK\x03\x04"
_OLD_OFFICE: Final = b"\xd0\xcf\x11\xe0"
_CONTROLS: Final = bytes({*range(32)} - {*b"\t\n\f\r"})
_MARKUP: Final = re.compile(r"\s*<[?!A-Za-z]")
_SOURCE: Final = re.compile(r"\b(?:DATA_BLOCK|END_TYPE|FUNCTION_BLOCK|END_VAR)\b", re.IGNORECASE)
_SEPARATORS: Final = re.compile(r"[;,\t]")


def foreign(file: str, data: bytes) -> str:
    """Return what a file is and what to do instead; empty if it may be a source."""
    name = file.lower()
    head = data[:HEAD_BYTES]
    if head.startswith((_ZIP, _OLD_OFFICE)) or name.endswith((".xlsx", ".xls", ".ods")):
        return f"this is a spreadsheet or an archive, which shmio cannot read: {_INSTEAD}"
    wide = head.startswith((b"\xff\xfe", b"\xfe\xff"))
    text = decode(head[: len(head) & ~1] if wide else head).text
    if _MARKUP.match(text) or name.endswith(".xml"):
        return f"this is XML, as TIA Portal Openness exports blocks, which shmio cannot read: {_INSTEAD}"
    if name.endswith((".csv", ".sdf", ".tsv")) or _is_table(text, data):
        return f"this is a table of tags without their places in a data block: {_INSTEAD}"
    controls = len(head) - len(head.translate(None, _CONTROLS))
    if not wide and controls > max(len(head) // 20, 8):
        return f"this is not a text file: {_INSTEAD}"
    return ""


def _is_table(text: str, data: bytes) -> bool:
    """Return whether the text looks like a table of separated values and declares no block."""
    lines = [line for line in text.splitlines() if line.strip()][:3]
    if len(lines) < 2 or ":" in lines[0] or _SOURCE.search(decode(data).text):
        return False
    counts = [len(_SEPARATORS.findall(line)) for line in lines]
    return counts[0] >= 2 and len({*counts[:2]}) == 1
