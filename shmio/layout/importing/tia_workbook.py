"""Import the workbook that TIA Portal exports from *PLC tags* (``PLCTags.xlsx``)."""

from __future__ import annotations

from typing import Final

from shmio.layout.foreign import SHEET
from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.importing.plc_tag import add_plc_tag
from shmio.layout.workbook import WorkbookError, read_rows

_NEEDED: Final = ("name", "data type", "logical address")


def read(data: bytes) -> Found:
    """Return the tags of the sheet ``PLC Tags``; raise ImportingError if there is no such sheet."""
    found = Found("PLC tags of TIA Portal")
    try:
        rows = read_rows(
            data,
            lambda names: SHEET if SHEET in names else None,
            lambda error: found.skip("a row", str(error), error.row),
        )
    except WorkbookError as error:
        raise ImportingError(f"{error}; expected an export of TIA Portal's PLC tags with the sheet {SHEET!r}") from None
    header = {name.strip().lower(): place for place, name in enumerate(rows[0][1])} if rows else {}
    if missing := [name for name in _NEEDED if name not in header]:
        raise ImportingError(f"the sheet {SHEET!r} does not have the columns {', '.join(missing)}")
    for number, cells in rows[1:]:

        def cell(column: str, cells: list[str] = cells) -> str:
            place = header.get(column)
            return cells[place].strip() if place is not None and place < len(cells) else ""

        comment = cell("comment")
        add_plc_tag(
            found, cell("name"), cell("data type"), cell("logical address"), number,
            comment="" if comment == "<No Value>" else comment, writable=cell("hmi writeable").lower() == "true",
        )  # fmt: skip
    return found
