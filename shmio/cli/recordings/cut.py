"""``shmio-dump cut``: a part of a recording as a new one."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from shmio.cli.recordings.damage_report import DamageReport
from shmio.cli.recordings.rewriting import rewrite, verified
from shmio.cli.recordings.times import span, time_range
from shmio.cli.run import dumps, say
from shmio.errors import RecordingError
from shmio.layout.model import Register
from shmio.layout.topic import holder
from shmio.layout.values.write import covering
from shmio.recorder.selection import RecordedRegisters
from shmio.recording.dump import Dump
from shmio.recording.format.blocks import DumpBlock
from shmio.recording.format.entries import Entry
from shmio.recording.reading.reader import Item
from shmio.segment import Frame


class Parts:
    """Blocks of a dump with some of their registers; all other bytes are zero."""

    def __init__(self, dump: Dump, paths: Sequence[str]) -> None:
        """PathError: no such register. An element stands for its array."""
        self._parts = {block: _part(block, registers) for block, registers in dump.select(paths).items()}

    @property
    def sources(self) -> list[str]:
        """Of these registers."""
        return list(dict.fromkeys(block.source for block in self._parts))

    def of(self, entry: Entry[Item]) -> Entry[Item] | None:
        """An entry as it would be; None: it is of a block that has none of the registers."""
        if entry.block is None:
            return entry
        if entry.block not in self._parts:
            return None
        block, part = self._parts[entry.block]
        item = entry.item
        return Entry(entry.time_ns, block, part.keep(item) if isinstance(item, Frame) else item)


def _part(block: DumpBlock, registers: Sequence[Register]) -> tuple[DumpBlock, RecordedRegisters]:
    """The block with these registers alone, and what makes its frames."""
    paths = {holder(block.layout, register) for register in registers}
    whole = tuple(register for register in block.layout.registers if register.path in paths)
    layout = replace(block.layout, registers=whole)
    part = RecordedRegisters(layout, np.frombuffer(covering(whole, layout.size), np.uint8))
    digest = layout.hash.hex()
    of = "" if digest == block.layout_hash else block.of or block.layout_hash
    return replace(block, layout=layout, layout_hash=digest, of=of), part


def execute(arguments: argparse.Namespace) -> int:
    """Write what lies between two times, of some sources or registers, to a new file."""
    report = DamageReport()
    with report.open(arguments.files) as dump:
        from_ns, to_ns = time_range(arguments, dump.begin_ns)
        parts = Parts(dump, arguments.only) if arguments.only else None
        work = rewrite(
            dump, arguments.output, "shmio-dump cut", _entries(dump, arguments, parts, from_ns, to_ns), whole=False
        )
    verified_lines = verified(arguments.output)
    if arguments.json:
        print(dumps({"file": str(arguments.output), **work.counts, "damage": report.texts}, indent=2))
        return int(report.any)
    for line in verified_lines:
        say(line)
    say(f"  {work.counts['frames']} frames and {work.counts['events']} events")
    return int(report.any)


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
