"""Judges expectations over a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from shmio.config import Expectation
from shmio.errors import RecordingError
from shmio.judging.judge import Judge
from shmio.judging.source import Frames, Rows
from shmio.recording.dump import Dump
from shmio.recording.reading.batch import Batch
from shmio.recording.reading.part import MAX_NS, DumpBlock


def recording_judge(dump: Dump, expectations: Sequence[Expectation]) -> Judge:
    """Return a judge of the sources of a recording.

    Raises:
        ConfigError: An expectation is invalid; the message starts as ``expect[0].formula: …``.
        RecordingError: The recording has no source.

    """
    blocks = _first_blocks(dump)
    if not blocks:
        raise RecordingError(f"{dump.files[0]}: it has no source")
    layouts = {source: block.layout for source, block in blocks.items()}
    return Judge(expectations, layouts, {source: block.stale_ns for source, block in blocks.items()})


def judge_recording(
    dump: Dump,
    judge: Judge,
    from_ns: int = 0,
    to_ns: int = MAX_NS,
    seen: Callable[[Mapping[str, Rows]], None] = lambda _rows: None,
) -> None:
    """Judge a recording, chunk by chunk.

    Args:
        dump: The recording.
        judge: A new judge of it.
        from_ns: Start of the range, log time.
        to_ns: End of the range, log time.
        seen: Called with the values of the signals, by source, in order.

    """
    blocks = _first_blocks(dump)
    readers = {source: _batches(dump, judge, source, from_ns, to_ns) for source in judge.sources}
    come_to = dict.fromkeys(readers, -1)
    while readers:
        source = min(readers, key=come_to.__getitem__)  # the sources keep step, so that little has to wait
        found = next(readers[source], None)
        if found is None:
            del readers[source]
            continue
        block, frames = found
        if block is not blocks[source]:
            judge.follow(source, block.layout, block.stale_ns)
            blocks[source] = block
        judge.add(source, frames)
        come_to[source] = int(frames.clock_ns[-1])
        seen(judge.turn())
    seen(judge.finish())


def _first_blocks(dump: Dump) -> dict[str, DumpBlock]:
    blocks: dict[str, DumpBlock] = {}
    for block in dump.blocks:
        blocks.setdefault(block.source, block)
    return blocks


def _batches(dump: Dump, judge: Judge, source: str, from_ns: int, to_ns: int) -> Iterator[tuple[DumpBlock, Frames]]:
    """Yield the frames of a source, chunk by chunk."""
    effective = dump.batches(source, from_ns, to_ns)
    if not judge.needs_raw(source):
        for block, batch in effective:
            yield block, _frames(batch, None)
        return
    for (block, batch), (_, delivered) in zip(effective, dump.batches(source, from_ns, to_ns, raw=True), strict=True):
        yield block, _frames(batch, delivered)


def _frames(batch: Batch, delivered: Batch | None) -> Frames:
    head = batch.head
    number, clock_ns, quality, delay_us = (
        np.ascontiguousarray(head[name]) for name in ("number", "clock_ns", "quality", "delay_us")
    )
    return Frames(number, clock_ns, quality, delay_us, batch.images, None if delivered is None else delivered.images)
