"""Import the CSV file that KEPServerEX exports for a device's tags."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping
from typing import Final

from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.source.file import decode

FIRST: Final = "tag name"
_TYPES: Final = {
    "boolean": "BOOL", "char": "SINT", "byte": "USINT", "short": "INT", "word": "UINT", "long": "DINT",
    "dword": "UDINT", "llong": "LINT", "qword": "ULINT", "float": "REAL", "double": "LREAL", "string": "STRING",
}  # fmt: skip
_ARRAY: Final = re.compile(r"(.*?)\s*\[([0-9]{1,6})\]")


def read(data: bytes) -> Found:
    """Return the tags of the file; raise ImportingError if it is not such an export."""
    text = decode(data).text
    first = text.partition("\n")[0]
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=max(",;\t", key=first.count))
    found = Found("tags of KEPServerEX")
    try:
        header = [name.strip().lower() for name in next(reader, [])]
        if missing := [name for name in (FIRST, "address", "data type") if name not in header]:
            raise ImportingError(f"the first row does not have the columns {', '.join(missing)} of KEPServerEX")
        for cells in reader:
            row = {name: cell.strip() for name, cell in zip(header, cells, strict=False)}
            if row.get(FIRST):
                _add(found, row)
    except csv.Error as error:
        raise ImportingError(f"the file is not an export of KEPServerEX: {error}") from None
    return found


def _add(found: Found, row: Mapping[str, str]) -> None:
    name, address = row[FIRST], row.get("address", "")
    kind = row.get("data type", "").lower()
    array = kind.endswith(" array")
    known = _TYPES.get(kind.removesuffix(" array"))
    if known is None:
        return found.skip(name, f"the type {row.get('data type', '')!r} has no counterpart")
    elements = ""
    if array:
        match = _ARRAY.fullmatch(address)
        if match is None or not int(match[2]):
            return found.skip(name, "an array without one length at the end of its address, as in 400001 [10]")
        elements = f"ARRAY[0..{int(match[2]) - 1}] OF "
    try:
        scale, scaled = _scale(row)
    except ValueError as error:
        return found.skip(name, str(error))
    kind = _TYPES.get(scaled, known) if scale else known
    return found.add(
        tuple(part for part in name.split(".") if part),
        f"{elements}{kind}",
        address=address,
        unit=row.get("eng units"),
        comment=row.get("description"),
        scale=scale,
        writable=row.get("client access", "").replace(" ", "").upper() in ("R/W", "RW"),
    )


def _scale(row: Mapping[str, str]) -> tuple[list[float] | None, str]:
    """Return [factor, offset] and the type of the scaled value; None and "" if there is no scaling.

    Raises:
        ValueError: The scaling is not linear.

    """
    how = row.get("scaling", "").lower()
    if how in ("", "none"):
        return None, ""
    if how != "linear":
        raise ValueError(f"the scaling {row['scaling']!r} is not linear")
    try:
        raw_low, raw_high, low, high = (
            float(row.get(name, "").replace(",", ".")) for name in ("raw low", "raw high", "scaled low", "scaled high")
        )
        factor = (high - low) / (raw_high - raw_low)
    except (ValueError, ZeroDivisionError):
        raise ValueError("its raw and scaled limits must be four numbers, and the raw limits must differ") from None
    offset = low - raw_low * factor
    if row.get("negate value", "").lower() in ("1", "true", "yes"):
        factor, offset = -factor, -offset
    if not math.isfinite(factor) or not math.isfinite(offset) or not factor:
        raise ValueError("its raw and scaled limits must be four numbers, and the raw limits must differ")
    return [factor, offset], row.get("scaled data type", "").lower()
