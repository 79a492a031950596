"""Text that comes from devices and files, made fit for a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    """One line without characters that would move a terminal's cursor."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
