"""``shmio-dump cut``: write a part of a recording to a new file."""

from __future__ import annotations

import argparse

from shmio.cli.recordings.damage_report import DamageReport
from shmio.cli.recordings.rewriting import rewrite, verified
from shmio.cli.recordings.times import time_range
from shmio.cli.run import dumps, say
from shmio.recording.rewriting import part


def execute(arguments: argparse.Namespace) -> int:
    """Write the entries between two times, of some sources or registers, to a new file."""
    report = DamageReport()
    with report.open(arguments.files) as dump:
        from_ns, to_ns = time_range(arguments, dump.begin_ns)
        entries = part(dump, from_ns, to_ns, arguments.sources, arguments.only or ())
        work = rewrite(dump, arguments.output, "shmio-dump cut", entries, whole=False)
    verified_lines = verified(arguments.output)
    if arguments.json:
        print(dumps({"file": str(arguments.output), **work.counts, "damage": report.texts}, indent=2))
        return int(report.any)
    for line in verified_lines:
        say(line)
    say(f"  {work.counts['frames']} frames and {work.counts['events']} events")
    return int(report.any)
