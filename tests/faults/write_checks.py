"""The invariants of writes: the reported outcome agrees with what the PLC got."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from shmio.model.values import OutcomeKind
from tests.faults.checks import Complain, Counts, Source

SURELY_NOT = {OutcomeKind.REJECTED, OutcomeKind.REFUSED, OutcomeKind.EXPIRED}
"""Outcomes after which the device must not have got the value."""


@dataclass
class _ValueCheck:
    """The common part of the checks of values written to one source."""

    source: Source
    complain: Complain
    counts: Counts = field(default_factory=Counts)

    def _since_ns(self, value: int) -> int | None:
        return None if self.source.landed is None else self.source.landed.since_ns(value)


@dataclass
class WriteCheck(_ValueCheck):
    """Compares the outcomes that a writer gets with what the PLC got. Values are written once."""

    _known: dict[int, tuple[OutcomeKind, int | None]] = field(default_factory=dict)

    def outcome(self, value: int, kind: OutcomeKind, text: str) -> None:
        """Check the outcome of a value."""
        since_ns = self._since_ns(value)
        self._known[value] = kind, since_ns
        self.counts.values += 1
        if kind is OutcomeKind.WRITTEN:
            self.counts.good += 1
            if since_ns is None:
                self.complain(f"{self.source.name}: {value} was reported as written, but the PLC never got it")
            else:
                self.counts.since_ns = max(self.counts.since_ns, since_ns)
        elif kind in SURELY_NOT and since_ns is not None:
            self.complain(f"{self.source.name}: {value} was reported as {kind.name} ({text}), but the PLC got it")
        elif kind is not OutcomeKind.UNKNOWN and kind not in SURELY_NOT:
            self.complain(f"{self.source.name}: {value} ended as {kind.name}")

    def again(self, value: int) -> None:
        """Check a value again later: it must not have reached the PLC late or twice."""
        kind, before_ns = self._known[value]
        since_ns = self._since_ns(value)
        if kind is not OutcomeKind.UNKNOWN and since_ns != before_ns:
            self.complain(f"{self.source.name}: {value} was {kind.name}, and came to the PLC later, at {since_ns}")
        for old in [key for key in self._known if key < value]:
            del self._known[old]


LATE_NS = 6_500_000_000
"""Maximum time until a published value reaches the PLC: time-out 2 s, and 4.5 s for two pauses."""


@dataclass
class PublishCheck(_ValueCheck):
    """Checks that values sent by SimlogAPI v1 ``Publish`` reach the PLC in time and once, or never.

    ``Publish`` reports no outcome.
    """

    _landed: dict[int, tuple[int, int | None]] = field(default_factory=dict)
    """Times at which each value was sent, and at which the PLC got it."""

    def sent(self, value: int, now_ns: int) -> None:
        self._landed[value] = now_ns, None
        self.counts.values += 1

    def look(self, values: Sequence[int], *, slack_ns: int = 0) -> None:
        """Check whether and when the PLC got these values. It may be called repeatedly."""
        for value in values:
            sent_ns, before_ns = self._landed[value]
            since_ns = self._since_ns(value)
            if before_ns is not None and since_ns != before_ns:
                self.complain(f"{self.source.name}: {value} came to the PLC at {before_ns} and again at {since_ns}")
            elif since_ns is not None and since_ns > sent_ns + LATE_NS + slack_ns:
                late_s = (since_ns - sent_ns) / 1e9
                self.complain(f"{self.source.name}: {value} came to the PLC {late_s:.1f} s after it was sent")
            elif since_ns is not None:
                self.counts.good += before_ns is None
                self.counts.since_ns = max(self.counts.since_ns, since_ns)
            self._landed[value] = sent_ns, since_ns

    def forget(self, value: int) -> None:
        """Stop checking this value and earlier ones."""
        for old in [key for key in self._landed if key <= value]:
            del self._landed[old]
