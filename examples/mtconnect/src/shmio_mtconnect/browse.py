"""Lists the data items of an agent, with the types and addresses that a tag table needs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from shmio.connectors.browsing import Browsed, Offer, Wanted
from shmio_mtconnect.documents import DataItem

TEXT: Final = "STRING[120]"
_UNITS: Final = {
    "AMPERE": "A", "CELSIUS": "°C", "DEGREE": "°", "HERTZ": "Hz", "MILLIMETER": "mm", "MILLIMETER/SECOND": "mm/s",
    "NEWTON": "N", "NEWTON_METER": "Nm", "PERCENT": "%", "REVOLUTION/MINUTE": "1/min", "SECOND": "s", "VOLT": "V",
    "WATT": "W",
}  # fmt: skip


def offers(items: Iterable[DataItem], wanted: Wanted) -> Browsed:
    """Return the data items of a device model."""
    found: list[Offer] = []
    used: set[tuple[str, ...]] = set()
    for item in items:
        names = item.labels if item.labels not in used else (*item.labels[:-1], item.id)
        used.add(names)
        if not wanted.takes(names):
            continue
        if len(found) == wanted.nodes:
            return Browsed(found, "there are more data items; select some of them by a PATTERN, or raise --limit")
        found.append(_offer(names, item))
    return Browsed(found)


def _offer(names: tuple[str, ...], item: DataItem) -> Offer:
    if item.representation in ("DATA_SET", "TABLE"):
        return Offer(names, refused="data sets and tables are not supported")
    if item.representation == "TIME_SERIES":
        return Offer(names, refused="write an ARRAY with as many of the newest values of the series as you need")
    if not item.id or set(item.id) & set("/="):
        return Offer(names, refused="an address cannot express its dataItemId")
    columns: dict[str, object] = {"address": item.id}
    if item.category == "CONDITION":
        return Offer(names, "USINT", columns | {"comment": "0 normal, 1 warning, 2 fault"})
    units = item.units.removesuffix("_3D")
    columns["unit"] = _UNITS.get(units, units.lower())
    if item.units.endswith("_3D"):
        return Offer(names, "ARRAY[0..2] OF LREAL", columns)
    if item.category == "SAMPLE" or units:
        return Offer(names, "LREAL", columns)
    return Offer(names, "UDINT" if item.kind == "PART_COUNT" else TEXT, columns)
