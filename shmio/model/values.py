"""Values as programs read and write them: quality, provenance, readings, and outcomes of writes."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING, Final

import msgspec

if TYPE_CHECKING:
    from shmio.layout.model import Register
    from shmio.layout.values.codec import Value


NO_WRITER: Final = 0xFFFFFFFF
"""Takes the place of the number of a command queue, if no program gave the command."""


WRITERS: Final[Mapping[str, int]] = {"grpc": 4, "mqtt": 5, "opcua": 6, "fabric": 7}
"""For each process of the instance that sends commands: the number of its command queue.

The keys are the names of the processes, which are also their kinds.
"""
ROLES: Final[Mapping[int, str]] = {writer: name for name, writer in WRITERS.items()}
PID_SHIFT: Final = 40
"""Number of bits of a command's number below the pid of its sender, which has at most 22 bits: proc(5)."""


def pid_of(number: int) -> int:
    """Return the pid of the process that sent a command, from the command's number."""
    return number >> PID_SHIFT


class Quality(IntEnum):
    """Quality of a value, as in OPC UA (OPC 10000-8, section 6.3). Zero is bad."""

    BAD = 0
    UNCERTAIN = 1
    GOOD = 2

    def __str__(self) -> str:
        return self.name.lower()


class Provenance(IntEnum):
    """Origin of a value."""

    LIVE = 0
    SIMULATED = 1
    REPLAYED = 2
    INJECTED = 3

    def __str__(self) -> str:
        return self.name.lower()


class Column(IntEnum):
    """The array in which a client stores values of a type.

    The number of a column is the number of the array's field in the message ``Values`` of shmio.v1.
    """

    BOOL = 1
    INT32 = 2
    INT64 = 3
    UINT64 = 4
    FLOAT = 5
    DOUBLE = 6
    TEXT = 7


class Reading(msgspec.Struct, frozen=True):
    """State of one register when it was read.

    Attributes:
        source: Name of the source.
        register: The register or array element, with its path within the source, type, dimensions
            and comment.
        value: The last known value, even while the quality is bad; None if there never was a value.
        quality: Quality of the value.
        reason: Reason why the quality is not good; empty if it is good.
        provenance: Where the value comes from: live, simulated, replayed or injected.
        source_time: The source's time stamp, UTC in s; None if there never was a value.
        age_s: Age of the value by the source's clock, in s; None if there never was a frame. In
            updates of a remote cell, the age is unknown, and ``age_s`` is 0, or None while the
            quality is bad.
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
        """Path of the register, including its source."""
        return f"{self.source}/{self.register.path}"


WRITE_TIMEOUT_S: Final = 2.0
WRITE_MIN_PERIODS: Final = 3
"""By default, a write may wait for this number of cycles, or for WRITE_TIMEOUT_S if that is longer."""


class OutcomeKind(StrEnum):
    """Outcome of a written value."""

    WRITTEN = "written"
    """The device confirmed the value."""
    TAKEN = "taken"
    """An injection over ``/in`` took the value, so the device did not get it."""
    SHADOWED = "shadowed"
    """An injection over ``/out`` got the value, and consumers see it."""
    ACCEPTED = "accepted"
    """The source accepted the value; the caller did not wait for the device."""
    REJECTED = "rejected"
    """The source rejected the whole command before it did anything."""
    REFUSED = "refused"
    """The device refused the value."""
    EXPIRED = "expired"
    """The value was not sent to the device, and will not be."""
    UNKNOWN = "unknown"
    """The value was or may have been sent, but no answer came: read before you write again."""


_DONE = frozenset({OutcomeKind.WRITTEN, OutcomeKind.TAKEN, OutcomeKind.SHADOWED, OutcomeKind.ACCEPTED})


class Outcome(msgspec.Struct, frozen=True):
    """The outcome of one written value.

    Attributes:
        path: Path of the register.
        kind: Kind of outcome.
        text: The reason, if there is one.
    """

    path: str
    kind: OutcomeKind
    text: str = ""

    @property
    def done(self) -> bool:
        """True if the value reached its target, or an injection took it."""
        return self.kind in _DONE
