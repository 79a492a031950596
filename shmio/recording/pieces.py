"""Read a recording as columns, in pieces that fit into memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from shmio.layout.model import Register
from shmio.recording.columns import Collector, Columns
from shmio.recording.dump import Dump
from shmio.recording.reading.blocks import DumpBlock
from shmio.recording.reading.part import MAX_NS

PIECE_BYTES: Final = 8 << 20


def pieces(
    dump: Dump,
    source: str,
    chosen: Mapping[DumpBlock, Sequence[Register]],
    from_ns: int = 0,
    to_ns: int = MAX_NS,
    *,
    raw: bool = False,
) -> Iterator[tuple[DumpBlock, Columns]]:
    """Yield the chosen registers of one source in order; each piece belongs to one block.

    Raises:
        PathError: There is no such source.
        RecordingError: A part of the recording cannot be read.
    """
    collector, of = Collector(source), None
    for block, batch in dump.batches(source, from_ns, to_ns, raw=raw):
        if block not in chosen:
            continue
        if of is not None and (block is not of or collector.bytes >= PIECE_BYTES):
            yield of, collector.columns()
        if block is not of:
            collector, of = Collector(source), block
        collector.add(block, chosen[block], batch)
    if of is not None:
        yield of, collector.columns()
