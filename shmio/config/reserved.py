"""Names that no source may have."""

from __future__ import annotations

RESERVED_SOURCES = frozenset({"simlog", "model", "shmio"})
