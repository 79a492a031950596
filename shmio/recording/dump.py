"""Reads recordings; programs start with :func:`shmio.open_dump`."""

from __future__ import annotations

import heapq
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import numpy.typing as npt

from shmio.errors import PathError, RecordingError
from shmio.layout.model import Register
from shmio.layout.topic import Topic, parse_topic
from shmio.recording.columns import Collector, Columns
from shmio.recording.format.encoding import Gap, Reason
from shmio.recording.reading.batch import Batch
from shmio.recording.reading.part import (
    MAX_NS,
    Contents,
    Damaged,
    DumpBlock,
    Entry,
    Part,
    batches_of,
    contents,
    latest_of,
    messages_of,
)
from shmio.recording.reading.reader import Item, Reader
from shmio.segment import Event, Frame
from shmio.segment.changed_registers import runs
from shmio.wording import name_one, unknown

MAX_FILES: Final = 512
OVERLAP_NS: Final = 1_000_000_000
"""Maximum time in ns by which two consecutive files of a recorder overlap."""

Chosen = dict[DumpBlock, list[Register]]


def open_dump(files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], damaged: Damaged | None = None) -> Dump:
    """Open a recording that consists of one file, or of several files of one run in any order.

    Opening reads only the index of each file, or the headers of the chunks if the file was not
    closed.

    Args:
        files: The path of a file, or the paths of several files.
        damaged: Called with the file and the damage for each place that cannot be read; reading then
            continues after this place. None: reading such a place raises RecordingError.

    Returns:
        The recording, a context manager.

    Raises:
        OSError: A file cannot be opened.
        RecordingError: A file is not a recording, or the files come from different runs.
    """
    paths = [Path(files)] if isinstance(files, str | os.PathLike) else [Path(file) for file in files]
    if not 0 < len(paths) <= MAX_FILES:
        raise RecordingError(f"a recording has 1 to {MAX_FILES} files, but {len(paths)} are given")
    parts: list[Part] = []
    try:
        parts += (Part(path, damaged) for path in paths)
        return Dump(parts)
    except BaseException:
        for part in parts:
            part.close()
        raise


class Dump:
    """An open recording of one file, or of several files of one run.

    All times are log times (UTC in ns). A range of time includes both ``from_ns`` and ``to_ns``.
    Use the recording as a context manager, or call :meth:`close`. Iterators read one chunk at a
    time, on demand. You may use several iterators at once, in one thread.
    """

    def __init__(self, parts: Iterable[Part]) -> None:
        """Open the files. Call :func:`open_dump` instead.

        Raises:
            RecordingError: The files come from different runs.
        """
        self._parts = sorted(parts, key=lambda part: (part.begin_ns, part.end_ns))
        first = self._parts[0]
        self.about = first.reader.about
        """The metadata about the instance, from the first file (docs/reference/dump-format.md)."""
        for part in self._parts[1:]:
            for key in ("instance", "epoch"):
                if part.reader.about.get(key) != self.about.get(key):
                    raise RecordingError(f"{first.file} and {part.file} come from different runs; open them separately")
        blocks: dict[tuple[str, int, str], DumpBlock] = {}
        self._contents = [contents(part, blocks) for part in self._parts]
        self.blocks = tuple(blocks.values())
        """The blocks in the order in which they began."""
        self._names = _Names(self.blocks)
        spans = [(part.begin_ns, part.end_ns) for part in self._parts if part.begin_ns]
        self.begin_ns = min((begin for begin, _ in spans), default=0)
        self.end_ns = max((end for _, end in spans), default=0)
        ends = [part.end_ns for part in self._parts]
        self._overlap = self._has_twice() or any(
            part.begin_ns < end - OVERLAP_NS for part, end in zip(self._parts[1:], ends, strict=False) if part.begin_ns
        )

    def _has_twice(self) -> bool:
        """Return whether any file may repeat frames or events of an earlier file."""
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
        """The paths of the files, in the order of time."""
        return tuple(part.file for part in self._parts)

    @property
    def readers(self) -> tuple[Reader, ...]:
        """The readers of the files. Use them to read attachments."""
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
        """True if the recorder has closed all files."""
        return all(part.reader.records.closed for part in self._parts)

    @property
    def gaps(self) -> list[Gap]:
        """The gaps in the files, at most 1000 of each file.

        The field ``block`` of a gap is the number of the block in the file that has the gap.
        """
        return [gap for part in self._parts for gap in part.found.gaps]

    @property
    def damage(self) -> list[str]:
        """Messages about the damage that was found when the files were opened."""
        return list(dict.fromkeys(text for part in self._parts for text in part.found.damage))

    # ---- single entries ----------------------------------------------------------------------------------------------

    def items(
        self, sources: str | Collection[str] | None = None, from_ns: int = 0, to_ns: int = MAX_NS
    ) -> Iterator[Entry[Item]]:
        """Iterate over all entries of some sources and of the instance, in recorded order.

        If two files have the same entry, the iterator yields it once. If entries are missing
        between two files, it yields a gap.

        Args:
            sources: Names of the sources; None for all.
            from_ns: Start of the range, log time in ns.
            to_ns: End of the range, log time in ns.

        Raises:
            PathError: There is no such source.
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
        """Iterate over the frames of a source.

        Args:
            source: Name of the source; None if there is only one.
            from_ns: Start of the range, log time in ns.
            to_ns: End of the range, log time in ns.

        Raises:
            PathError: There is no such source.
        """
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
        """Iterate over the events of some sources, reading only the chunks that have events.

        Args:
            sources: Names of the sources; None for all.
            from_ns: Start of the range, log time in ns.
            to_ns: End of the range, log time in ns.

        Raises:
            PathError: There is no such source.
        """
        wanted = self._names.several(sources)
        for time_ns, block, item in self._read([within.events(wanted) for within in self._contents], from_ns, to_ns):
            if isinstance(item, Event):
                yield Entry(time_ns, block, item)

    def latest(self, source: str | None = None, time_ns: int = MAX_NS) -> Entry[Frame] | None:
        """Return the last frame of a source at or before a time.

        Args:
            source: Name of the source; None if there is only one.
            time_ns: The log time in ns; default: the end of the recording.

        Returns:
            The frame; None if the source has no frame at or before this time.

        Raises:
            PathError: There is no such source.
        """
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
        """Return the first event after a time; None if no event follows.

        Args:
            source: Name of the source; None for any source.
            after_ns: The log time in ns; default: the start of the recording.

        Raises:
            PathError: There is no such source.
        """
        return next(self.events(source, after_ns + 1), None)

    def next_change(self, path: str, after_ns: int = -1, to_ns: int = MAX_NS) -> Entry[Frame] | None:
        """Return the first frame after ``after_ns`` in which readers saw a register of a path change.

        Args:
            path: A register, a structure or a pattern of one source.
            after_ns: Log time in ns after which to search.
            to_ns: Log time in ns at which the search ends.

        Returns:
            The frame; None if there is no change.

        Raises:
            PathError: There is no such register.
        """
        chosen = self._names.of_one_source(path)
        source = next(iter(chosen)).source
        changes = _Changes(chosen)
        before = self.latest(source, after_ns)
        if before is not None and before.block is not None:
            changes.begin(before.block, before.item.image)
        for block, batch in self.batches(source, after_ns + 1, to_ns):
            at = changes.first(block, batch)
            if at is not None:
                number, time_ns = int(batch.head["number"][at]), int(batch.time_ns[at])
                return next(entry for entry in self.frames(source, time_ns) if entry.item.number == number)
        return None

    # ---- arrays ------------------------------------------------------------------------------------------------------

    def batches(
        self, source: str | None = None, from_ns: int = 0, to_ns: int = MAX_NS, *, raw: bool = False
    ) -> Iterator[tuple[DumpBlock, Batch]]:
        """Iterate over the frames of a source as arrays, one chunk at a time.

        Args:
            source: Name of the source; None if there is only one.
            from_ns: Start of the range, log time in ns.
            to_ns: End of the range, log time in ns.
            raw: True for the images that the source delivered, without injections; False for the
                images that readers saw.

        Raises:
            PathError: There is no such source.
        """
        name = self._names.one(source)
        if self._overlap:  # a file may have entries that the other one lacks
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
        """Read registers of one source as numpy arrays, with one value for each frame.

        The arrays have the types of the registers, and are all in memory. Frames of blocks without
        any of these registers are left out.

        Args:
            paths: Registers, elements, structures or patterns.
            from_ns: Start of the range, log time in ns.
            to_ns: End of the range, log time in ns.
            raw: True for the values that the source delivered, without injections; False for the
                values that readers saw.

        Returns:
            Arrays of shape (n, …) by path, for n frames, with their times and qualities.

        Raises:
            PathError: There is no such register, or the registers belong to several sources.
            RecordingError: A reload changed the registers within the range.
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
        """Return the registers that paths name, by block. Give paths as for :meth:`columns`.

        Raises:
            PathError: There is no such register.
        """
        return self._names.select(paths)

    def _channels(self, source: str, from_ns: int, to_ns: int) -> Iterator[tuple[Part, int, DumpBlock]]:
        """Yield the channels that may have frames of a source in a range of time, in order.

        Each item is a file, the number of the channel, and its block.
        """
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
        sequence = _FileJoin()
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


class _Names:
    """Finds the sources and registers of a recording by name."""

    def __init__(self, blocks: Sequence[DumpBlock]) -> None:
        self._blocks = blocks
        self.sources = tuple(dict.fromkeys(block.source for block in blocks))

    def one(self, name: str | None) -> str:
        """Check and return the name of a source.

        If ``name`` is None, return the name of the only source.

        Raises:
            PathError: There is no such source; or ``name`` is None, and there is not exactly one
                source.
        """
        if name is None and len(self.sources) == 1:
            return self.sources[0]
        if name not in self.sources:
            raise PathError(name_one("source", self.sources) if name is None else unknown("source", name, self.sources))
        return name

    def several(self, names: str | Collection[str] | None) -> set[str]:
        """Check and return the names of sources.

        If ``names`` is None, return the names of all sources.

        Raises:
            PathError: There is no such source.
        """
        if names is None:
            return set(self.sources)
        return {self.one(name) for name in ([names] if isinstance(names, str) else names)}

    def select(self, paths: Iterable[str]) -> Chosen:
        """Return the registers that the paths name, by block.

        Raises:
            PathError: There is no such register.
        """
        default = self.sources[0] if len(self.sources) == 1 else None
        chosen: dict[DumpBlock, dict[str, Register]] = {}
        for path in paths:
            topic = parse_topic(path, self.sources, default)
            if topic.direction == "in":
                raise PathError(f"{path}: a recording has only the outputs of a source; leave out /in")
            for block, registers in self._named(path, topic).items():
                chosen.setdefault(block, {}).update((register.path, register) for register in registers)
        return {block: list(chosen[block].values()) for block in self._blocks if block in chosen}

    def of_one_source(self, paths: str | Iterable[str]) -> Chosen:
        """Return the registers of one source that the paths name, by block.

        Raises:
            PathError: There is no such register, or the registers belong to several sources.
        """
        chosen = self.select([paths] if isinstance(paths, str) else paths)
        sources = sorted({block.source for block in chosen})
        if len(sources) != 1:
            raise PathError(
                f"these registers belong to {' and '.join(sources) or 'no source'}; "
                "choose registers of one source at a time"
            )
        return chosen

    def _named(self, path: str, topic: Topic) -> Chosen:
        """Return the registers that a topic names, by block. Blocks may have different layouts."""
        found: Chosen = {}
        problem = PathError(f"{path}: this recording has no such register")
        for block in self._blocks:
            if block.source == topic.source:
                try:
                    registers = block.named(topic)
                except PathError as error:
                    problem = error
                else:
                    if registers:
                        found[block] = registers
        if not found:
            raise problem
        return found


class _FileJoin:
    """Joins the frames and events of several files by their numbers.

    It leaves out duplicates, and finds gaps between files.
    """

    def __init__(self) -> None:
        self._last: dict[tuple[DumpBlock, str], tuple[Contents, int, int]] = {}
        """The file, number and log time of the last frame or event, by block and kind."""

    def next(self, file: Contents, block: DumpBlock, time_ns: int, item: Item) -> tuple[Gap | None, Item | None]:
        """Return the gap before an item, if any, and the item.

        The item is None if an earlier file has it. If the item is a gap that an earlier file has in
        part, only the remaining part of the gap is returned.
        """
        if isinstance(item, Gap):
            what, first, last = item.what, item.first, item.last
        elif isinstance(item, Frame | Event):
            what = "frames" if isinstance(item, Frame) else "events"
            first = last = item.number
        else:
            return None, item
        before = self._last.get((block, what))
        if before is not None:
            file_before, number, before_ns = before
            if last <= number:
                return None, None
            if first <= number and isinstance(item, Gap):
                first = number + 1
                item = msgspec.structs.replace(item, first=first, count=last - number)
        self._last[block, what] = file, last, time_ns
        if before is None or first == number + 1 or file_before is file:
            return None, item
        missing = first - number - 1
        place = block.source, file.number[block], what
        return Gap(*place, number + 1, first - 1, missing, Reason.ELSEWHERE, before_ns, time_ns), item


_Bytes = npt.NDArray[np.uint8]


def _register_bytes(registers: Sequence[Register]) -> tuple[npt.NDArray[np.intp], _Bytes]:
    """Return the offset and the mask of each byte of an image that has bits of these registers."""
    places: list[int] = []
    masks: list[int] = []
    for register in registers:
        for offset, size, mask in runs(register):
            places += range(offset, offset + size)
            masks += [mask or 0xFF] * size
    return np.array(places, np.intp), np.array(masks, np.uint8)


class _Changes:
    """Compares each frame with the previous one, in the bytes of the chosen registers."""

    def __init__(self, chosen: Mapping[DumpBlock, Sequence[Register]]) -> None:
        self._bytes = {block: _register_bytes(registers) for block, registers in chosen.items()}
        self._before: dict[DumpBlock, npt.NDArray[Any]] = {}

    def begin(self, block: DumpBlock, image: bytes) -> None:
        """Set the image with which to compare the first frame of a block."""
        if block in self._bytes:
            self._before[block] = self._of(block, np.frombuffer(image, np.uint8)[None, :])[0]

    def _of(self, block: DumpBlock, images: _Bytes) -> _Bytes:
        places, masks = self._bytes[block]
        found: _Bytes = images[:, places] & masks
        return found

    def first(self, block: DumpBlock, batch: Batch) -> int | None:
        """Return the index of the first frame that differs from the frame before it, or None.

        If :meth:`begin` was not called, the first frame of a block counts as unchanged.
        """
        if block not in self._bytes:
            return None
        now = self._of(block, batch.images)
        before = np.concatenate((self._before.get(block, now[0])[None, :], now[:-1]))
        self._before[block] = now[-1]
        changed = (now != before).any(axis=1)
        return int(changed.argmax()) if changed.any() else None
