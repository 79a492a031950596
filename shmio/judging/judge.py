"""Reaches verdicts on expectations from the frames of the sources that the expectations read."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from math import isfinite
from typing import Final

import numpy as np

from shmio.config import Expectation
from shmio.errors import ConfigError, PathError
from shmio.injection.program import number_register
from shmio.judging.expectation import Formula, read_expectations
from shmio.judging.formula import Network
from shmio.judging.operators import UNTIL_SHARE, Node, Tube
from shmio.judging.pieces import Piece
from shmio.judging.source import Frames, Rows, Signal, Source, Trouble
from shmio.judging.verdict import All, Outcome, TopLevel, TopLevelExtremum, Verdict
from shmio.layout.model import Layout, Register

AROUND: Final = 3
"""Number of values that a verdict shows before the moment of a failure, and also after it."""


Golden = Callable[[str, Sequence[Signal]], Sequence[Piece]]
"""Function that reads signals of a recording.

Its arguments are the file, as the campaign names it, and the signals. It returns the signals from
time 0 on. The last value of each is unknown (NaN), from the end of the recording on. The function
raises ConfigError if the recording cannot be read, or lacks a signal.
"""


class Judge:
    """Judges expectations while frames arrive, or from a recording.

    The judged time begins when every source that the expectations read has had a frame, and ends
    with the newest frame. You may add frames in portions of any size, and call :meth:`turn` at any
    time: the verdicts are the same.
    """

    def __init__(
        self,
        expectations: Sequence[Expectation],
        layouts: Mapping[str, Layout],
        stale_ns: Mapping[str, int],
        golden: Golden | None = None,
    ) -> None:
        """Read the expectations.

        Args:
            expectations: The expectations.
            layouts: The layout of each source.
            stale_ns: The age from which a frame of a source is stale, in ns.
            golden: Reads signals of recordings, for ``like``; None if no recordings can be read.

        Raises:
            ConfigError: An expectation is invalid; the message starts as ``expect[0].formula: …``.

        """
        formulas, registers = read_expectations(expectations, layouts)
        by_source: dict[str, dict[Signal, None]] = {}
        for formula in formulas:
            for signal in formula.signals:
                by_source.setdefault(signal.source, {})[signal] = None
        self._sources = {name: Source(name, tuple(found)) for name, found in by_source.items()}
        inputs: dict[Signal, Node] = {
            signal: node
            for source in self._sources.values()
            for signal, node in zip(source.signals, source.inputs, strict=True)
        }
        self.registers: Mapping[Signal, Register] = registers.found
        """The register of each signal."""
        self._network = Network(registers, inputs.__getitem__)
        self._cases = [_Case(at, formula, self._network, golden) for at, formula in enumerate(formulas)]
        horizon_ns = max((formula.horizon_ns for formula in formulas), default=0)
        self._histories = {name: _History(horizon_ns + 2 * horizon_ns // UNTIL_SHARE) for name in self._sources}
        self._origin_ns: int | None = None
        self.end_ns: int | None = None
        """End of the judged time, in ns; None before :meth:`finish`."""
        for name, source in self._sources.items():
            known = {signal.path: registers.found[signal] for signal in source.signals}
            source.follow(layouts[name], known, stale_ns[name])

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the sources that the expectations read."""
        return tuple(self._sources)

    @property
    def begin_ns(self) -> int | None:
        """Start of the judged time on the instance's clock, in ns; None until every source has had a frame."""
        return self._origin_ns

    def needs_raw(self, source: str) -> bool:
        """Return whether an expectation reads values of a source as delivered, without injections."""
        return self._sources[source].needs_raw

    def signals(self, source: str) -> tuple[Signal, ...]:
        """Return the signals of a source that the expectations read."""
        return self._sources[source].signals

    def read_by(self, index: int) -> tuple[Signal, ...]:
        """Return the signals that the expectation at this index reads."""
        return self._cases[index].formula.signals

    def limits(self, index: int, signal: Signal) -> tuple[Piece, Piece] | None:
        """Return the lower and the upper limit of a signal.

        Args:
            index: Index of the expectation.
            signal: A signal that the expectation reads.

        Returns:
            The limits; None if the expectation has no ``like``.
        """
        case = self._cases[index]
        return case.tubes[case.formula.signals.index(signal)].limits if case.tubes else None

    def troubles(self, source: str) -> Sequence[Trouble]:
        """Return the spans of time in which values of a source were unknown, and the reasons."""
        return self._sources[source].troubles

    def follow(self, name: str, layout: Layout, stale_ns: int) -> None:
        """Set the block that the next frames of a source come from; call this after a reload, for example.

        Values of registers that the block does not have are unknown.

        Args:
            name: Name of the source.
            layout: The layout of the block.
            stale_ns: Age in ns from which a frame is stale.
        """
        source = self._sources[name]
        found = {}
        for signal in source.signals:
            with suppress(PathError, ConfigError):
                found[signal.path] = number_register(f"{name}/{signal.path}", {name: layout})[1]
        source.follow(layout, found, stale_ns)

    def add(self, source: str, frames: Frames) -> None:
        """Add the next frames of a source."""
        self._sources[source].add(frames)

    def turn(self) -> dict[str, Rows]:
        """Judge the added frames as far as possible.

        Returns:
            The values of the signals that have become known, by source.
        """
        return self._turn(None)

    def finish(self) -> dict[str, Rows]:
        """Judge the rest, because no more frames will come.

        Returns:
            The same as :meth:`turn`.
        """
        self.end_ns = max((source.newest_ns for source in self._sources.values()), default=0) + 1
        for case in self._cases:
            case.finish(self.end_ns)
        return self._turn(self.end_ns)

    def _turn(self, end_ns: int | None) -> dict[str, Rows]:
        if self._origin_ns is None:
            firsts = [source.origin_ns for source in self._sources.values()]
            known = [first for first in firsts if first is not None]
            if len(known) < len(firsts):
                return {}
            self._origin_ns = max(known, default=0)
        rows = {}
        for name, source in self._sources.items():
            source.turn(self._origin_ns, end_ns)
            if len(source.rows.time):
                rows[name] = source.rows
                self._histories[name].add(source.rows)
        self._network.turn()
        for case in self._cases:
            case.turn()
            if case.failed and case.around_ns != case.top_level.decided_ns():
                found = self._around(case, final=end_ns is not None)
                if found is not None:
                    case.around, case.around_ns = found, case.top_level.decided_ns()
        return rows

    def _around(self, case: _Case, *, final: bool) -> dict[str, list[tuple[int, float | None]]] | None:
        """Return the values around the moment of a failure; None if some of them have not come yet."""
        moment_ns = case.top_level.decided_ns()
        found: dict[str, list[tuple[int, float | None]]] = {}
        for signal in case.formula.signals if moment_ns is not None else ():
            source, history = self._sources[signal.source], self._histories[signal.source]
            pairs = history.around(moment_ns or 0, source.signals.index(signal), final=final)
            if pairs is None:
                return None
            found[signal.name] = pairs
        return found

    @property
    def failed(self) -> bool:
        """True if an expectation has failed, whatever frames may follow."""
        return any(case.failed for case in self._cases)

    @property
    def verdicts(self) -> list[Verdict]:
        """The verdicts. Before :meth:`finish`, they follow from what is known so far."""
        return [self._verdict(case) for case in self._cases]

    def _verdict(self, case: _Case) -> Verdict:
        outer, formula = case.top_level, case.formula
        outcome, reason, moment_ns = Outcome.INCONCLUSIVE, "", None
        if case.failed:
            outcome, reason, moment_ns = Outcome.FAILED, formula.failure + _greatest_rate(case), outer.decided_ns()
        elif outer.low > 0 and not case.idle:
            outcome = Outcome.PASSED
        elif outer.low > 0:
            reason = f"{case.condition} never became true"
        else:
            reason = self._unknown(case)
        return Verdict(
            formula.expectation, outcome, reason, outer.low, outer.high, moment_ns, outer.extreme_ns, case.around
        )

    def _unknown(self, case: _Case) -> str:
        """Return why the truth of a formula is unknown."""
        names = dict.fromkeys(signal.source for signal in case.formula.signals)
        for name in names:
            if self._sources[name].origin_ns is None:
                return f"there was no frame of {name}"
        if self.end_ns is None:
            return "the run is not over"
        unknown_ns = case.top_level.unknown_ns()
        if unknown_ns is not None:
            reach_ns = case.formula.horizon_ns
            troubles = [
                trouble
                for name in names
                for trouble in self._sources[name].troubles
                if trouble.begin_ns <= unknown_ns + reach_ns and trouble.end_ns > unknown_ns - reach_ns
            ]
            if troubles:
                first = min(troubles)
                return f"{first.reason} from {first.begin_ns / 1e9:.3f} s to {first.end_ns / 1e9:.3f} s"
            if unknown_ns + reach_ns < self.end_ns:
                wide = any(self._sources[name].wide for name in names)
                what = "not a number, or too large to be compared exactly," if wide else "not a number"
                return f"a value was {what} at {unknown_ns / 1e9:.3f} s"
        return f"the run ended at {(self.end_ns - 1) / 1e9:.3f} s, before the expectation was decided"


def _greatest_rate(case: _Case) -> str:
    """Return the greatest rate in a failed expectation with ``max_rate``, as `` (up to 500)``; else an empty text."""
    limit, margin = case.formula.expectation.max_rate, case.top_level.high
    return "" if limit is None or not isfinite(margin) else f" (up to {limit - margin:g})"


def _tubes(index: int, formula: Formula, network: Network, golden: Golden | None) -> list[tuple[TopLevel, Tube]]:
    """Return the parts that compare the signals of an expectation with those of a recording.

    Raises:
        ConfigError: The recording cannot be read; the message starts as ``expect[0].like: …``.

    """
    one = formula.expectation
    try:
        if golden is None:
            raise ConfigError("no recordings can be read here")
        pieces = golden(one.like or "", formula.signals)
    except ConfigError as error:
        raise ConfigError(f'expect[{index}].like: {error} (expect "{one.name}")') from None
    tolerance_ns = round((one.tolerance_s or 0.0) * 1e9)
    return [
        network.like(signal, piece, one.tolerance or 0.0, tolerance_ns)
        for signal, piece in zip(formula.signals, pieces, strict=True)
    ]


class _Case:
    """The present state of an expectation."""

    def __init__(self, index: int, formula: Formula, network: Network, golden: Golden | None) -> None:
        self.formula = formula
        self.tubes: list[Tube] = []
        """For ``like``: the comparison of each signal."""
        if formula.tree is None:
            parts = _tubes(index, formula, network, golden)
            self.tubes = [tube for _, tube in parts]
            self.top_level: TopLevel = All([outer for outer, _ in parts])
        else:
            self.top_level = network.top_level(formula.tree)
        self._trigger: TopLevelExtremum | None = None
        if formula.trigger is not None:
            self._trigger = TopLevelExtremum(np.maximum, network.truth(formula.trigger), None)
        self.around: dict[str, list[tuple[int, float | None]]] = {}
        self.around_ns: int | None = None  # the moment to which they belong

    @property
    def failed(self) -> bool:
        """True if the expectation has failed, whatever follows."""
        return self.top_level.high < 0

    @property
    def idle(self) -> bool:
        """True if the expectation has a condition that has never become true."""
        return self._trigger is not None and self._trigger.high < 0

    @property
    def condition(self) -> str:
        """The condition, as text."""
        expectation = self.formula.expectation
        return expectation.when or expectation.stays or "the condition before 'implies'"

    def turn(self) -> None:
        """Read what has become known of the formula and of the condition."""
        self.top_level.turn()
        if self._trigger is not None:
            self._trigger.turn()

    def finish(self, end_ns: int) -> None:
        """Set the end of the judged time."""
        self.top_level.finish(end_ns)
        if self._trigger is not None:
            self._trigger.finish(end_ns)


class _History:
    """The last values of a source: as far back as a failure can be found, and a few more."""

    def __init__(self, horizon_ns: int) -> None:
        self._horizon_ns = horizon_ns
        self._rows: deque[Rows] = deque()

    def add(self, rows: Rows) -> None:
        """Add values, and drop old ones."""
        self._rows.append(rows)
        old_ns = int(rows.time[0]) - self._horizon_ns
        while len(self._rows) > 3 * AROUND and int(self._rows[3 * AROUND].time[-1]) < old_ns:
            self._rows.popleft()

    def around(self, moment_ns: int, index: int, *, final: bool) -> list[tuple[int, float | None]] | None:
        """Return times and values of a signal around a moment.

        None if some have not come yet; with ``final``, none will come, so return those that there are.
        """
        time = np.concatenate([rows.time for rows in self._rows]) if self._rows else np.empty(0, np.int64)
        at = int(time.searchsorted(moment_ns, "right"))
        if at + AROUND > len(time) and not final:
            return None
        values = np.concatenate([rows.exact(index) for rows in self._rows])
        part = slice(max(0, at - AROUND), at + AROUND)
        pairs = zip(time[part].tolist(), values[part].tolist(), strict=True)
        return [(time_ns, None if value != value else value) for time_ns, value in pairs]  # noqa: PLR0124  NaN
