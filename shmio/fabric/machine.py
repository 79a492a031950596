"""Tells hosts apart that have the same name."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Final

FILE: Final = Path("/etc/machine-id")


@cache
def machine() -> str:
    """Return 16 hexadecimal digits that this host keeps, and hardly any other host has; empty if there are none.

    They come from ``/etc/machine-id``, which machine-id(5) asks programs to keep for themselves.
    """
    try:
        own = FILE.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""
    return hashlib.sha256(f"shmio {own}".encode()).hexdigest()[:16] if own else ""
