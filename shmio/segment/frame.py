"""A frame: a consistent image of a whole block at one cycle."""

from __future__ import annotations

from typing import NamedTuple

from shmio.model.values import Provenance, Quality


class Frame(NamedTuple):
    """A validated copy of one frame of a block. All times are in ns.

    Attributes:
        number: Number of the frame in its ring, from 1.
        cycle: Period of the source's schedule; in virtual time the number of the step.
        publish_ns: CLOCK_MONOTONIC at publication, or a comparable time in virtual time.
        clock_ns: The instance's clock at publication.
        source_ns: The source's time stamp, UTC. A bad frame has that of the image it repeats; 0: the
            source never had an image, and the bytes are zeros.
        incarnation: Number of the source's process.
        quality: Quality of the image when it was published.
        provenance: Where the raw image comes from.
        event: Number of the last event before the frame.
        delay_us: Maximum age of the image when it was published: the time that the device took to answer.
        reason: Why the quality is not good.
        raw: The image that the source delivered, in its own byte order.
        effective: The image that consumers see; None while nothing is injected.
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
        """The image that consumers see: the effective one if there is one, else the raw one."""
        return self.raw if self.effective is None else self.effective

    def age_ns(self, now_ns: int) -> int:
        """Return the maximum age of the image: the time since the device was asked for it.

        Args:
            now_ns: The present time by the block's clock, :meth:`Block.now_ns`.
        """
        return now_ns - self.publish_ns + 1000 * self.delay_us

    def assess(self, stale_ns: int, now_ns: int) -> tuple[Quality, str]:
        """Return quality and reason at ``now_ns``: a frame older than ``stale_ns`` is bad."""
        if self.quality is not Quality.BAD:
            age_ns = self.age_ns(now_ns)
            if age_ns > stale_ns:
                return Quality.BAD, f"stale: no newer frame, this one is {age_ns / 1e9:.1f} s old"
        return self.quality, self.reason
