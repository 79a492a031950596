"""``shmio-dump merge``: join recordings of one run into one file."""

from __future__ import annotations

import argparse

from shmio.cli.recordings.damage_report import DamageReport
from shmio.cli.recordings.rewriting import rewrite, verified
from shmio.cli.run import say


def execute(arguments: argparse.Namespace) -> int:
    """Write the contents of all files to a new one, in the order of time and without duplicates."""
    report = DamageReport()
    with report.open(arguments.files) as dump:
        work = rewrite(dump, arguments.output, "shmio-dump merge", dump.items())
    for line in verified(arguments.output):
        say(line)
    say(f"  {work.counts['frames']} frames and {work.counts['events']} events of {len(arguments.files)} files")
    return int(report.any)
