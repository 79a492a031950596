"""A frame: a consistent image of a whole block at one cycle."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Quality(IntEnum):
    """Trust in a value, as OPC UA means it (OPC 10000-8, section 6.3). Zeroed memory is bad."""

    BAD = 0
    UNCERTAIN = 1
    GOOD = 2

    def __str__(self) -> str:
        return self.name.lower()


class Provenance(IntEnum):
    """Where a value comes from."""

    LIVE = 0
    SIMULATED = 1
    REPLAYED = 2
    INJECTED = 3

    def __str__(self) -> str:
        return self.name.lower()


class Frame(NamedTuple):
    """A validated copy of one frame of a block. All times are in ns.

    ``raw`` is what the source delivered, in its own byte order, and ``provenance`` where that comes from; ``effective``
    is what consumers see, None while nothing is injected. ``publish_ns`` is CLOCK_MONOTONIC, or in its place what
    virtual time has made of it; ``clock_ns`` the instance's clock since its start, ``source_ns`` UTC. ``delay_us``: how
    old the image may have been already when it was published, the time of the device's answer; ``cycle`` counts the
    periods of the source's schedule, so frames of two incarnations of the source's process are told apart from frames
    that a reader lost, and then goes on with the steps. ``source_ns`` of a bad frame is that of the image it repeats;
    0: the source never had one, and the image is zeros.
    """

    number: int
    cycle: int
    publish_ns: int
    clock_ns: int
    source_ns: int
    incarnation: int
    quality: Quality
    provenance: Provenance
    event: int
    delay_us: int
    reason: str
    raw: bytes
    effective: bytes | None

    @property
    def image(self) -> bytes:
        """What consumers see: effective if there is one, else raw."""
        return self.raw if self.effective is None else self.effective

    def age_ns(self, now_ns: int) -> int:
        """The most that the image can be old: the time since the device was asked for it.

        ``now_ns``: of the clock that its block lives on, :meth:`Block.now_ns`.
        """
        return now_ns - self.publish_ns + 1000 * self.delay_us

    def assess(self, stale_ns: int, now_ns: int) -> tuple[Quality, str]:
        """Quality and reason as of then: a frame that is too old is never good."""
        if self.quality is not Quality.BAD:
            age_ns = self.age_ns(now_ns)
            if age_ns > stale_ns:
                return Quality.BAD, f"stale: no newer frame, this one is {age_ns / 1e9:.1f} s old"
        return self.quality, self.reason
