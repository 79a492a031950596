"""Recognise the format of a tag list by its content, and import it."""

from __future__ import annotations

from typing import Final

from shmio.layout.importing import kepserver, node_set, simatic_ml, step7_symbols, tia_workbook, xml_tree
from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.source.file import decode
from shmio.wording import larger_than

MAX_BYTES: Final = 32 << 20
FORMATS: Final = (
    "PLC tags of TIA Portal (.xlsx), XML of TIA Portal Openness, symbol tables of STEP 7 (.sdf, .asc, .seq), "
    "tags of KEPServerEX (.csv), OPC UA NodeSet2 (.xml)"
)


def import_tags(data: bytes) -> Found:
    """Import a tag list.

    Args:
        data: Contents of the file, as the vendor's tool wrote it.

    Returns:
        The tags, and the items that were left out.

    Raises:
        ImportingError: The file has an unknown format, is damaged, or is too large.

    """
    if len(data) > MAX_BYTES:
        raise ImportingError(larger_than(MAX_BYTES))
    if data.startswith(b"PK"):
        return tia_workbook.read(data)
    head = decode(data[:4096]).text.lstrip("\ufeff \r\n")
    if head.startswith("<"):
        root = xml_tree.parse(data)
        if root.tag == node_set.ROOT:
            return node_set.read(root)
        if root.tag == simatic_ml.ROOT:
            return simatic_ml.read(root)
        raise ImportingError(f"XML with the root {root.tag[:80]!r} is unknown; shmio-layout import reads: {FORMATS}")
    first = head.partition("\n")[0].lower()
    if first.startswith((kepserver.FIRST, f'"{kepserver.FIRST}')):
        return kepserver.read(data)
    if head.startswith(step7_symbols.FIRST) or first.startswith('"') or first.count(";") == 3 or _is_list(data):
        return step7_symbols.read(data)
    raise ImportingError(f"the format is unknown; shmio-layout import reads: {FORMATS}")


def _is_list(data: bytes) -> bool:
    """Return whether the file begins like an assignment list: a tab, an address, a tab."""
    return data.startswith(b"\t") and data.partition(b"\n")[0].count(b"\t") >= 2
