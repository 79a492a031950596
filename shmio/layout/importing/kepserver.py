"""Import the CSV file that KEPServerEX exports for a device's tags."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from shmio.layout.foreign import KEPSERVER
from shmio.layout.importing import kepserver_address
from shmio.layout.importing.found import Found, ImportingError, of_modbus, of_s7
from shmio.layout.model import element_type
from shmio.layout.rows import delimiter_of, rows

_CLAMPS: Final = ("clamp low", "clamp high")
_YES: Final = frozenset({"1", "true", "yes"})
_ACCESS: Final = {"r/w": True, "rw": True, "read/write": True, "ro": False, "r": False, "readonly": False, "": False}
"""Whether clients may write, by access right; others, such as WO, cannot be read."""
_WORD_ORDER: Final = (
    "the file does not say in which order the device has the words of numbers with 32 and 64 bits: KEPServerEX reads "
    'the low word first, unless the device\'s settings say otherwise; shmio does so with word_order = "little"'
)
_BIT_ORDER: Final = (
    "the file does not say how the device's settings number the bits of words: KEPServerEX begins at 0, unless they "
    "say otherwise; shmio begins at 0, so subtract 1 if the numbers are from 1 to 16"
)


def read(text: str) -> Found:
    """Return the tags of the file; raise ImportingError if it is not such an export."""
    found = Found("tags of KEPServerEX")
    clamped: list[str] = []
    lines = rows(text, delimiter_of(text.lstrip().partition("\n")[0]))
    header = [name.lower().replace(".", "") for name in next(lines, (1, []))[1]]
    if missing := [name for name in (KEPSERVER, "address", "data type") if name not in header]:
        raise ImportingError(f"the first row does not have the columns {', '.join(missing)} of KEPServerEX")
    for line, cells in lines:
        row = dict(zip(header, cells, strict=False))
        if len(cells) < len(header) or any(cells[len(header) :]):
            what = f"expected {len(header)} cells, as in the first row, found {len(cells)}"
            found.skip(row.get(KEPSERVER, ""), what, line)
        elif not row[KEPSERVER]:
            found.skip("a row", "the row has no name", line)
        else:
            _add(found, row, line, clamped)
    if clamped:
        found.remarks.append(
            f"KEPServerEX limits these values to their scaled limits, and shmio does not: {', '.join(clamped)}"
        )
    return found


def _add(found: Found, row: Mapping[str, str], line: int, clamped: list[str]) -> None:
    name = row[KEPSERVER]
    try:
        place = kepserver_address.translate(row["address"], row["data type"])
        scale, kind = _scale(row, place.kind)
        writable = _ACCESS.get(row.get("client access", "").replace(" ", "").lower())
        if writable is None:
            raise ValueError(f"the client access {row['client access']!r} does not allow reads")
    except ValueError as error:
        return found.skip(name, str(error), line)
    bounds = ", ".join(f"{low}..{high}" for low, high in place.dims)
    element = element_type(place.kind)
    if place.modbus and element and element.base != "STRING" and element.size > 2 and _WORD_ORDER not in found.remarks:
        found.remarks.append(_WORD_ORDER)
    if place.modbus and place.kind == "BOOL" and "." in place.address and _BIT_ORDER not in found.remarks:
        found.remarks.append(_BIT_ORDER)
    if scale and any(row.get(clamp, "").lower() in _YES for clamp in _CLAMPS):
        clamped.append(f"{name} (line {line})")
    return found.add(
        tuple(part for part in name.split(".") if part),
        f"ARRAY[{bounds}] OF {kind}" if bounds else kind,
        {
            "address": place.address if kind == place.kind else f"{place.address} {place.kind}",
            "unit": row.get("eng units"),
            "comment": row.get("description"),
            "scale": scale,
            "byte_order": "little" if place.low_first else None,
            "writable": writable,
        },
        line,
        of_modbus if place.modbus else of_s7,
    )


def _scale(row: Mapping[str, str], raw: str) -> tuple[list[float] | None, str]:
    """Return [factor, offset] and the type of the scaled value; None and the raw type if there is no scaling.

    Raises:
        ValueError: The scaling is not linear, or its limits or types are wrong.

    """
    how = row.get("scaling", "").lower()
    if how in ("", "none"):
        return None, raw
    if how != "linear":
        raise ValueError(f"the scaling {row['scaling']!r} is not linear")
    scaled = kepserver_address.NUMBERS.get(row.get("scaled data type", "").lower())
    if scaled is None or raw not in kepserver_address.NUMBERS.values():
        raise ValueError(f"a scaling from {raw} to {row.get('scaled data type', '')!r}; both must be numbers")
    try:
        raw_low, raw_high, low, high = (
            float(row.get(name, "").replace(",", ".")) for name in ("raw low", "raw high", "scaled low", "scaled high")
        )
        factor = (high - low) / (raw_high - raw_low)
    except (ValueError, ZeroDivisionError):
        raise ValueError("its raw and scaled limits must be four numbers, and the raw limits must differ") from None
    offset = low - raw_low * factor
    if row.get("negate value", "").lower() in _YES:
        factor, offset = -factor, -offset
    if not math.isfinite(factor) or not math.isfinite(offset) or not factor:
        raise ValueError("its raw and scaled limits must be four numbers, and the raw limits must differ")
    return [factor, offset], scaled
