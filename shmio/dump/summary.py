"""What is in a recording that was closed, by its index at the end: a few records are read, whatever the file's size."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Final

from mcap.opcode import Opcode

from shmio.dump.encoding import GAP, Gap
from shmio.dump.framing import FOOTER, HEAD
from shmio.dump.reader import Reader
from shmio.dump.records import Record
from shmio.dump.survey import Survey, Track, read_index
from shmio.errors import RecordingError

MAX_SUMMARY_BYTES: Final = 64 << 20
"""A chunk takes about 90 bytes of it: a week."""

_CHUNK_INDEX: Final = struct.Struct("<QQQQI")  # first and last log time, start, length; bytes of the map that follows
_PLACE: Final = struct.Struct("<HQ")  # a channel and where its message index is, or how many messages it has
_STATISTICS: Final = struct.Struct("<QHIIIIQQI")


def survey_by_index(reader: Reader) -> Survey | None:
    """As :func:`~shmio.dump.survey.survey`; None where the file has no index that is whole and agrees with itself."""
    try:
        data = _summary(reader)
        return _Work(reader).survey(data) if data else None
    except (RecordingError, struct.error, ValueError):
        return None


def _summary(reader: Reader) -> bytes:
    """The bytes of the summary, whole by their CRC; empty if there are none."""
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
        """By channel the first and the last chunk with messages of it, and where their message indexes are."""
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
        """RecordingError, ValueError."""
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
    """The map of channels to numbers whose length stands before ``at``."""
    (size,) = struct.unpack_from("<I", content, at - 4)
    if size > len(content) - at or size % _PLACE.size:
        raise ValueError
    yield from _PLACE.iter_unpack(content[at : at + size])
