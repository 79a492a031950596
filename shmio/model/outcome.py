"""Outcomes of written and injected values."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class OutcomeKind(StrEnum):
    """Kind of outcome of a value."""

    WRITTEN = "written"
    """The device confirmed the value."""
    TAKEN = "taken"
    """An injection over ``/in`` took the value in the device's place."""
    SHADOWED = "shadowed"
    """Consumers see the value of an injection over ``/out``."""
    ACCEPTED = "accepted"
    """The source accepted the value; the caller did not wait for the device."""
    REJECTED = "rejected"
    """The source rejected the whole command before it did anything."""
    REFUSED = "refused"
    """The device refused the value."""
    EXPIRED = "expired"
    """The value was not sent to the device, and will not be."""
    UNKNOWN = "unknown"
    """The value was sent, or perhaps sent, but no answer came: read before you write again."""


DONE = frozenset({OutcomeKind.WRITTEN, OutcomeKind.TAKEN, OutcomeKind.SHADOWED, OutcomeKind.ACCEPTED})


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of one value.

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
        """Whether the value reached its target, or an injection took it."""
        return self.kind in DONE
