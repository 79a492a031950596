"""What programs learn of a snapshot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class SnapshotInfo:
    """A saved state of an instance.

    Attributes:
        name: Name of the snapshot.
        instance: Name of the instance that was saved.
        saved_s: UTC at which it was saved, in s since 1970.
        time_ns: The instance's clock, in ns.
        step: Number of the last step.
        size_bytes: Size of the file.
        left_out: What is not in the snapshot: the reason by process. Empty if nothing is missing.
        problem: Why the snapshot cannot be read; empty if it can. Then the other values are unknown.
    """

    name: str
    instance: str = ""
    saved_s: float = 0.0
    time_ns: int = 0
    step: int = 0
    size_bytes: int = 0
    left_out: Mapping[str, str] = field(default_factory=dict)
    problem: str = ""
