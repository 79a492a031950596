"""What a program reads of a register."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shmio.layout.model import Register
    from shmio.layout.values.codec import Value
    from shmio.model.values import Quality


@dataclass(frozen=True, slots=True)
class Reading:
    """The state of one register at the time it was read.

    Attributes:
        source: Name of the source.
        register: The register or array element: its path within the source, type, dimensions and comment.
        value: The last known value, even while the quality is bad; None if there never was one.
        quality: Quality of the value.
        reason: Why the quality is not good; empty if it is.
        provenance: Where the value comes from: live, simulated, replayed or injected.
        source_time: The source's time stamp, UTC in s; None if there never was a value.
        age_s: Age of the value by the source's clock, in s; None if there never was a frame. In an update
            of a remote cell it is not known: 0, or None while the quality is bad.
    """

    source: str
    register: Register
    value: Value
    quality: Quality
    reason: str
    provenance: str
    source_time: float | None
    age_s: float | None

    @property
    def path(self) -> str:
        """Path of the register, with its source."""
        return f"{self.source}/{self.register.path}"
