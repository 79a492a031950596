"""Read the rows of an Excel workbook (``.xlsx``) as text, within bounds.

openpyxl reads the workbook. It is an optional library, imported only when a workbook is read.
"""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from collections.abc import Callable, Iterator
from datetime import date, time, timedelta
from typing import TYPE_CHECKING, Final

from shmio.errors import ShmioError

if TYPE_CHECKING:
    from openpyxl import Workbook

MAX_UNPACKED_BYTES: Final = 64 << 20
"""Maximum size of all parts of a workbook when unpacked, because a small archive may contain huge parts."""
MAX_PARTS: Final = 1000
MAX_COLUMNS: Final = 64
MAX_ROWS: Final = 1 << 20
"""Maximum number of rows, as in Excel; a damaged workbook may have larger row numbers."""
INSTALL: Final = "reading .xlsx needs openpyxl; run pip install 'shmio[xlsx]', or save the sheet as CSV UTF-8 (.csv)"

Row = tuple[int, list[str]]
"""A row: its number as Excel shows it, and the text of its cells."""


class WorkbookError(ShmioError):
    """A workbook cannot be read; the message says why.

    ``row`` is the number of the wrong row; 1 if the error does not concern a row.
    """

    def __init__(self, message: str, row: int = 1) -> None:
        super().__init__(message)
        self.row = row


def read_rows(
    data: bytes,
    choose: Callable[[list[str]], str | None],
    refuse: Callable[[WorkbookError], None] | None = None,
) -> list[Row]:
    """Return the rows of one sheet, without empty rows.

    Cells right of column ``MAX_COLUMNS`` are ignored. The value of a formula is the one that Excel
    saved.

    Args:
        data: Contents of the file.
        choose: Returns the name of the sheet to read, given all names; None if it is missing.
        refuse: Called for a row with a wrong cell, which is left out; None: such a row is an error.

    Raises:
        WorkbookError: openpyxl is missing, or the file is not a workbook, too large, or lacks the
            sheet.

    """
    try:
        import openpyxl  # noqa: PLC0415  (an extra)
    except ImportError:
        raise WorkbookError(INSTALL) from None
    _check_archive(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about parts that shmio does not read, such as drop-down lists
            book = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)
            names = [sheet.title for sheet in book.worksheets]
            name = choose(names)
            if name is None:
                listed = ", ".join(names[:20]) or "none"
                raise WorkbookError(f"the workbook has no sheet of this name; it has: {listed}")
            return list(_rows(book, name, refuse))
    except WorkbookError:
        raise
    except Exception as error:  # noqa: BLE001  (openpyxl raises whatever its parsers raise)
        raise WorkbookError(f"the workbook cannot be read ({type(error).__name__}); save it again") from None


def _check_archive(data: bytes) -> None:
    """Raise WorkbookError if there are too many parts, or their declared sizes are too large."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = archive.infolist()
    except Exception as error:  # noqa: BLE001  (damaged archives raise errors of many kinds)
        raise WorkbookError(f"not a workbook: {error}") from None
    if len(parts) > MAX_PARTS:
        raise WorkbookError(f"expected a workbook of at most {MAX_PARTS} parts, found {len(parts)}")
    unpacked = sum(part.file_size for part in parts)
    if unpacked > MAX_UNPACKED_BYTES:
        raise WorkbookError(f"the workbook unpacks to more than {MAX_UNPACKED_BYTES} bytes")


def _rows(book: Workbook, name: str, refuse: Callable[[WorkbookError], None] | None) -> Iterator[Row]:
    sheet = book[name]
    reset = getattr(sheet, "reset_dimensions", None)
    if reset is not None:
        reset()  # a workbook may declare that it uses all cells
    cells = sheet.iter_rows(max_col=MAX_COLUMNS, max_row=MAX_ROWS, values_only=True)
    for number, row in enumerate(cells, 1):
        if any(cell is not None for cell in row):
            try:
                yield number, [_text(cell, number, column) for column, cell in enumerate(row)]
            except WorkbookError as error:
                if refuse is None:
                    raise
                refuse(error)


def _text(cell: object, row: int, column: int) -> str:
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return str(cell).upper()
    if isinstance(cell, float) and math.isfinite(cell) and cell.is_integer() and abs(cell) < 1 << 53:
        return str(int(cell))
    if isinstance(cell, (date, time, timedelta)):
        what = "is a date or a time; format the column as text and enter the value again"
        raise WorkbookError(f"cell {_letters(column)}{row} {what}", row)
    return str(cell)


def _letters(column: int) -> str:
    """Return the letters of a column, given its number from 0 to 701."""
    first, second = divmod(column, 26)
    return (chr(ord("A") + first - 1) if first else "") + chr(ord("A") + second)
