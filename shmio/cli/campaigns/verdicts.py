"""Prints verdicts, and turns them into an exit status."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from math import isfinite
from typing import Any, Final

import msgspec

from shmio.cli.campaigns.reports import attempt
from shmio.cli.common import give_up_if_broken, say, say_json
from shmio.judging.judge import Judge
from shmio.judging.verdict import Outcome, Verdict, distance, number_text

UNDECIDED: Final = 3
STATUSES: Final = {Outcome.PASSED: 0, Outcome.FAILED: 1, Outcome.INCONCLUSIVE: UNDECIDED}


def exit_status(verdicts: Sequence[Verdict]) -> int:
    """Return 1 if any expectation failed, else 3 if any is inconclusive, else 0."""
    outcomes = {verdict.outcome for verdict in verdicts}
    worst = (Outcome.FAILED, Outcome.INCONCLUSIVE, Outcome.PASSED)
    return STATUSES[next((outcome for outcome in worst if outcome in outcomes), Outcome.PASSED)]


def tell(judge: Judge, found: dict[str, Any], *, as_json: bool) -> int:
    """Print all verdicts, and return the exit status, which does not depend on the terminal.

    Args:
        judge: The judge, after the end of the run.
        found: Further keys of the JSON object.
        as_json: Whether to print one JSON object instead of lines of text.
    """
    verdicts = judge.verdicts
    fault = attempt(lambda: (_say_json if as_json else _say_lines)(judge, verdicts, found), "the verdicts")
    fault = give_up_if_broken(sys.stdout) or fault
    if fault:
        say(f"standard output: {fault}", sys.stderr)
    return exit_status(verdicts)


def _say_json(judge: Judge, verdicts: Sequence[Verdict], found: dict[str, Any]) -> None:
    begin, end = judge.begin_ns, judge.end_ns
    times = {
        "begin_s": None if begin is None else begin / 1e9,
        "end_s": None if begin is None or end is None else (end - 1) / 1e9,
    }
    say_json({**found, **times, "verdicts": [as_table(verdict) for verdict in verdicts]})


def _say_lines(_judge: Judge, verdicts: Sequence[Verdict], _found: dict[str, Any]) -> None:
    width = max((len(verdict.expectation.name) for verdict in verdicts), default=0)
    for verdict in verdicts:
        for line in lines(verdict, width):
            say(line)
    counts = [f"{sum(one.outcome is outcome for one in verdicts)} {outcome}" for outcome in Outcome]
    say(", ".join(counts))


def as_table(verdict: Verdict) -> dict[str, Any]:
    """Return a verdict as a JSON object. Times are instance times, in s."""
    expectation = msgspec.to_builtins(verdict.expectation)
    return {
        "name": verdict.expectation.name,
        "outcome": str(verdict.outcome),
        "reason": verdict.reason,
        "robustness": verdict.robustness,
        "low": distance(verdict.low),
        "high": distance(verdict.high),
        "moment_s": _seconds(verdict.moment_ns),
        "closest_s": _seconds(verdict.extreme_ns),
        "around": {
            name: [{"time_s": _seconds(time_ns), "value": _value(value)} for time_ns, value in pairs]
            for name, pairs in verdict.around.items()
        },
        "severity": verdict.expectation.severity,
        "requirement": verdict.expectation.requirement,
        "text": verdict.expectation.text,
        "expectation": expectation,
    }


def lines(verdict: Verdict, width: int = 0) -> list[str]:
    """Return a verdict as lines of text. ``width`` is the width of the column of names, in characters."""
    expectation = verdict.expectation
    of = f" [{expectation.requirement}]" if expectation.requirement else ""
    robustness = "" if verdict.robustness is None else f"  robustness {verdict.robustness:.6g}"
    at = "" if verdict.moment_ns is None else f" at {verdict.moment_ns / 1e9:.3f} s"
    why = f"  {verdict.reason}{at}" if verdict.reason else ""
    lines = [f"{verdict.outcome:<12}  {expectation.name:<{width}}{of}{robustness}{why}"]
    for name, pairs in verdict.around.items():
        values = "  ".join(
            f"{time_ns / 1e9:.3f}: {'?' if value is None else number_text(value, 9)}" for time_ns, value in pairs
        )
        lines.append(f"{'':<14}{name}  {values}")
    return lines


def _value(value: float | None) -> float | str | None:
    """Return a value for JSON, which has no infinity."""
    return value if value is None or isfinite(value) else f"{'-' if value < 0 else ''}Infinity"


def _seconds(time_ns: int | None) -> float | None:
    return None if time_ns is None else time_ns / 1e9
