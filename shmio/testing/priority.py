"""What tests of real-time priorities need of the host."""

from __future__ import annotations

from shmio import realtime
from shmio.errors import ConfigError


def may_be_realtime() -> bool:
    """Whether this user may have a real-time priority."""
    try:
        realtime.check(1)
    except ConfigError:
        return False
    return True
