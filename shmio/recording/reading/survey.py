"""Surveys a recording without reading all of it, by the file's index or by the indexes of its chunks."""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from shmio.errors import RecordingError
from shmio.recording.format.encoding import GAP, Channel, Gap
from shmio.recording.format.records import BROKEN, FOOTER, HEAD, INDEX, MAX_RECORD_BYTES, U64, Record
from shmio.recording.reading.reader import Reader

MAX_CHUNKS: Final = 1 << 22
MAX_SETS: Final = 1 << 16
"""Maximum number of different sets of channels in the chunks of a file."""
MAX_GAPS: Final = 1000
"""Maximum number of gaps that a survey lists. It counts all gaps."""
MAX_DAMAGE: Final = 20
"""Largest number of damaged places that a survey lists."""
MAX_BLOCKS: Final = 10_000
MAX_SUMMARY_BYTES: Final = 64 << 20
"""Largest size of a file's summary, in bytes. It has about 90 bytes per chunk, so this suffices for a week."""

_MAX_U64: Final = (1 << 64) - 1
_ENTRY: Final = struct.Struct("<QQ")  # log time, offset
_CHUNK_INDEX: Final = struct.Struct("<QQQQI")  # first and last log time, start, length, size of the map that follows
_PLACE: Final = struct.Struct("<HQ")  # a channel, and the place of its message index or the number of its messages
_STATISTICS: Final = struct.Struct("<QHIIIIQQI")

_Times = npt.NDArray[np.uint64]


class Chunks:
    """A table of a file's chunks and damaged places, in order.

    A row takes about 40 bytes of memory.
    """

    def __init__(self) -> None:
        self._at = array("Q")
        self._size = array("Q")
        self._first_ns = array("Q")
        self._last_ns = array("Q")
        self._opcode = array("B")
        self._held = array("I")
        self._sets: dict[frozenset[int], int] = {}

    def __len__(self) -> int:
        return len(self._at)

    def add(self, chunk: Record, first_ns: int, last_ns: int, channels: Collection[int]) -> None:
        """Add the next chunk, with the log times of its first and last message, and its channels' numbers.

        Raises:
            RecordingError: There are more chunks than any recorder writes.
        """
        held = frozenset(channels)
        if len(self._at) >= MAX_CHUNKS or (held not in self._sets and len(self._sets) >= MAX_SETS):
            raise RecordingError(
                f"the file has more than {MAX_CHUNKS} chunks, or more than {MAX_SETS} combinations of channels"
            )
        self._opcode.append(chunk.opcode)
        self._held.append(self._sets.setdefault(held, len(self._sets)))
        self._at.append(chunk.at)
        self._size.append(chunk.size)
        self._first_ns.append(first_ns)
        self._last_ns.append(last_ns)

    def add_broken(self, record: Record) -> None:
        """Add damaged bytes after the last chunk.

        Raises:
            RecordingError: There are more chunks than any recorder writes.
        """
        at_ns = self._last_ns[-1] if self._last_ns else 0
        self.add(record, at_ns, at_ns, ())

    def between(
        self, from_ns: int, to_ns: int, channels: Collection[int] | None = None
    ) -> Iterator[tuple[Record, int, int]]:
        """Yield the chunks that may have messages in a range of log times.

        Each item is a chunk, and the log times of its first and last message. If ``channels`` is not
        None, only chunks with messages of any of these channels are yielded.
        """
        begin, end = self._bounds(from_ns, to_ns)
        yield from self._rows(range(begin, end), from_ns, to_ns, channels)

    def before(self, time_ns: int, channels: Collection[int] | None = None) -> Iterator[tuple[Record, int, int]]:
        """Yield the chunks that begin at or before a time, the last chunk first.

        The items and ``channels`` are as for :meth:`between`.
        """
        _, end = self._bounds(0, time_ns)
        yield from self._rows(range(end - 1, -1, -1), 0, time_ns, channels)

    def _rows(
        self, indices: range, from_ns: int, to_ns: int, channels: Collection[int] | None
    ) -> Iterator[tuple[Record, int, int]]:
        wanted = {number for held, number in self._sets.items() if channels is None or not held.isdisjoint(channels)}
        for index in indices:
            first_ns, last_ns = self._first_ns[index], self._last_ns[index]
            if self._held[index] in wanted and first_ns <= to_ns and last_ns >= from_ns:
                yield Record(self._opcode[index], self._at[index], self._size[index]), first_ns, last_ns

    def _bounds(self, from_ns: int, to_ns: int) -> tuple[int, int]:
        """Return a range of indices that includes all chunks in a range of log times.

        The range may include other chunks, because the times of adjacent chunks may overlap a
        little.
        """
        latest_ns, earliest_ns = self._sorted
        begin = int(np.searchsorted(latest_ns, np.uint64(min(max(from_ns, 0), _MAX_U64)), "left"))
        end = int(np.searchsorted(earliest_ns, np.uint64(min(max(to_ns, 0), _MAX_U64)), "right"))
        return begin, end

    @cached_property
    def _sorted(self) -> tuple[_Times, _Times]:
        """The latest time up to each chunk, and the earliest time from each chunk on; both ascend.

        They are computed once, when the table is complete.
        """
        first_ns: npt.NDArray[Any] = np.array(self._first_ns, np.uint64)
        last_ns: npt.NDArray[Any] = np.array(self._last_ns, np.uint64)
        return np.maximum.accumulate(last_ns), np.minimum.accumulate(first_ns[::-1])[::-1]


class Count(NamedTuple):
    """The number of a channel's messages in a chunk, and their first and last log time."""

    channel: int
    messages: int
    first_ns: int
    last_ns: int


@dataclass(slots=True)
class Track:
    """The number of a channel's messages in a file, and the time and chunk of the first and the last message."""

    channel: Channel
    count: int
    first_ns: int
    last_ns: int
    first_in: Record
    last_in: Record

    def numbers(self, reader: Reader) -> tuple[int, int]:
        """Return the numbers of the first and the last frame or event.

        Raises:
            RecordingError: The chunk with the first or the last one cannot be read.
        """
        return self._in(reader, self.first_in)[0], self.last(reader)

    def last(self, reader: Reader) -> int:
        """Return the number of the last frame or event.

        Raises:
            RecordingError: The chunk with this frame or event cannot be read.
        """
        return self._in(reader, self.last_in)[-1]

    def _in(self, reader: Reader, chunk: Record) -> list[int]:
        """Return the numbers of the channel's frames or events in a chunk.

        The result has at least one number.
        """
        found: list[int] = []
        try:
            for channel, _, data in reader.raw(chunk):
                if channel.number == self.channel.number and len(data) >= U64.size:
                    found.append(U64.unpack_from(data)[0])  # frames and events begin with their number
        except RecordingError:
            if not found:  # otherwise, only messages of other channels were damaged
                raise
        if not found:
            raise RecordingError(f"{reader.file}: {self.channel.topic}: an index refers to messages that do not exist")
        return found


@dataclass(slots=True)
class Survey:
    """The contents of a file: channels, chunks, gaps and damage."""

    tracks: dict[int, Track] = field(default_factory=dict)
    """The counts and times of messages, by the channel's number."""
    gaps: list[Gap] = field(default_factory=list)
    """The first gaps, at most ``MAX_GAPS``."""
    missed: dict[tuple[str, int, str], int] = field(default_factory=dict)
    """Number of missing frames or events, by source, block and kind."""
    missed_to: dict[tuple[str, int, str], int] = field(default_factory=dict)
    """Highest number of all missing frames or events, by source, block and kind."""
    gap_count: int = 0
    damage: list[str] = field(default_factory=list)
    """Messages about the parts of the file that could not be read."""
    chunks: Chunks = field(default_factory=Chunks)
    """All chunks of the file."""

    @property
    def begin_ns(self) -> int:
        """Log time of the first frame or event; 0 if there is none."""
        return min((track.first_ns for track in self.tracks.values() if track.channel.source), default=0)

    @property
    def end_ns(self) -> int:
        """Log time of the last frame or event; 0 if there is none."""
        return max((track.last_ns for track in self.tracks.values() if track.channel.source), default=0)

    def add_gap(self, gap: Gap) -> None:
        """Add a gap.

        Raises:
            RecordingError: More series of frames or events have gaps than any recorder writes.
        """
        key = (gap.source, gap.block, gap.what)
        if key not in self.missed and len(self.missed) >= MAX_BLOCKS:
            raise RecordingError(f"the file has gaps in more than {MAX_BLOCKS} series of frames or events")
        self.gap_count += 1
        self.missed[key] = self.missed.get(key, 0) + gap.count
        self.missed_to[key] = max(self.missed_to.get(key, 0), gap.last)
        if len(self.gaps) < MAX_GAPS:
            self.gaps.append(gap)


def survey(reader: Reader) -> Survey:
    """Survey a recording by going through the whole file, but reading few chunks; continue after damage.

    Raises:
        RecordingError: The file is not a recording of shmio.
    """
    found = Survey()
    chunk: Record | None = None
    counts: list[Count] | None = []
    for record in reader.records.walk():
        if record.opcode == Opcode.MESSAGE_INDEX:
            count = read_index(reader, record) if counts is not None else None
            counts = None if counts is None or count is None else [*counts, count]
            continue
        if chunk is not None:
            if record.opcode == BROKEN:  # it may be the rest of the chunk's indexes
                counts = None
            _settle(reader, found, chunk, counts)
            chunk = None
        if record.opcode == Opcode.CHUNK:
            chunk, counts = record, []
        else:
            if record.opcode == BROKEN:
                found.chunks.add_broken(record)
            try:
                reader.note(record)
            except RecordingError as error:
                _damaged(found, str(error))
    if chunk is not None:  # at the end of the file, indexes of the last chunk may be missing
        _settle(reader, found, chunk, None)
    if reader.summary_damage:
        _damaged(found, reader.summary_damage)
    reader.require_ours()
    reader.complete = True
    return found


def read_index(reader: Reader, record: Record) -> Count | None:
    """Read a message index; return None if it is invalid."""
    if not INDEX.size < record.size <= MAX_RECORD_BYTES or (record.size - INDEX.size) % _ENTRY.size:
        return None
    data = reader.records.read(record.at, record.size)
    channel, _ = INDEX.unpack_from(data)
    first_ns, _ = _ENTRY.unpack_from(data, INDEX.size)
    last_ns, _ = _ENTRY.unpack_from(data, record.size - _ENTRY.size)
    return Count(channel, (record.size - INDEX.size) // _ENTRY.size, first_ns, last_ns)


def _settle(reader: Reader, found: Survey, chunk: Record, counts: list[Count] | None) -> None:
    """Count the messages of a chunk by its indexes, or read the chunk if that is necessary."""
    if not counts or any(_must_read(reader, count.channel) for count in counts):
        counts = _read(reader, found, chunk)
    first_ns, last_ns = reader.records.chunk_times(chunk)
    found.chunks.add(chunk, first_ns, last_ns, [count.channel for count in counts])
    for count in counts:
        channel = reader.channels[count.channel]
        track = found.tracks.get(count.channel)
        if track is None:
            found.tracks[count.channel] = Track(channel, count.messages, count.first_ns, count.last_ns, chunk, chunk)
        else:
            track.count += count.messages
            track.last_ns, track.last_in = count.last_ns, chunk


def _damaged(found: Survey, why: str) -> None:
    if len(found.damage) < MAX_DAMAGE:
        found.damage.append(why)


def _must_read(reader: Reader, number: int) -> bool:
    channel = reader.channels.get(number)  # described in a chunk, which has a CRC, and not only in the summary
    return channel is None or channel.encoding == GAP


def _read(reader: Reader, found: Survey, chunk: Record) -> list[Count]:
    """Count the readable messages of a chunk."""
    counts: dict[int, Count] = {}
    try:
        for channel, log_ns, data in reader.raw(chunk):
            old = counts.get(channel.number, Count(channel.number, 0, log_ns, log_ns))
            counts[channel.number] = old._replace(messages=old.messages + 1, last_ns=log_ns)
            if channel.encoding == GAP:
                item = reader.decode(channel, data)
                if isinstance(item, Gap):
                    found.add_gap(item)
    except RecordingError as error:
        _damaged(found, str(error))
    return list(counts.values())


def survey_by_index(reader: Reader) -> Survey | None:
    """Survey a recording by its index; return None if the index is missing, damaged or wrong.

    The result is the same as that of :func:`survey`, in less time.
    """
    try:
        data = _summary(reader)
        return _IndexSurvey(reader).survey(data) if data else None
    except (RecordingError, struct.error, ValueError):
        return None


def _summary(reader: Reader) -> bytes:
    """Return the bytes of the summary; empty if the file has none or its CRC is wrong."""
    footer = reader.records.footer()
    if footer is None:
        return b""
    content = reader.records.read(footer.at, FOOTER.size)
    start, _, crc = FOOTER.unpack(content)
    if not 0 < start < footer.start or not crc:
        return b""
    data = reader.records.read(start, footer.start - start, MAX_SUMMARY_BYTES)
    head = reader.records.read(footer.start, footer.at - footer.start) + content[:-4]
    return data if zlib.crc32(head, zlib.crc32(data)) == crc else b""


class _IndexSurvey:
    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self._found = Survey()
        self._first: dict[int, tuple[Record, int]] = {}
        self._last: dict[int, tuple[Record, int]] = {}
        """Last chunk of each channel, and the offset of its message index; likewise ``_first``."""
        self._counts: dict[int, int] = {}
        self._chunk_count = -1

    def survey(self, data: bytes) -> Survey:
        for opcode, content in _records(data):
            if opcode == Opcode.CHUNK_INDEX:
                self._chunk(content)
            elif opcode == Opcode.STATISTICS:
                self._chunk_count = _STATISTICS.unpack_from(content)[5]
                self._counts = dict(_places(content, _STATISTICS.size))
            elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
                record = self._reader.records.record(struct.unpack_from("<Q", content)[0])
                if record is None:
                    raise ValueError
                self._reader.note(record)
        if self._chunk_count != len(self._found.chunks) or self._counts.keys() != self._first.keys():
            raise ValueError
        for number, (chunk, index) in self._first.items():
            self._track(number, chunk, index)
        self._reader.require_ours()
        self._reader.complete = self._reader.records.closed = True
        return self._found

    def _chunk(self, content: memoryview) -> None:
        first_ns, last_ns, start, length, _ = _CHUNK_INDEX.unpack_from(content)
        if length < HEAD.size or start + length > self._reader.records.size:
            raise ValueError
        chunk = Record(Opcode.CHUNK, start + HEAD.size, length - HEAD.size)
        places = list(_places(content, _CHUNK_INDEX.size))
        for number, index in places:
            self._first.setdefault(number, (chunk, index))
            self._last[number] = chunk, index
        self._found.chunks.add(chunk, first_ns, last_ns, [number for number, _ in places])

    def _track(self, number: int, chunk: Record, index: int) -> None:
        """Add the track of a channel.

        ``chunk`` is the channel's first chunk, and ``index`` is the offset of the channel's index
        there.

        Raises:
            RecordingError, ValueError: The message index is invalid.
        """
        reader = self._reader
        channel = reader.channel(number)
        last_chunk, last_index = self._last[number]
        records = reader.records.record(index), reader.records.record(last_index)
        first, last = (read_index(reader, record) if record else None for record in records)
        if channel is None or first is None or last is None or (first.channel, last.channel) != (number, number):
            raise ValueError
        count = self._counts[number]
        self._found.tracks[number] = Track(channel, count, first.first_ns, last.last_ns, chunk, last_chunk)
        if channel.encoding == GAP:
            self._gaps(number)

    def _gaps(self, number: int) -> None:
        for chunk, _, _ in self._found.chunks.between(0, _MAX_U64, [number]):
            for channel, _, data in self._reader.raw(chunk):
                if channel.number == number and isinstance(item := self._reader.decode(channel, data), Gap):
                    self._found.add_gap(item)


def _records(data: bytes) -> Iterator[tuple[int, memoryview]]:
    view, at = memoryview(data), 0
    while at < len(data):
        opcode, size = HEAD.unpack_from(data, at)
        at += HEAD.size
        if size > len(data) - at:
            raise ValueError
        yield opcode, view[at : at + size]
        at += size


def _places(content: memoryview, at: int) -> Iterator[tuple[int, int]]:
    """Yield the items of the map from channels to numbers that begins at ``at``.

    The length of the map in bytes precedes the map.
    """
    (size,) = struct.unpack_from("<I", content, at - 4)
    if size > len(content) - at or size % _PLACE.size:
        raise ValueError
    yield from _PLACE.iter_unpack(content[at : at + size])
