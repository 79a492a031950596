"""A run's report, as Markdown."""

from __future__ import annotations

import os
import platform
import statistics

from shmio import __version__
from tests.faults.schedule import WEIGHTS
from tests.faults.suite import Record


def write(record: Record) -> str:
    """Write the report of a run."""
    frames = sum(counts.frames for counts in record.counts.values())
    values = sum(counts.values for counts in record.counts.values())
    result = "**No violation.**" if not record.violated else f"**{record.violated} violations**, see the end."
    host = f"{platform.system()} {platform.release()} {platform.machine()}, {len(os.sched_getaffinity(0))} cores"
    lines = f"""# Fault suite: report

{result} The run with seed {record.seed} began on {record.begun_utc} UTC, and took {_duration(record.duration_s)}. \
It tested shmio {__version__} with Python {platform.python_version()} on {host}.

The suite caused {sum(record.faults.values())} faults in {record.rounds} rounds. It compared {frames:,} frames and \
{values:,} values with what the PLCs had.

The suite also counted what happened after two kinds of kills:

- Supervisors: the next supervisor adopted the instance's processes {record.adopted} times, and replaced them \
{record.replaced} times.
- Writers at full speed: {record.mid_kills} were killed, {record.mid_torn} of them in the middle of a slot. Readers \
had read {record.mid_frames:,} of their frames.

## Faults

The recovery of a round is the time from its end until all processes ran, and every reader, local and remote, had newer
good values. The table counts it for the kind of fault that ended last in the round.

| kind | times | recovery, s: median | max |
|---|---|---|---|""".splitlines()
    for kind in [*WEIGHTS, *sorted(record.faults.keys() - WEIGHTS.keys())]:
        if record.faults[kind]:
            took = record.recoveries[kind]
            figures = f"{statistics.median(took):.2f} | {max(took):.2f}" if took else "- | -"
            lines.append(f"| {kind} | {record.faults[kind]} | {figures} |")
    lines += ["", "## Readers", "", "| reader | frames | missed | good | values |", "|---|---|---|---|---|"]
    for name, counts in sorted(record.counts.items()):
        lines.append(f"| {name} | {counts.frames:,} | {counts.missed:,} | {counts.good:,} | {counts.values:,} |")
    lines += ["", "## Processes", "", "| process | private MB, max | descriptors, max |", "|---|---|---|"]
    lines += [f"| {name} | {peak[0]:.0f} | {peak[1]} |" for name, peak in sorted(record.peaks.items())]
    if record.steps:
        lines += [
            "",
            "## Steps",
            "",
            "These steps are those of the instance with stepped time.",
            "",
            "| | |",
            "|---|---|",
        ]
        lines += [f"| {what} | {count:,} |" for what, count in sorted(record.steps.items())]
    if record.violations:
        lines += ["", "## Violations"]
    for violation in record.violations:
        lines += ["", "```text", violation, "```"]
    return "\n".join(lines) + "\n"


def _duration(duration_s: float) -> str:
    minutes, seconds = divmod(round(duration_s), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min {seconds:02d} s"
