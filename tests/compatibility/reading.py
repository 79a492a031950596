"""What a recording contains, by ``shmio.open_dump``: ``python reading.py FILE.mem...`` prints it as JSON.

``store.py`` runs this file with the Python of the version that it stores, so the file uses only what version 0.1.0
has, too.
"""

from __future__ import annotations

import hashlib
import json
import struct
import sys
from pathlib import Path
from typing import Any

import shmio


def described(file: Path) -> dict[str, Any]:
    """Return frames, values, events and gaps of a recording; long parts as digests."""
    with shmio.open_dump(file) as dump:
        return {
            "instance": dump.instance,
            "closed": dump.closed,
            "gaps": len(dump.gaps),
            "sources": {source: _source(dump, source) for source in dump.sources},
        }


def _source(dump: Any, source: str) -> dict[str, Any]:
    stamps, images = hashlib.sha256(), hashlib.sha256()
    for _, _, frame in dump.frames(source):
        *numbers, reason, raw, effective = frame
        stamps.update(struct.pack("<10q", *numbers) + reason.encode() + b"\0")
        images.update(raw + (effective or b""))
    columns = dump.columns(source)
    return {
        "frames": len(columns.number),
        "stamps": stamps.hexdigest(),
        "images": images.hexdigest(),
        "registers": {name: _column(columns[name]) for name in columns},
        "events": [_event(event) for _, _, event in dump.events(source)],
    }


def _column(values: Any) -> Any:
    text = json.dumps(values.tolist(), separators=(",", ":"), default=str)
    return [str(values[-1])[:40], hashlib.sha256(text.encode()).hexdigest()[:16]]


def _event(event: Any) -> list[Any]:
    if getattr(event, "by", None) == "":  # versions before the sender have no such field
        event = event[:-1]
    return [value.hex() if isinstance(value, bytes) else value for value in event]


if __name__ == "__main__":
    json.dump({file.name: described(file) for file in map(Path, sys.argv[1:])}, sys.stdout)
