"""Judges whether a recording meets expectations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from shmio.config import Expectation
from shmio.errors import ConfigError, PathError, RecordingError
from shmio.injection.program import number_register
from shmio.judging.judge import Golden, Judge
from shmio.judging.pieces import Piece
from shmio.judging.source import Frames, Rows, Signal, Source
from shmio.recording.dump import Dump, open_dump
from shmio.recording.reading.batch import Batch
from shmio.recording.reading.part import MAX_NS, DumpBlock

MAX_GOLDEN: Final = 20_000_000
"""Maximum number of values to read from a recording that expectations name with the key ``like``."""


def recording_judge(dump: Dump, expectations: Sequence[Expectation], golden: Golden | None = None) -> Judge:
    """Return a judge of expectations for the sources of a recording. ``golden`` is as for :class:`Judge`.

    Raises:
        ConfigError: An expectation is invalid; the message starts like ``expect[0].formula: …``.
        RecordingError: The recording has no source.

    """
    blocks = _first_blocks(dump)
    layouts = {source: block.layout for source, block in blocks.items()}
    return Judge(expectations, layouts, {source: block.stale_ns for source, block in blocks.items()}, golden)


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
        judge: A new judge for this recording, from :func:`recording_judge`.
        from_ns: Start of the range, log time in ns.
        to_ns: End of the range, log time in ns.
        seen: Called with the values of the signals in each chunk, by source, in the order of time.

    """
    blocks: dict[str, DumpBlock] = _first_blocks(dump)
    raws = {source: judge.needs_raw(source) for source in judge.sources}
    for source, block, frames in _frames_of(dump, raws, from_ns, to_ns):
        if block is not blocks[source]:
            judge.follow(source, block.layout, block.stale_ns)
            blocks[source] = block
        judge.add(source, frames)
        seen(judge.turn())
    seen(judge.finish())


class GoldenRecordings:
    """Reads signals from the recordings that expectations name with the key ``like``."""

    def __init__(self, folder: Path) -> None:
        """Create the reader. Names of files are relative to ``folder``."""
        self._folder = folder

    def __call__(self, name: str, signals: Sequence[Signal]) -> list[Piece]:
        """Return signals of a recording; times start at 0. See :data:`shmio.judging.judge.Golden`.

        Raises:
            ConfigError: The recording cannot be read, is too long, or does not have a signal.

        """
        file = self._folder / name
        try:
            with open_dump(file) as dump:
                return list(self._read(dump, name, signals))
        except OSError as error:
            raise ConfigError(f"{file}: {error.strerror}") from None
        except RecordingError as error:
            raise ConfigError(str(error)) from None

    def _read(self, dump: Dump, name: str, signals: Sequence[Signal]) -> Iterator[Piece]:
        sources: dict[str, Source] = {}
        rows: dict[str, list[Rows]] = {}
        blocks = _first_blocks(dump)
        for source in dict.fromkeys(signal.source for signal in signals):
            if source not in blocks:
                raise ConfigError(f"{name} has no source {source}")
            sources[source] = Source(source, [signal for signal in signals if signal.source == source])
            rows[source] = []
            _follow(sources[source], blocks[source], name)
        for source, block, frames in _frames_of(dump, dict.fromkeys(sources, False)):
            if block is not blocks[source]:
                _follow(sources[source], block, name)
                blocks[source] = block
            sources[source].add(frames)
            if sum(one.frames * len(one.signals) for one in sources.values()) > MAX_GOLDEN:
                raise ConfigError(f"{name} is too long: it has more than {MAX_GOLDEN} values of these signals")
        if empty := [source for source, one in sources.items() if one.origin_ns is None]:
            raise ConfigError(f"{name} has no frame of {', '.join(empty)}")
        begins = [one.origin_ns for one in sources.values() if one.origin_ns is not None]
        begin_ns, end_ns = max(begins), max(one.newest_ns for one in sources.values()) + 1
        for one in sources.values():
            one.turn(begin_ns, end_ns)
        for signal in signals:
            one = sources[signal.source]
            found = one.inputs[one.signals.index(signal)].out
            yield found._replace(time=found.time - begin_ns)


def _follow(source: Source, block: DumpBlock, name: str) -> None:
    found = {}
    for signal in source.signals:
        try:
            found[signal.path] = number_register(f"{source.name}/{signal.path}", {source.name: block.layout})[1]
        except PathError as error:
            raise ConfigError(f"{name}: {error}") from None
    source.follow(block.layout, found, block.stale_ns)


def _first_blocks(dump: Dump) -> dict[str, DumpBlock]:
    """Return the first block of each source; raise RecordingError if there is no source."""
    blocks: dict[str, DumpBlock] = {}
    for block in dump.blocks:
        blocks.setdefault(block.source, block)
    if not blocks:
        raise RecordingError(f"{dump.files[0]}: it has no source")
    return blocks


def _frames_of(
    dump: Dump, raws: Mapping[str, bool], from_ns: int = 0, to_ns: int = MAX_NS
) -> Iterator[tuple[str, DumpBlock, Frames]]:
    """Yield the frames of some sources, chunk by chunk. The frames of each source are in order.

    ``raws`` says, for each source, whether to also read the images without injections.
    """
    readers = {source: _batches(dump, source, from_ns, to_ns, raws=need) for source, need in raws.items()}
    come_to = dict.fromkeys(readers, -1)
    while readers:
        source = min(readers, key=come_to.__getitem__)  # the source that is furthest behind
        found = next(readers[source], None)
        if found is None:
            del readers[source]
            continue
        block, frames = found
        come_to[source] = int(frames.clock_ns[-1])
        yield source, block, frames


def _batches(dump: Dump, source: str, from_ns: int, to_ns: int, *, raws: bool) -> Iterator[tuple[DumpBlock, Frames]]:
    """Yield the frames of a source, chunk by chunk."""
    effective = dump.batches(source, from_ns, to_ns)
    if not raws:
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
