"""Recognise files that are not sources: tag lists of other tools, and files that shmio cannot read."""

from __future__ import annotations

import io
import re
import shlex
import zipfile
from collections.abc import Sequence
from enum import Enum
from typing import Final

from shmio.layout.rows import cells_of, delimiter_of
from shmio.layout.s7.notation import from_classic
from shmio.layout.source.file import decode

FORMATS: Final = (
    "PLC tags of TIA Portal (.xlsx, .xml, .sdf), XML of TIA Portal Openness, symbol tables of STEP 7 (.sdf, .asc, "
    ".seq), tags of KEPServerEX (.csv), OPC UA NodeSet2 (.xml)"
)
_HEAD_BYTES: Final = 4096
KEPSERVER: Final = "tag name"
"""The first heading of an export of KEPServerEX, in lower case."""
SHEET: Final = "PLC Tags"
"""The sheet with the tags in a workbook of TIA Portal."""
_ROOT: Final = re.compile(r"(?>\s*<(?:\?[^>]*>|!--.*?-->))*+\s*<(?:[\w.-]+:)?([\w.-]+)", re.DOTALL)
_IN_DOCUMENT: Final = re.compile(r"<SW\.(?:Blocks\.(?:GlobalDB|InstanceDB)|Tags\.PlcTag|ControllerTag)\b")
_MAX_LIST_OF_SHEETS: Final = 1 << 20
_INSTEAD: Final = (
    "in TIA Portal, open the context menu of the data block, choose 'Generate source from blocks', and name the "
    ".db file that it writes"
)
_CONVERT: Final = "'shmio-layout import' makes a tag table of it; for a data block, "
_MICROWIN: Final = re.compile(r"DATA PAGE COMMENTS|^[ \t]*V[BWD]?[0-9]{1,5}(?:\.[0-7])?[ \t]+[^\s:]", re.MULTILINE)
_MEMBERS: Final = re.compile(r"\b(?:STRUCT|VAR|VAR_INPUT|VAR_OUTPUT)\b", re.IGNORECASE)
_MC7_MAGIC: Final = b"pp"
_MC7_TEXT: Final = re.compile(
    r"\s*(?:[0-9A-Fa-f]{4,8}:?\s+)?(?:0x)?70[\s,]*(?:0x)?70(?:[\s,]*(?:0x)?[0-9A-Fa-f]{2}){6}"
)
_ZIP: Final = b"PK\x03\x04"
_OLD_OFFICE: Final = b"\xd0\xcf\x11\xe0"
_CONTROLS: Final = bytes({*range(32)} - {*b"\t\n\f\r"})
_MARKUP: Final = re.compile(r"\s*<[?!A-Za-z]")
SOURCE: Final = re.compile(r"\b(?:DATA_BLOCK|END_TYPE|FUNCTION_BLOCK|END_VAR)\b", re.IGNORECASE)
_SEPARATORS: Final = re.compile(r"[;,\t]")
FIXED: Final = "126,"
"""Start of each line of an ``.asc`` file; columns of 24, 12, 10 and 80 characters follow."""
COLUMNS: Final = {
    3: ("name", "address", "type"),
    4: ("name", "address", "type", "comment"),
    9: ("name", "address", "type", "", "", "", "comment", "", "writable"),
}
"""The columns of a list without a header row, by their number; nine are those of TIA Portal."""
HEADINGS: Final = {
    **dict.fromkeys(("name", "symbol", "tagname", "symbolname"), "name"),
    **dict.fromkeys(("address", "logicaladdress", "logischeadresse", "adresse", "addr", "operand"), "address"),
    **dict.fromkeys(("datatype", "datentyp", "type", "typ"), "type"),
    **dict.fromkeys(("comment", "kommentar", "remark", "bemerkung"), "comment"),
    **dict.fromkeys(("hmiwriteable", "hmiwritable"), "writable"),
}
"""What a header row calls the columns, in lower case and without spaces."""
OPERAND: Final = re.compile(r"(?:OB|FB|FC|DB|SFB|SFC|UDT|VAT|DI)\s*[0-9]{1,5}", re.IGNORECASE)
MAX_PROBED: Final = 200  # lines that decide about the format


class Format(Enum):
    """A format that ``shmio-layout import`` reads."""

    WORKBOOK = "a workbook with PLC tags of TIA Portal"
    TAG_TABLE = "XML of TIA Portal's tag editor"
    SIMATIC_ML = "XML of TIA Portal Openness"
    NODE_SET = "an OPC UA NodeSet2"
    KEPSERVER = "an export of KEPServerEX"
    SYMBOLS = "a list of PLC tags"


_ROOTS: Final = {
    "Tagtable": Format.TAG_TABLE, "Tagtables": Format.TAG_TABLE, "Document": Format.SIMATIC_ML,
    "UANodeSet": Format.NODE_SET,
}  # fmt: skip


def format_of(data: bytes, text: str) -> Format | None:
    """Return the format of a tag list; None if the file is none that can be imported.

    Args:
        data: Contents of the file.
        text: The same as text; it does not matter for a workbook.

    """
    if data.startswith(b"PK"):
        return Format.WORKBOOK if _has_tags(data) else None
    text = text.lstrip("\ufeff \r\n")
    if text.startswith("<"):
        root = _ROOT.match(text)
        found = _ROOTS.get(root[1]) if root else None
        return found if found is not Format.SIMATIC_ML or _IN_DOCUMENT.search(text) else None
    header = [cell.strip(' "\r').lower() for cell in re.split(r"[,;\t]", text.partition("\n")[0])]
    if header[0] == KEPSERVER:
        return Format.KEPSERVER
    if {"path", "type"} <= {*header} or {"path", "address"} <= {*header} - {"name"}:
        return None  # a tag table
    return Format.SYMBOLS if _is_list(text) else None


def _has_tags(data: bytes) -> bool:
    """Return whether a workbook has the sheet of PLC tags."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive, archive.open("xl/workbook.xml") as sheets:
            return SHEET.encode() in sheets.read(_MAX_LIST_OF_SHEETS)
    except Exception:  # noqa: BLE001  (damaged archives raise errors of many kinds)
        return False


def _is_list(text: str) -> bool:
    """Return whether a text looks like such a list: one of its first lines has an address in its place."""
    lines = [line for line in text.split("\n", MAX_PROBED)[:MAX_PROBED] if line.strip("\r\x1a\0 ")]
    if lines and is_header(cells_of(lines[0].rstrip("\r"), delimiter_of(lines[0]))):
        return True
    return any(line.startswith(FIXED) or _has_operand(line) or _is_quoted(line) for line in lines)


def is_header(cells: Sequence[str]) -> bool:
    """Return whether a row names the columns of a list of symbols."""
    return {"name", "address"} <= {*headings(cells)}


def headings(cells: Sequence[str]) -> list[str]:
    """Return the name of each column of a header row; "" for a column of no interest."""
    return [HEADINGS.get(re.sub(r"[\s_.-]", "", cell).lower(), "") for cell in cells]


def _has_operand(line: str) -> bool:
    cells = cells_of(line.rstrip("\r"), delimiter_of(line))
    return len(cells) >= min(COLUMNS) and is_operand(cells[1])


def _is_quoted(line: str) -> bool:
    return line.startswith('"') and len(cells_of(line.rstrip("\r"), ",")) in COLUMNS


def is_operand(text: str) -> bool:
    """Return whether a cell is the address of a value, or names a block or constant, as in a list of symbols."""
    return from_classic(text) is not None or OPERAND.fullmatch(text) is not None or text.upper() == "CONSTANT"


def foreign(file: str, data: bytes) -> str:
    """Return a message that names the kind of a file and the remedy; "" if the file may be a source."""
    name = file.lower()
    head = data[:_HEAD_BYTES]
    if head.startswith((_ZIP, _OLD_OFFICE)) or name.endswith((".xlsx", ".xls", ".ods")):
        return f"this is a spreadsheet or an archive, not the source of a data block; {_conversion(data)}{_INSTEAD}"
    wide = head.startswith((b"\xff\xfe", b"\xfe\xff"))
    text = decode(head[: len(head) & ~1] if wide else head).text
    if _MARKUP.match(text) or name.endswith(".xml"):
        return f"this is XML, not the source of a data block; {_conversion(data)}{_INSTEAD}"
    if name.endswith((".csv", ".sdf", ".tsv")) or _is_table(text, data):
        return f"this is a table of tags without their places in a data block; {_conversion(data)}{_INSTEAD}"
    is_binary = len(head) - len(head.translate(None, _CONTROLS)) > 0
    if (head.startswith(_MC7_MAGIC) and is_binary) or _MC7_TEXT.match(text) or name.endswith((".mc7", ".wld")):
        return f"this is a compiled block (MC7), which has no names; {_INSTEAD}"
    if text.startswith("MultiLingualTexts:"):
        return "these are the texts of a source in SIMATIC SD (.s7res), which shmio does not read; leave out this file"
    if _MICROWIN.search(text) and not _MEMBERS.search(text):
        return (
            "this is a data block of STEP 7-Micro/WIN (S7-200), which gives values to addresses and declares no "
            "members; write a tag table with addresses such as DB1.DBW0, because V memory is DB1"
        )
    controls = len(head) - len(head.translate(None, _CONTROLS))
    if not wide and controls > max(len(head) // 20, 8):
        return f"this is not a text file; {_INSTEAD}"
    return ""


def _conversion(data: bytes) -> str:
    """Return the part of a message that names the command which reads a tag list; "" if the command cannot read it."""
    return _CONVERT if format_of(data, decode(data).text) else ""


def misplaced_list(file: str, data: bytes) -> str:
    """Return a message if a file that is named as a tag table is another tool's tag list; else ""."""
    found = format_of(data, decode(data).text)
    if found is None:
        return ""
    return f"this is {found.value}, not a tag table; convert it: shmio-layout import {shlex.quote(file)} -o tags.toml"


def _is_table(text: str, data: bytes) -> bool:
    """Return whether the text looks like a table of separated values and declares no block."""
    lines = [line for line in text.splitlines() if line.strip()][:3]
    if lines and lines[0].startswith(FIXED):
        return True
    if len(lines) < 2 or ":" in lines[0] or SOURCE.search(decode(data).text):
        return False
    counts = [len(_SEPARATORS.findall(line)) for line in lines]
    return counts[0] >= 2 and len({*counts[:2]}) == 1
