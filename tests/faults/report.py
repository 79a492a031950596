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

{result} Seed {record.seed}, begun {record.begun_utc} UTC, {_duration(record.duration_s)}. \
shmio {__version__}, Python {platform.python_version()}, {host}.

{sum(record.faults.values())} faults in {record.rounds} rounds; {frames:,} frames and {values:,} values were compared \
with what the PLCs had. After a kill of its supervisor the instance was adopted {record.adopted} times and replaced \
{record.replaced} times. {record.mid_kills} writers were killed at full speed, {record.mid_torn} of them in the middle \
of a slot; {record.mid_frames:,} of their frames were read.

## Faults

Recovery: from the end of a round until all processes ran and every reader, local and remote, had newer good values;
counted for the kind that ended last.

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
        lines += ["", "## Steps", "", "Of the instance with stepped time.", "", "| | |", "|---|---|"]
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
