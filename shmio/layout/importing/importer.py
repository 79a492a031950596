"""Recognise the format of a tag list by its content, and import it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from shmio.layout.compiler import Source
from shmio.layout.foreign import FORMATS, SOURCE, Format, format_of
from shmio.layout.importing import (
    kepserver,
    node_set,
    simatic_ml,
    step7_symbols,
    tia_tag_table,
    tia_workbook,
    xml_tree,
)
from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.source.file import decode
from shmio.wording import larger_than

MAX_BYTES: Final = 32 << 20


def import_tags(
    data: bytes,
    name: str = "the file",
    *,
    further: Sequence[Source] = (),
    encoding: str = "",
    type_bytes: Mapping[str, int] | None = None,
    by_name: bool = False,
) -> Found:
    """Import a tag list.

    Args:
        data: Contents of the file, as the vendor's tool wrote it.
        name: Name of the file, for messages.
        further: For XML of TIA Portal Openness, files with types, function blocks and constants that
            the data blocks use.
        encoding: Encoding of a text without byte order mark, one of
            :data:`shmio.layout.encodings.NAMES`; "": UTF-8, or else Windows-1252 with a remark.
        type_bytes: Sizes in bytes of types whose members are unknown, by name.
        by_name: True to leave out the addresses of data blocks, because the members are read by name.

    Returns:
        The tags, and the items that were left out.

    Raises:
        ImportingError: The file has an unknown format, is damaged, or is too large.
        ValueError: The encoding is unknown.

    """
    if len(data) > MAX_BYTES:
        raise ImportingError(larger_than(MAX_BYTES))
    if data.startswith(b"PK"):
        text, root = "", None
    else:
        decoded = decode(data, encoding)
        if decoded.fatal:
            raise ImportingError(f"line {decoded.line}: {decoded.problem}")
        text = decoded.text.removeprefix("\ufeff")
        root = xml_tree.parse(data) if text.lstrip(" \r\n").startswith("<") else None
    if root is not None and root.tag == simatic_ml.ROOT:
        return simatic_ml.read(root, name, further, encoding, type_bytes or {}, by_name=by_name)
    if further or type_bytes or by_name:
        raise ImportingError(
            "further files, --type-bytes and --by-name are for data blocks in XML of TIA Portal Openness, not for this "
            "file; leave them out"
        )
    if root is not None:
        return _of_xml(root)
    if data.startswith(b"PK"):
        return tia_workbook.read(data)
    found_format = format_of(data, text)
    if found_format is None and SOURCE.search(text):
        raise ImportingError("this is the source of a data block, which needs no import; name it in the key layout")
    if found_format is None:
        raise ImportingError(f"the format is unknown; shmio-layout import reads: {FORMATS}")
    found = kepserver.read(text) if found_format is Format.KEPSERVER else step7_symbols.read(text)
    if decoded.problem:
        found.remarks.append(f"{name}:{decoded.line}:{decoded.column}: warning: {decoded.problem}")
    return found


def _of_xml(root: xml_tree.Node) -> Found:
    if root.tag in tia_tag_table.ROOTS:
        return tia_tag_table.read(root)
    if root.tag == node_set.ROOT:
        return node_set.read(root)
    raise ImportingError(f"XML with the root {root.tag[:80]!r} is unknown; shmio-layout import reads: {FORMATS}")
