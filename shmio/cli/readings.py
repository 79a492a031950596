"""Select registers and format readings for ``shmio``."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from shmio.cli.cell import Cell, Selected
from shmio.errors import PathError
from shmio.layout.glob import named
from shmio.layout.model import Register
from shmio.layout.topic import parse_topic
from shmio.layout.values.codec import Value
from shmio.layout.values.literal import literal_text
from shmio.layout.values.text import json_value
from shmio.local.reading import Reading
from shmio.logs import printable
from shmio.model.values import Provenance, Quality

CUT = "… (all: --full)"


def choose(cell: Cell, patterns: Sequence[str]) -> list[Selected]:
    """Return the registers that the patterns name, each once, in order.

    A pattern is a path, an array element or slice, a structure, or a glob.

    Raises:
        PathError: A pattern names nothing.

    """
    chosen: dict[Selected, None] = {}
    sources = cell.sources
    default = sources[0] if len(sources) == 1 else None
    for pattern in patterns:
        topic = parse_topic(pattern, sources, default)
        if topic.direction == "in":
            raise PathError(f"{pattern}: what goes into a source cannot be read; leave out /in")
        if topic.source not in sources:
            raise PathError(f"{pattern}: nothing is served under {topic.source} in this version")
        registers = named(cell.layout(topic.source), topic)
        if not registers:
            raise PathError(f"{pattern}: no register of {topic.source} has such a path")
        chosen |= dict.fromkeys(Selected(topic.source, register) for register in registers)
    return list(chosen)


def as_json(reading: Reading, register: Register) -> dict[str, Any]:
    """Return a reading as the object that ``get --json`` and ``watch --json`` print."""
    return {
        "value": json_value(reading.value, register.element),
        "quality": str(reading.quality),
        "reason": reading.reason,
        "provenance": reading.provenance,
        "source_time": reading.source_time and _iso(reading.source_time),
        "age_s": reading.age_s,
    }


def as_line(path: str, reading: Reading, register: Register, width: int, room: int | None) -> str:
    """Return a reading as a line of text, with its quality unless good, and a note if injected."""
    quality = "" if reading.quality is Quality.GOOD else f"  {reading.quality}: {printable(reading.reason)}"
    injected = f"  ({reading.provenance})" if reading.provenance == str(Provenance.INJECTED) else ""
    return f"{printable(path):<{width}}  {shown(reading.value, register, room)}{injected}{quality}"


def shown(value: Value, register: Register, room: int | None) -> str:
    """Return a value as text; ``-`` if there is none, ``""`` if it is empty.

    ``room`` is the maximum number of characters; longer text is cut, with a hint on how to see all.
    """
    text = "-" if value is None else printable(literal_text(value, register)) or '""'
    return text if room is None or len(text) <= room else f"{text[: max(room - len(CUT), 0)]}{CUT}"


def _iso(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
