"""Import the XML that TIA Portal's tag editor exports: ``Tagtable``, or several of them below ``Tagtables``."""

from __future__ import annotations

from typing import Final

from shmio.layout.importing.found import Found
from shmio.layout.importing.plc_tag import CONSTANT, add_plc_tag
from shmio.layout.importing.xml_tree import Node

ROOTS: Final = ("Tagtable", "Tagtables")


def read(root: Node) -> Found:
    """Return the tags of the tables."""
    found = Found("PLC tags of TIA Portal")
    for element in root.iter():
        name, given = (element.text or "").strip(), element.attrib
        if element.tag == "Constant":
            found.skip(name, CONSTANT, element.line)
        elif element.tag == "Tag":
            add_plc_tag(
                found, name, given.get("type", "").strip(), given.get("addr", "").strip(), element.line,
                comment=given.get("remark", ""), writable=given.get("hmiWriteable", "").lower() == "true",
            )  # fmt: skip
        elif element.tag not in ROOTS:
            found.skip(name or element.tag, f"an element {element.tag} is not a tag", element.line)
    return found
