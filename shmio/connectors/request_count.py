"""The requests that a source sends in a cycle, as far as shmio can tell without asking the device."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Requests:
    """The number of requests in a cycle, under an assumption about the device."""

    count: int
    """The largest number of requests in a cycle."""
    in_flight: int = 1
    """Number of requests that the device surely accepts in flight at once."""
    assumption: str = ""
    """The assumption, such as ``PDU of 240 bytes``; empty if there is none."""

    @property
    def round_trips(self) -> int:
        """The number of round trips in a cycle that follow one another."""
        return -(-self.count // max(1, self.in_flight))


@dataclass(frozen=True)
class CycleRequests:
    """The requests that a source sends to its device in each cycle."""

    reads: str
    """Description of what is read, such as ``340 registers in DB5, DB7 and inputs``."""
    requests: tuple[Requests, ...] = ()
    """The requests of a cycle under each assumption; empty if the device sends values unasked."""
    note: str = ""
    """A remark for the user, for example why a cycle may need fewer or more requests; may be empty."""
