"""Add a tag of a PLC tag table, as all formats of TIA Portal and STEP 7 have it."""

from __future__ import annotations

from typing import Final

from shmio.layout.importing.found import Found, of_s7
from shmio.layout.model import element_type
from shmio.layout.s7.notation import value_type

NO_ADDRESS: Final = "the tag has no address"
CONSTANT: Final = "a constant has no value in the controller"


def add_plc_tag(
    found: Found, name: str, kind: str, address: str, line: int, *, comment: str = "", writable: bool = False
) -> None:
    """Add a tag, or skip it if it has no address, or if a tag table cannot contain it."""
    if not name:
        found.skip("a row", "the row has no name", line)
    elif not address:
        found.skip(name, NO_ADDRESS, line)
    elif kind.startswith('"'):
        found.skip(name, "a PLC data type; name its members in the table", line)
    elif kind.replace(" ", "").isidentifier() and element_type(value_type(kind)) is None:  # as "UDT 5" in STEP 7
        found.skip(name, f"unknown type {kind!r}; if it is a PLC data type, name its members in the table", line)
    else:
        columns = {"address": address, "comment": comment, "writable": writable}
        found.add((name,), value_type(kind), columns, line, of_s7)
