"""The invariants of writes: what a writer is told, and what the PLC got. Each value is written once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from shmio.model.values import OutcomeKind
from tests.faults.checks import Complain, Counts, Source

SURELY_NOT = {OutcomeKind.REJECTED, OutcomeKind.REFUSED, OutcomeKind.EXPIRED}
"""Outcomes after which the device has never had the value."""


@dataclass
class _ValueCheck:
    """Of values toward one source."""

    source: Source
    complain: Complain
    counts: Counts = field(default_factory=Counts)

    def _since_ns(self, value: int) -> int | None:
        return None if self.source.landed is None else self.source.landed.since_ns(value)


@dataclass
class WriteCheck(_ValueCheck):
    """Holds what a writer is told of its values to what the PLC got; each value is written once."""

    _known: dict[int, tuple[OutcomeKind, int | None]] = field(default_factory=dict)

    def outcome(self, value: int, kind: OutcomeKind, text: str) -> None:
        """What the writer was told of ``value``."""
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
        """Look later: what was surely not sent does not come late, what was written does not come twice."""
        kind, before_ns = self._known[value]
        since_ns = self._since_ns(value)
        if kind is not OutcomeKind.UNKNOWN and since_ns != before_ns:
            self.complain(f"{self.source.name}: {value} was {kind.name}, and came to the PLC later, at {since_ns}")
        for old in [key for key in self._known if key < value]:
            del self._known[old]


LATE_NS = 6_500_000_000
"""How long after it was sent a published value may get to the PLC: its time-out of 2 s, and 4.5 s for two pauses."""


@dataclass
class PublishCheck(_ValueCheck):
    """Holds values sent by SimlogAPI v1 Publish, which tells no outcome, to what the PLC got: in time, and once."""

    _landed: dict[int, tuple[int, int | None]] = field(default_factory=dict)
    """When a value was sent, and when it got to the PLC."""

    def sent(self, value: int, now_ns: int) -> None:
        """A value leaves."""
        self._landed[value] = now_ns, None
        self.counts.values += 1

    def look(self, values: Sequence[int], *, slack_ns: int = 0) -> None:
        """See what has become of them, as often as one likes."""
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
        """Look no more at it and at those before it."""
        for old in [key for key in self._landed if key <= value]:
            del self._landed[old]
