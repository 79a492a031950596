"""The least version of the NATS servers."""

from __future__ import annotations

import re
from typing import Final

LEAST: Final = (2, 10)
"""Older servers do not tell their time, by which the fabric knows that a cell is down."""
_VERSION: Final = re.compile(r"(?:nats-server: )?v?(\d{1,6})\.(\d{1,6})")


def version_fault(version: str) -> str:
    """Return why a server of this version cannot be used; empty if it can be, or if the text is no version."""
    found = _VERSION.match(version)
    if found is None or (int(found[1]), int(found[2])) >= LEAST:
        return ""
    shown = version.strip().removeprefix("nats-server: ")[:20]
    return f"the server is NATS {shown}, but the fabric needs {'.'.join(map(str, LEAST))} or later; upgrade the server"
