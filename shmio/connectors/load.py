"""What a source asks of its device in each cycle, as far as that is known without the device."""

from __future__ import annotations

from dataclasses import dataclass


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, such as ``1 node`` or ``7 nodes``."""
    return f"{count} {noun}{'s' * (count != 1)}"


@dataclass(frozen=True)
class Requests:
    """The requests of a cycle."""

    count: int
    """How many, at most."""
    in_flight: int = 1
    """How many of them the device certainly takes at once."""
    assumption: str = ""
    """What the count depends on, such as ``PDU of 240 bytes``; empty if it depends on nothing."""

    @property
    def round_trips(self) -> int:
        """How many round trips a cycle takes one after the other."""
        return -(-self.count // max(1, self.in_flight))


@dataclass(frozen=True)
class Load:
    """What a source asks of its device in each cycle."""

    reads: str
    """What it reads, such as ``340 registers in DB5, DB7 and inputs``."""
    requests: tuple[Requests, ...] = ()
    """The requests of a cycle, one entry for each assumption; none if the device sends values by itself."""
    note: str = ""
    """What else is to be known, such as why a cycle may take fewer or more requests."""
