"""The invariants of injections: no value bypasses an injection, and an injection ends with its client."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Final

from shmio.model.values import OutcomeKind
from tests.faults.checks import Complain, Counts, Source
from tests.faults.write_checks import SURELY_NOT

LIFTED_NS: Final = 1_000_000_000
"""Maximum time until an injection is lifted after its client's end, unless it is to be kept."""


@dataclass
class GuardCheck:
    """Checks the word ``guarded``: written values, their replacements, and what the PLC got.

    A written value is even, and is written once. An injection replaces it by the next higher value.
    """

    source: Source
    complain: Complain
    counts: Counts = field(default_factory=Counts)
    _known: dict[int, OutcomeKind] = field(default_factory=dict)

    def written(self, value: int, kind: OutcomeKind, text: str, *, stood: bool, free: bool) -> None:
        """Check the outcome that a writer got.

        Args:
            value: The value.
            kind: The outcome.
            text: Text of the outcome.
            stood: Whether an injection covered the word during the whole write.
            free: Whether it is certain that no injection covered the word during the write.
        """
        self._known[value] = kind
        self.counts.values += 1
        if kind is OutcomeKind.WRITTEN and stood:
            self._say(f"{value} was written past the injection that covered the word")
        elif kind is OutcomeKind.TAKEN and free:
            self._say(f"{value} was taken, but there was no injection")
        elif kind not in SURELY_NOT | {OutcomeKind.WRITTEN, OutcomeKind.TAKEN, OutcomeKind.UNKNOWN}:
            self._say(f"{value} ended as {kind.name} ({text})")
        self.counts.good += kind is OutcomeKind.TAKEN

    def look(self, value: int) -> None:
        """Check whether the PLC got a value or its replacement, and forget earlier values."""
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
    """Checks how long an injection remains after its client has ended."""

    name: str
    keep: bool
    ended_ns: int
    complain: Complain
    _told: bool = False

    def look(self, now_ns: int, *, stands: bool, awake_since_ns: int, slack_ns: int, renewed: bool = False) -> None:
        """Check whether the injection may or must still exist.

        Args:
            now_ns: CLOCK_MONOTONIC.
            stands: Whether the injection exists.
            awake_since_ns: CLOCK_MONOTONIC since which all processes that must lift it run without a pause.
            slack_ns: Additional time on a loaded machine.
            renewed: Whether the block was replaced or the instance ended; both end kept injections.
        """
        if self._told or renewed:
            return
        for_ns = now_ns - max(self.ended_ns, awake_since_ns)
        if self.keep and not stands:
            self._tell("was to be kept, but is gone")
        elif not self.keep and stands and for_ns > LIFTED_NS + slack_ns:
            self._tell(f"still exists {for_ns / 1e9:.1f} s after its client's end")

    def _tell(self, problem: str) -> None:
        self._told = True
        self.complain(f"the injection {self.name} {problem}")


INNER: Final = "inner"
OUTER: Final = "outer"
SHOWN_NS: Final = 200_000_000
"""Maximum time until frames show a change of the injections."""
QUIET_NS: Final = 600_000_000
"""Time without a heartbeat (three are due in it) after which a process counts as paused."""


@dataclass
class ChainCheck:
    """Checks the word ``chained``, over which two clients inject. See :mod:`.chaining`.

    The inner client gives multiples of 4; the outer client adds 1.
    """

    source: Source
    complain: Complain
    counts: Counts = field(default_factory=Counts)
    _present: AbstractSet[str] | None = None
    _since_ns: int = 0
    _relayed: bool = False
    _missed_ns: dict[str, int] = field(default_factory=dict)

    def begin(self) -> None:
        """Begin with a new pair of clients."""
        self._missed_ns = {}

    def look(self, shown: int, publish_ns: int, now_ns: int, present: AbstractSet[str] | None) -> bool:
        """Check the newest frame; return whether it shows a value of the outer client.

        Args:
            shown: The value of the word.
            publish_ns: CLOCK_MONOTONIC when the frame was published.
            now_ns: CLOCK_MONOTONIC.
            present: The injections when the frame was read; None if they changed during the read.
        """
        if present is None or present != self._present:
            self._present, self._since_ns, self._relayed = present, now_ns, False
            return False
        self.counts.values += shown != 0
        outer = shown % 4 == 1
        settled = publish_ns > self._since_ns + SHOWN_NS
        if present == {INNER, OUTER}:
            if self._relayed and not outer:
                self._say(f"shows {shown}, which the inner injection gives, past the outer one")
            self._relayed |= outer
            self.counts.good += outer
            return outer
        if settled and present == {INNER} and outer:
            self._say(f"shows {shown}, which the outer injection gave, but only the inner one exists")
        if settled and not present and shown:
            self._say(f"shows {shown}, but there is no injection")
        return False

    def stay(self, laid: AbstractSet[str], present: AbstractSet[str], now_ns: int, undisturbed_ns: int) -> None:
        """Check that an injection remains until its client ends.

        Args:
            laid: The injections whose clients are alive.
            present: The injections that exist.
            now_ns: CLOCK_MONOTONIC.
            undisturbed_ns: CLOCK_MONOTONIC since which no fault has hit the processes that keep the injections.
        """
        self._missed_ns = {part: at_ns for part, at_ns in self._missed_ns.items() if part in laid - present}
        for part in laid - present:
            missed_ns = self._missed_ns.setdefault(part, now_ns)
            if now_ns - missed_ns > 2 * QUIET_NS and undisturbed_ns < missed_ns - QUIET_NS:
                self._say(f"the {part} injection is gone, but its client is alive")
                self._missed_ns[part] = now_ns

    def _say(self, problem: str) -> None:
        self.complain(f"{self.source.name}, chain: {problem}")
