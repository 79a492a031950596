"""The reference of the public Python names: mkdocstrings makes it from their docstrings."""

from __future__ import annotations

from typing import Final

NAMES: Final = {
    "Cells": ["shmio.model.cell.Cell", "shmio.local.attach.attach", "shmio.client.connect"],
    "Local programs": ["shmio.local.attach.Attachment", "shmio.local.attach.View"],
    "Remote programs": ["shmio.client.Client", "shmio.client.connect_aio"],
    "Recordings": ["shmio.recording.dump.open_dump", "shmio.recording.dump.Dump", "shmio.recording.columns.Columns"],
    "Models and PLC programs": ["shmio.simulation", "shmio.plc"],
    "Connectors": ["shmio.connectors.base"],
    "Laboratory": ["shmio.lab"],
    "Errors": ["shmio.errors"],
}
"""The public names, by the title of their page."""


def pages() -> dict[str, tuple[str, str]]:
    """Return title and text of each page, by its path."""
    found = {}
    for title, names in NAMES.items():
        text = f"# {title}\n\n" + "\n".join(f"::: {name}\n" for name in names)
        found[f"reference/generated/python-{title.lower().replace(' ', '-')}.md"] = title, text
    return found
