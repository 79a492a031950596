"""A recording as a program reads it: :func:`shmio.open_dump`."""

from __future__ import annotations

import heapq
import os
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from shmio.errors import RecordingError
from shmio.layout.model import Register
from shmio.recording.changes import Changes
from shmio.recording.columns import Collector, Columns
from shmio.recording.format.blocks import Contents, DumpBlock, contents
from shmio.recording.format.encoding import Gap
from shmio.recording.format.entries import Entry, batches_of, latest_of, messages_of
from shmio.recording.names import Names
from shmio.recording.reading.batch import Batch
from shmio.recording.reading.part import MAX_NS, Damaged, Part
from shmio.recording.reading.reader import Item, Reader
from shmio.recording.sequence import Sequence
from shmio.segment import Event, Frame

MAX_FILES: Final = 512
OVERLAP_NS: Final = 1_000_000_000
"""A recorder's file may begin so long before the one before it ends: a turn of the recorder, and more."""


def open_dump(files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], damaged: Damaged | None = None) -> Dump:
    """Open a recording: a file, or several of one run of an instance, in whatever order.

    Nothing is loaded: a file's index is read, or of one that was not closed the headers of its chunks.
    ``damaged(file, damage)`` is told of each place that cannot be read, and what is whole behind it follows; without it
    RecordingError is raised there.

    OSError, RecordingError: a file cannot be opened, is no recording, or not of the same run as the others.
    """
    paths = [Path(files)] if isinstance(files, str | os.PathLike) else [Path(file) for file in files]
    if not 0 < len(paths) <= MAX_FILES:
        raise RecordingError(f"{len(paths)} files: a dump is of 1 to {MAX_FILES}")
    parts: list[Part] = []
    try:
        parts += (Part(path, damaged) for path in paths)
        return Dump(parts)
    except BaseException:
        for part in parts:
            part.close()
        raise


class Dump:
    """A recording: one file, or several of one run. A context manager. All times are log times: ns, UTC.

    Iterators read on as they are asked, a chunk at a time; several may be at work at once, in one thread.
    """

    def __init__(self, parts: Iterable[Part]) -> None:
        """Use :func:`open_dump`. RecordingError: the files are of different runs."""
        self._parts = sorted(parts, key=lambda part: (part.begin_ns, part.end_ns))
        first = self._parts[0]
        self.about = first.reader.about
        """What the recorder of the first file said of the instance (docs/reference/dump-format.md)."""
        for part in self._parts[1:]:
            for key in ("instance", "epoch"):
                if part.reader.about.get(key) != self.about.get(key):
                    raise RecordingError(f"{first.file} and {part.file} are of different runs: open them one by one")
        blocks: dict[tuple[str, int, str], DumpBlock] = {}
        self._contents = [contents(part, blocks) for part in self._parts]
        self.blocks = tuple(blocks.values())
        """In the order in which they began."""
        self._names = Names(self.blocks)
        spans = [(part.begin_ns, part.end_ns) for part in self._parts if part.begin_ns]
        self.begin_ns = min((begin for begin, _ in spans), default=0)
        self.end_ns = max((end for _, end in spans), default=0)
        ends = [part.end_ns for part in self._parts]
        self._overlap = self._has_twice() or any(
            part.begin_ns < end - OVERLAP_NS for part, end in zip(self._parts[1:], ends, strict=False) if part.begin_ns
        )

    def _has_twice(self) -> bool:
        """Whether a file may have frames or events of a block that one before it has."""
        come_to: dict[tuple[DumpBlock, str], int] = {}
        for part, within in zip(self._parts, self._contents, strict=True):
            for number, block in within.blocks.items():
                key, after = (block, within.kinds[number]), part.reader.channels[number].after
                if after < come_to.get(key, 0):
                    return True
                track = part.found.tracks.get(number)
                come_to[key] = after + (track.count if track else 0)
        return False

    @property
    def files(self) -> tuple[Path, ...]:
        """In the order of time."""
        return tuple(part.file for part in self._parts)

    @property
    def readers(self) -> tuple[Reader, ...]:
        """Of the files, for what is not of a time: attachments."""
        return tuple(part.reader for part in self._parts)

    @property
    def instance(self) -> str:
        """Name of the instance."""
        return self.about.get("instance", "")

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the sources."""
        return self._names.sources

    @property
    def closed(self) -> bool:
        """Whether all files were closed in good order."""
        return all(part.reader.records.closed for part in self._parts)

    @property
    def gaps(self) -> list[Gap]:
        """What the recorders missed: of each file at most the first 1000. ``block`` is the number within the file."""
        return [gap for part in self._parts for gap in part.found.gaps]

    @property
    def damage(self) -> list[str]:
        """What was found damaged when the files were opened: a few texts."""
        return list(dict.fromkeys(text for part in self._parts for text in part.found.damage))

    # ---- one by one --------------------------------------------------------------------------------------------------

    def items(
        self, sources: str | Collection[str] | None = None, from_ns: int = 0, to_ns: int = MAX_NS
    ) -> Iterator[Entry[Item]]:
        """Everything of these sources, and of the instance, in recorded order; None: of all sources.

        What is in two files comes once; what is missing between two files comes as a gap. PathError: no such source.
        """
        wanted = self._names.several(sources)
        channels = [
            {*within.instance, *(number for number, block in within.blocks.items() if block.source in wanted)}
            for within in self._contents
        ]
        for entry in self._read(channels, from_ns, to_ns):
            if not isinstance(entry.item, Gap) or entry.item.source in wanted:
                yield entry

    def frames(self, source: str | None = None, from_ns: int = 0, to_ns: int = MAX_NS) -> Iterator[Entry[Frame]]:
        """Frames of a source, decoded; None if there is only one source. PathError."""
        name = self._names.one(source)
        if self._overlap:
            for time_ns, block, item in self._read([within.frames(name) for within in self._contents], from_ns, to_ns):
                if isinstance(item, Frame):
                    yield Entry(time_ns, block, item)
            return
        last: dict[DumpBlock, int] = {}
        for part, number, block in self._channels(name, from_ns, to_ns):
            before = last.get(block, 0)
            for time_ns, frame in part.frames(number, block.layout.size, from_ns, to_ns):
                if frame.number > before:
                    yield Entry(time_ns, block, frame)
                    last[block] = frame.number

    def events(
        self, sources: str | Collection[str] | None = None, from_ns: int = 0, to_ns: int = MAX_NS
    ) -> Iterator[Entry[Event]]:
        """Events of these sources; None: of all. Chunks without any are not read. PathError."""
        wanted = self._names.several(sources)
        for time_ns, block, item in self._read([within.events(wanted) for within in self._contents], from_ns, to_ns):
            if isinstance(item, Event):
                yield Entry(time_ns, block, item)

    def latest(self, source: str | None = None, time_ns: int = MAX_NS) -> Entry[Frame] | None:
        """The last frame of a source not after a time: what stood then. PathError."""
        name = self._names.one(source)
        found: Entry[Frame] | None = None
        for part, within in zip(reversed(self._parts), reversed(self._contents), strict=True):
            if part.begin_ns <= time_ns and (found is None or part.end_ns > found.time_ns):
                other = latest_of(part, within, name, time_ns)
                found = max((entry for entry in (found, other) if entry), key=lambda entry: entry.time_ns, default=None)
            if found is not None and not self._overlap:
                break
        return found

    def next_event(self, source: str | None = None, after_ns: int = -1) -> Entry[Event] | None:
        """The first event of a source, or of any, after a time. PathError."""
        return next(self.events(source, after_ns + 1), None)

    def next_change(self, path: str, after_ns: int = -1, to_ns: int = MAX_NS) -> Entry[Frame] | None:
        """The first frame after a time in which what consumers saw of a register, structure or pattern changed.

        None: it stays. PathError: there is no such register.
        """
        chosen = self._names.of_one_source(path)
        source = next(iter(chosen)).source
        changes = Changes(chosen)
        before = self.latest(source, after_ns)
        if before is not None and before.block is not None:
            changes.begin(before.block, before.item.image)
        for block, batch in self.batches(source, after_ns + 1, to_ns):
            at = changes.first(block, batch)
            if at is not None:
                number, time_ns = int(batch.head["number"][at]), int(batch.time_ns[at])
                return next(entry for entry in self.frames(source, time_ns) if entry.item.number == number)
        return None

    # ---- many at once ------------------------------------------------------------------------------------------------

    def batches(
        self, source: str | None = None, from_ns: int = 0, to_ns: int = MAX_NS, *, raw: bool = False
    ) -> Iterator[tuple[DumpBlock, Batch]]:
        """Frames of a source as arrays, chunk by chunk; PathError.

        Images are what consumers saw; with ``raw`` what the source delivered.
        """
        name = self._names.one(source)
        if self._overlap:  # one file may have what another missed
            yield from batches_of(self.frames(name, from_ns, to_ns), raw=raw)
            return
        last: dict[DumpBlock, int] = {}
        for part, number, block in self._channels(name, from_ns, to_ns):
            for found in part.batches(number, block.layout.size, from_ns, to_ns, raw=raw):
                batch = found[int((found.head["number"] <= last.get(block, 0)).sum()) :]
                if len(batch):
                    last[block] = int(batch.head["number"][-1])
                    yield block, batch

    def columns(
        self, paths: str | Iterable[str], from_ns: int = 0, to_ns: int = MAX_NS, *, raw: bool = False
    ) -> Columns:
        """Registers of one source as numpy arrays of their own types, one value for each frame.

        ``paths``: registers, elements, structures, globs. Blocks of the source that have none of them are left out.
        PathError: no such register, or of several sources; RecordingError: a reload changed the registers within this
        time.
        """
        chosen = self._names.of_one_source(paths)
        source = next(iter(chosen)).source
        collector = Collector(source)
        for block, batch in self.batches(source, from_ns, to_ns, raw=raw):
            if block in chosen:
                collector.add(block, chosen[block], batch)
        if not collector.begun:
            collector.begin(*next(iter(chosen.items())))
        return collector.columns()

    def select(self, paths: Iterable[str]) -> dict[DumpBlock, list[Register]]:
        """By block the registers that paths name, of whatever form, as :meth:`columns` takes them; PathError."""
        return self._names.select(paths)

    def _channels(self, source: str, from_ns: int, to_ns: int) -> Iterator[tuple[Part, int, DumpBlock]]:
        """Files and channels in them that may have frames of a source in a range of times, in order."""
        for part, within in zip(self._parts, self._contents, strict=True):
            if part.end_ns >= from_ns and part.begin_ns <= to_ns:
                for number in within.frames(source):
                    yield part, number, within.blocks[number]

    # ---- reading -----------------------------------------------------------------------------------------------------

    def _read(self, channels: Iterable[Collection[int]], from_ns: int, to_ns: int) -> Iterator[Entry[Item]]:
        parts = list(zip(self._parts, self._contents, channels, strict=True))
        streams = (
            messages_of(part, within, wanted, from_ns, to_ns)
            for part, within, wanted in parts
            if part.begin_ns <= to_ns and part.end_ns >= from_ns - OVERLAP_NS
        )
        sequence = Sequence()
        if self._overlap:
            ordered: Iterable[tuple[Contents, Entry[Item]]] = heapq.merge(*streams, key=lambda pair: pair[1].time_ns)
        else:
            ordered = (pair for stream in streams for pair in stream)
        for within, entry in ordered:
            if entry.block is None:
                yield entry
                continue
            gap, item = sequence.next(within, entry.block, entry.time_ns, entry.item)
            if gap is not None:
                yield Entry(entry.time_ns, entry.block, gap)
            if item is not None:
                yield Entry(entry.time_ns, entry.block, item)

    def close(self) -> None:
        """Close the files."""
        for part in self._parts:
            with suppress(OSError):
                part.close()

    def __enter__(self) -> Dump:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
