"""How many connections the process has descriptors for: they must not run out, for then nothing works any more."""

from __future__ import annotations

import resource
from typing import Final

OWN: Final = 256
"""What the process needs beside connections, and far more."""
EACH: Final = 1
"""Descriptors set aside for a connection."""


FEW: Final = 64
"""So few connections are too few for the programs around a cell."""


def shortage(connections: int, wanted: int) -> str:
    """What ``status`` says when there is room for so few; empty: there is enough."""
    if connections >= min(FEW, wanted):
        return ""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    return (
        f"it serves at most {connections} connections at once, not {wanted}: the hard limit of open files is {files}; "
        f"raise it to {OWN + EACH * wanted} where the supervisor is started (ulimit -n, or LimitNOFILE= of its "
        "service), and start the instance again"
    )


def room(wanted: int) -> int:
    """So many connections, or as many as the limit of open files allows, which is raised as far as it may be."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = OWN + EACH * wanted
    if soft != resource.RLIM_INFINITY and soft < needed:
        soft = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if soft == resource.RLIM_INFINITY:
        return wanted
    return max(1, min(wanted, (soft - OWN) // EACH))
