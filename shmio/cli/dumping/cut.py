"""``shmio-dump cut``: a part of a recording as a new one."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from shmio.cli.dumping.complaints import Complaints
from shmio.cli.dumping.moments import span, time_range
from shmio.cli.dumping.parts import Parts
from shmio.cli.dumping.rewriting import rewrite, verified
from shmio.cli.run import dumps, say
from shmio.dump.dump import Dump
from shmio.dump.entries import Entry
from shmio.dump.reader import Item
from shmio.errors import RecordingError


def execute(arguments: argparse.Namespace) -> int:
    """Write what lies between two times, of some sources or registers, to a new file."""
    complaints = Complaints()
    with complaints.open(arguments.files) as dump:
        from_ns, to_ns = time_range(arguments, dump.begin_ns)
        parts = Parts(dump, arguments.only) if arguments.only else None
        work = rewrite(
            dump, arguments.output, "shmio-dump cut", _entries(dump, arguments, parts, from_ns, to_ns), whole=False
        )
    verified_lines = verified(arguments.output)
    if arguments.json:
        print(dumps({"file": str(arguments.output), **work.counts, "damage": complaints.texts}, indent=2))
        return int(complaints.any)
    for line in verified_lines:
        say(line)
    say(f"  {work.counts['frames']} frames and {work.counts['events']} events")
    return int(complaints.any)


def _entries(
    dump: Dump, arguments: argparse.Namespace, parts: Parts | None, from_ns: int, to_ns: int
) -> Iterator[Entry[Item]]:
    sources = arguments.sources
    if parts is not None:
        sources = parts.sources if sources is None else [source for source in parts.sources if source in sources]
    anything = False
    for entry in dump.items(sources, from_ns, to_ns):
        anything = True
        if parts is None:
            yield entry
        elif (part := parts.of(entry)) is not None:
            yield part
    if not anything and not dump.begin_ns:
        raise RecordingError(f"{dump.files[0]}: nothing is recorded in it")
    if not anything:
        raise RecordingError(f"nothing of {dump.files[0]} is in that time; it goes {span(dump.begin_ns, dump.end_ns)}")
