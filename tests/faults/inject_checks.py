"""The invariants of injections: what goes past one toward the PLC, and how long one stands without its client."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Final

from shmio.model.values import OutcomeKind
from tests.faults.checks import Complain, Counts, Source
from tests.faults.write_checks import SURELY_NOT

LIFTED_NS: Final = 1_000_000_000
"""So long an injection may stand that nobody keeps, when its client is gone and who has to lift it is awake."""


@dataclass
class GuardCheck:
    """Holds the word that injections stand before to what was written and what they gave.

    A value that is written is even and is written once; an injection gives the next higher one in its place.
    """

    source: Source
    complain: Complain
    counts: Counts = field(default_factory=Counts)
    _known: dict[int, OutcomeKind] = field(default_factory=dict)

    def written(self, value: int, kind: OutcomeKind, text: str, *, stood: bool, free: bool) -> None:
        """What the writer of ``value`` was told. ``stood``: one injection stood all the while; ``free``: none could."""
        self._known[value] = kind
        self.counts.values += 1
        if kind is OutcomeKind.WRITTEN and stood:
            self._say(f"{value} was written past the injection that stood before it")
        elif kind is OutcomeKind.TAKEN and free:
            self._say(f"{value} was taken, but there was no injection")
        elif kind not in SURELY_NOT | {OutcomeKind.WRITTEN, OutcomeKind.TAKEN, OutcomeKind.UNKNOWN}:
            self._say(f"{value} ended as {kind.name} ({text})")
        self.counts.good += kind is OutcomeKind.TAKEN

    def look(self, value: int) -> None:
        """See what has come of it, and of what was given in its place; values before it are forgotten."""
        assert self.source.guarded is not None
        assert self.source.given is not None
        kind, landed_ns = self._known[value], self.source.guarded.since_ns(value)
        if landed_ns is not None and kind in SURELY_NOT | {OutcomeKind.TAKEN}:
            self._say(f"{value} was {kind.name}, but the PLC got it")
        if landed_ns is None and kind is OutcomeKind.WRITTEN:
            self._say(f"{value} was WRITTEN, but the PLC never got it")
        answer_ns, given_ns = self.source.guarded.since_ns(value + 1), self.source.given.since_ns(value + 1)
        if answer_ns is not None and (given_ns is None or given_ns > answer_ns):
            self._say(f"the PLC got {value + 1}, which no injection had given by then")
        for old in [key for key in self._known if key < value]:
            del self._known[old]

    def _say(self, problem: str) -> None:
        self.complain(f"{self.source.name}: {problem}")


@dataclass
class LifeCheck:
    """Holds one injection, whose client has ended, to how long it is to stand."""

    name: str
    keep: bool
    ended_ns: int
    complain: Complain
    _told: bool = False

    def look(self, now_ns: int, *, stands: bool, awake_since_ns: int, slack_ns: int, renewed: bool = False) -> None:
        """It stands, or not. ``awake_since_ns``: since when all who have to lift it run; ``renewed``: the block is new.

        A reload that makes the block anew, and the instance's own end, take what is kept with them.
        """
        if self._told or renewed:
            return
        for_ns = now_ns - max(self.ended_ns, awake_since_ns)
        if self.keep and not stands:
            self._tell("was to be kept, but is gone")
        elif not self.keep and stands and for_ns > LIFTED_NS + slack_ns:
            self._tell(f"still stands {for_ns / 1e9:.1f} s after its client's end")

    def _tell(self, problem: str) -> None:
        self._told = True
        self.complain(f"the injection {self.name} {problem}")


INNER: Final = "inner"
OUTER: Final = "outer"
SHOWN_NS: Final = 200_000_000
"""A frame that was published so long after what stands has changed shows that."""
QUIET_NS: Final = 600_000_000
"""Who has given no heartbeat for this long, three of them, has not run all the time."""


@dataclass
class ChainCheck:
    """Holds the word that two clients inject over to who of them stands; see :mod:`~tests.faults.chaining`.

    The inner one gives multiples of 4, and the outer one gives 1 more.
    """

    source: Source
    complain: Complain
    counts: Counts = field(default_factory=Counts)
    _standing: AbstractSet[str] | None = None
    _since_ns: int = 0
    _relayed: bool = False
    _missed_ns: dict[str, int] = field(default_factory=dict)

    def begin(self) -> None:
        """Another pair."""
        self._missed_ns = {}

    def look(self, shown: int, publish_ns: int, now_ns: int, standing: AbstractSet[str] | None) -> bool:
        """See the newest frame; whether it shows what the outer one gave.

        ``standing``: who stood before it was read and afterwards; None: that was not the same.
        """
        if standing is None or standing != self._standing:
            self._standing, self._since_ns, self._relayed = standing, now_ns, False
            return False
        self.counts.values += shown != 0
        outer = shown % 4 == 1
        settled = publish_ns > self._since_ns + SHOWN_NS
        if standing == {INNER, OUTER}:
            if self._relayed and not outer:
                self._say(f"shows {shown}, which the inner injection gives, past the outer one")
            self._relayed |= outer
            self.counts.good += outer
            return outer
        if settled and standing == {INNER} and outer:
            self._say(f"shows {shown}, which the outer injection gave, but only the inner one stands")
        if settled and not standing and shown:
            self._say(f"shows {shown}, but none stands")
        return False

    def stay(self, laid: AbstractSet[str], standing: AbstractSet[str], now_ns: int, undisturbed_ns: int) -> None:
        """Who was laid stands until its client ends; ``undisturbed_ns``: since when nobody who carries it was hit."""
        self._missed_ns = {part: at_ns for part, at_ns in self._missed_ns.items() if part in laid - standing}
        for part in laid - standing:
            missed_ns = self._missed_ns.setdefault(part, now_ns)
            if now_ns - missed_ns > 2 * QUIET_NS and undisturbed_ns < missed_ns - QUIET_NS:
                self._say(f"the {part} injection is gone, but its client is there")
                self._missed_ns[part] = now_ns

    def _say(self, problem: str) -> None:
        self.complain(f"{self.source.name}, chain: {problem}")
