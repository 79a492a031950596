"""Format readings for ``shmio``."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from shmio.layout.model import Register
from shmio.layout.values.codec import Value
from shmio.layout.values.literal import literal_text
from shmio.layout.values.text import json_value
from shmio.logs import printable
from shmio.model.reading import Reading
from shmio.model.values import Provenance, Quality

CUT = "… (all: --full)"


def as_json(reading: Reading) -> dict[str, Any]:
    """Return a reading as the object that ``get --json`` and ``watch --json`` print."""
    return {
        "value": json_value(reading.value, reading.register.element),
        "quality": str(reading.quality),
        "reason": reading.reason,
        "provenance": reading.provenance,
        "source_time": reading.source_time and _iso(reading.source_time),
        "age_s": reading.age_s,
    }


def as_line(reading: Reading, width: int, room: int | None) -> str:
    """Return a reading as a line of text, with its quality unless good, and a note if injected."""
    quality = "" if reading.quality is Quality.GOOD else f"  {reading.quality}: {printable(reading.reason)}"
    injected = f"  ({reading.provenance})" if reading.provenance == str(Provenance.INJECTED) else ""
    value = shown(reading.value, reading.register, room)
    return f"{printable(reading.path):<{width}}  {value}{injected}{quality}"


def shown(value: Value, register: Register, room: int | None) -> str:
    """Return a value as text; ``-`` if there is none, ``""`` if it is empty.

    ``room`` is the maximum number of characters; longer text is cut, with a hint on how to see all.
    """
    text = "-" if value is None else printable(literal_text(value, register)) or '""'
    return text if room is None or len(text) <= room else f"{text[: max(room - len(CUT), 0)]}{CUT}"


def _iso(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
