"""Read one file of a dump from any time on."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Final, TypeVar

from mcap.opcode import Opcode

from shmio.errors import RecordingError
from shmio.recording.format.damage import Damage, DamageLog
from shmio.recording.format.encoding import GAP, Gap
from shmio.recording.format.framing import FOOTER, HEAD
from shmio.recording.format.records import Record
from shmio.recording.reading.batch import Batch, batch, frames
from shmio.recording.reading.reader import Message, Reader
from shmio.recording.reading.survey import Survey, Track, read_index, survey
from shmio.segment.block import Frame

MAX_SUMMARY_BYTES: Final = 64 << 20
"""A chunk takes about 90 bytes of the summary, so that this is enough for a week."""

_CHUNK_INDEX: Final = struct.Struct("<QQQQI")  # first and last log time, start, length; bytes of the map that follows
_PLACE: Final = struct.Struct("<HQ")  # a channel and where its message index is, or how many messages it has
_STATISTICS: Final = struct.Struct("<QHIIIIQQI")


def survey_by_index(reader: Reader) -> Survey | None:
    """Survey a recording by its index; None if it has no intact and consistent index.

    The result is the same as that of :func:`~shmio.recording.reading.survey.survey`.
    """
    try:
        data = _summary(reader)
        return _Work(reader).survey(data) if data else None
    except (RecordingError, struct.error, ValueError):
        return None


def _summary(reader: Reader) -> bytes:
    """Return the summary's bytes if their CRC is right, else an empty object."""
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


class _Work:
    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self._found = Survey()
        self._first: dict[int, tuple[Record, int]] = {}
        self._last: dict[int, tuple[Record, int]] = {}
        """First and last chunk with messages of a channel, and places of their message indexes."""
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
        """Note the messages of a channel; RecordingError or ValueError if the index is wrong."""
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
        for chunk, _, _ in self._found.chunks.between(0, (1 << 64) - 1, [number]):
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
    """Yield the items of a map of channels to numbers; its length is before ``at``."""
    (size,) = struct.unpack_from("<I", content, at - 4)
    if size > len(content) - at or size % _PLACE.size:
        raise ValueError
    yield from _PLACE.iter_unpack(content[at : at + size])


MAX_NS: Final = (1 << 63) - 1

Damaged = Callable[[Path, Damage], object]
T = TypeVar("T")


class Part:
    """One file of a dump, with a survey of its contents.

    Raises:
        OSError: The file cannot be opened.
        RecordingError: The file is not a recording of shmio.
    """

    def __init__(self, file: Path, damaged: Damaged | None) -> None:
        """Open a file; call ``damaged`` for damage, or raise RecordingError there if it is None."""
        self.file = file
        self.reader = Reader(file)
        self._damaged = damaged
        try:
            found = survey_by_index(self.reader)
            self._indexed = found is not None
            self.found = found or survey(self.reader)
        except BaseException:
            self.reader.close()
            raise
        self.begin_ns, self.end_ns = self.found.begin_ns, self.found.end_ns

    def messages(self, channels: Collection[int], from_ns: int, to_ns: int) -> Iterator[Message]:
        """Yield the messages of channels in a range of log times, in file order."""
        records = (record for record, _, _ in self._chunks(from_ns, to_ns, channels))
        damaged = self._tell if self._damaged else None
        yield from self.reader.messages(
            lambda channel: channel.number in channels, max(from_ns, 0), to_ns, damaged, records
        )

    def messages_before(self, channels: Collection[int], time_ns: int) -> Iterator[list[Message]]:
        """Yield the messages up to a time, chunk by chunk, the last chunk first.

        Within a chunk, messages are in file order.
        """
        for record, _, _ in self.found.chunks.before(time_ns, self._sure(channels)):
            damaged = self._tell if self._damaged else None
            wanted = lambda channel: channel.number in channels  # noqa: E731
            yield list(self.reader.messages(wanted, 0, time_ns, damaged, [record]))

    def batches(self, number: int, size: int, from_ns: int, to_ns: int, *, raw: bool) -> Iterator[Batch]:
        """Yield the frames of a channel as arrays, chunk by chunk; ``size`` is that of an image."""
        channel = self.reader.channels[number]
        for found in self._each(
            channel.number, from_ns, to_ns, lambda data: batch(data, channel, size, from_ns, to_ns, raw=raw)
        ):
            if found is not None:
                yield found

    def frames(self, number: int, size: int, from_ns: int, to_ns: int) -> Iterator[tuple[int, Frame]]:
        """Yield the frames of a channel as objects, with their log times."""
        channel = self.reader.channels[number]
        for found in self._each(number, from_ns, to_ns, lambda data: frames(data, channel, size, from_ns, to_ns)):
            yield from found

    def _each(self, channel: int, from_ns: int, to_ns: int, decode: Callable[[bytes], T]) -> Iterator[T]:
        """Decode each chunk that may have messages of a channel in a range of log times."""
        log = DamageLog(self._tell)
        for record, first_ns, last_ns in self._chunks(from_ns, to_ns, [channel]):
            try:
                found = self._decoded(record, decode)
            except RecordingError as error:
                if self._damaged is None:
                    raise
                log.add(record, error)
                continue
            log.end(first_ns)
            yield found
            log.after(last_ns)
        log.end()

    def _decoded(self, record: Record, decode: Callable[[bytes], T]) -> T:
        if record.opcode != Opcode.CHUNK:
            self.reader.note(record)  # raises an error about the damage
        data = self.reader.records.unpacked(record)
        try:
            return decode(data)
        except RecordingError as error:
            raise RecordingError(f"{self.file}: the chunk at byte {record.at}: {error}") from None

    def _chunks(self, from_ns: int, to_ns: int, channels: Collection[int]) -> Iterator[tuple[Record, int, int]]:
        return self.found.chunks.between(from_ns, to_ns, self._sure(channels))

    def _sure(self, channels: Collection[int]) -> Collection[int] | None:
        """Return the channels if the summary has been checked, else None.

        The index of a single chunk has no CRC; it must not hide an intact chunk.
        """
        return channels if self._indexed else None

    def _tell(self, damage: Damage) -> None:
        if self._damaged:
            self._damaged(self.file, damage)

    def close(self) -> None:
        """Close the file."""
        self.reader.close()

    def __enter__(self) -> Part:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
