"""Limits the connections to the file descriptors that the process may have.

Without free descriptors nothing in the process would work.
"""

from __future__ import annotations

import resource
from typing import Final

OWN: Final = 256
"""Descriptors reserved for everything but connections; more than enough."""
EACH: Final = 1
"""Descriptors reserved for each connection."""


FEW: Final = 64
"""With fewer connections than this the endpoint reports a shortage."""


def shortage(connections: int, wanted: int) -> str:
    """Return the note for ``status`` if connections are short; empty: there are enough."""
    if connections >= min(FEW, wanted):
        return ""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    return (
        f"it serves at most {connections} connections at once, not {wanted}: the hard limit of open files is {files}; "
        f"raise it to {OWN + EACH * wanted} where the supervisor is started (ulimit -n, or LimitNOFILE= of its "
        "service), and start the instance again"
    )


def room(wanted: int) -> int:
    """Raise the limit of open files as far as needed; return the connections that it allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = OWN + EACH * wanted
    if soft != resource.RLIM_INFINITY and soft < needed:
        soft = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if soft == resource.RLIM_INFINITY:
        return wanted
    return max(1, min(wanted, (soft - OWN) // EACH))
