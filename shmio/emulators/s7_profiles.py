"""How long real S7 controllers take to answer, and what they grant. No I/O.

The times were measured between request and answer in public captures of real plants; docs/how-to/
emulate-an-s7-plc.md has the table.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

Kind = Literal["confirm", "setup", "read", "write", "other"]
"""What a client asks for: a connection, a session, values, a write, or something else, such as a status list."""


class Times(NamedTuple):
    """Times in ms that half, 90 %, 99 % and all of the answers take at most. Unknown ones equal the one before."""

    p50: float
    p90: float
    p99: float
    most: float

    def at(self, share: float) -> float:
        """Return the time in ms that a share (0 to 1) of the answers takes at most; at least ``p50``."""
        low, begin = self.p50, 0.5
        for high, end in ((self.p90, 0.9), (self.p99, 0.99), (self.most, 1.0)):
            if share < end:
                return low + (high - low) * max(0.0, share - begin) / (end - begin)
            low, begin = high, end
        return self.most


def _times(*ms: float) -> Times:
    return Times(*ms, *(ms[-1:] * (4 - len(ms))))


class Profile(NamedTuple):
    """One kind of controller."""

    pdu_size: int
    """Size of the largest PDU that it grants, in bytes."""
    jobs: int
    """Maximum number of jobs in flight that it grants."""
    times: Mapping[Kind, Times]


def _profile(
    pdu_size: int, jobs: int, *, read: Times, write: Times, other: Times, confirm: float, setup: float
) -> Profile:
    times: dict[Kind, Times] = {
        "confirm": _times(confirm), "setup": _times(setup), "read": read, "write": write, "other": other
    }  # fmt: skip
    return Profile(pdu_size, jobs, times)


PROFILES: Final[Mapping[str, Profile]] = {
    "s7-300": _profile(
        240, 2, confirm=2.6, setup=2.4, read=_times(3.2), write=_times(3.2), other=_times(5.7, 6.6, 6.8)
    ),
    "im151-8": _profile(
        240,
        1,
        confirm=3.9,
        setup=4.2,
        read=_times(3.9, 4.0, 5.0, 6.9),
        write=_times(3.9, 4.9, 5.0, 7.0),
        other=_times(5.7, 6.6, 8.1),
    ),
    "s7-300-slow": _profile(
        240, 2, confirm=15, setup=15, read=_times(15, 64, 115, 245), write=_times(14, 24, 73), other=_times(30)
    ),
    "s7-400": _profile(
        480,
        2,
        confirm=4.1,
        setup=4.1,
        read=_times(4.1, 4.4, 7.2),
        write=_times(4.1, 4.2),
        other=_times(4.1, 4.3, 5.1),
    ),
    "s7-1500": _profile(
        480, 1, confirm=0.5, setup=0.8, read=_times(0.8, 1.3), write=_times(1.0, 1.1), other=_times(0.8, 1.3)
    ),
    "s7-plant-slow": _profile(
        240, 2, confirm=28, setup=28, read=_times(28, 36, 45, 51), write=_times(12, 23, 34), other=_times(28, 36, 45)
    ),
}


class Delays:
    """Draws the time of each answer to one client. Equal seeds give equal times."""

    def __init__(self, profile: Profile, seed: int) -> None:
        self._times = profile.times
        self._rng = random.Random(seed)  # noqa: S311 - not for security
        self._last_ns = 0

    def due_ns(self, kind: Kind, received_ns: int) -> int:
        """Return when to answer a request. Requests in flight overlap, and no answer overtakes the one before."""
        after_ns = round(self._times[kind].at(self._rng.random()) * 1e6)
        self._last_ns = max(self._last_ns, received_ns + after_ns)
        return self._last_ns
