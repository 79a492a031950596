"""Closes a recording that a dead recorder has left unclosed: repairs its end, adds an index and a footer."""

from __future__ import annotations

import fcntl
import logging
import os
import struct
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, MetadataIndex

from shmio.errors import RecordingError
from shmio.recording.format.mcap_writer import IndexedChunk, Summary, message_index
from shmio.recording.format.records import (
    BROKEN,
    CHUNK,
    COMPRESSIONS,
    HEAD,
    INDEX,
    LOOK_BYTES,
    MAGIC,
    MAX_CHUNK_BYTES,
    U32,
    U64,
    Record,
    stream,
)
from shmio.recording.reading.reader import Reader
from shmio.wording import counted

CHECKED: Final = 128
"""Number of chunks at the end of a file to verify, because they may contain zeros after a power cut."""
ZEROS_BYTES: Final = 1 << 20

_MESSAGE: Final = struct.Struct("<HIQ")  # channel, sequence, log time
_ENTRY_BYTES: Final = 16

log = logging.getLogger("shmio.recorder")


def finalise(file: Path, beat: Callable[[], object] = lambda: None) -> bool:
    """Close a recording that a recorder of this user has left unclosed.

    Cut off damaged chunks at its end, of which nothing can be read, so that programs that read a file from
    front to back reach its end. Damaged chunks before an intact one remain, but are not in the index.

    Args:
        file: The file.
        beat: Called at intervals, so that the process can write its heartbeat.

    Returns:
        False if another process is still writing the file.

    Raises:
        RecordingError: The file is not a recording, is so damaged that only ``shmio-dump recover`` can read
            it, or ends with a chunk whose compression is unknown. The file is unchanged.
        OSError: The disk is full. The file is unchanged, except that its incomplete or damaged end is cut off.
    """
    with Reader(file, own=True, beat=beat) as reader:
        fd = os.open(file, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            before = os.fstat(fd)
            if before.st_size != reader.records.size:
                return False
            ending = _RecordingEnd(reader)
            _write(fd, ending)
            if ending.dropped:
                what = counted(ending.dropped, "damaged chunk")
                log.warning("%s ended with %s, of which nothing could be read; cut off", file, what)
            os.utime(fd, ns=(before.st_atime_ns, before.st_mtime_ns))  # keep the times: nothing was recorded since
        finally:
            os.close(fd)
    return True


def _write(fd: int, ending: _RecordingEnd) -> None:
    """Cut off the incomplete or damaged end of a file, and append the index and the footer."""
    data = ending.data()
    os.ftruncate(fd, ending.cut)
    try:
        done = 0
        while done < len(data):
            done += os.pwrite(fd, data[done:], ending.cut + done)
        os.fsync(fd)
    except OSError:
        os.ftruncate(fd, ending.cut)
        raise


class _RecordingEnd:
    """Builds the index and the footer that close a recording after its last intact record."""

    def __init__(self, reader: Reader) -> None:
        """Read the file.

        Raises:
            RecordingError: The file is not a recording, or is damaged before its end.
        """
        self._reader = reader
        self._records = reader.records
        self._summary = Summary()
        self._chunks: list[tuple[Record, IndexedChunk]] = []
        self.cut = len(MAGIC)
        """Offset in the file at which the last intact record ends."""
        self.dropped = 0
        """Number of damaged chunks after it."""
        self._described_in: dict[int, Record] = {}
        """The first chunk with messages of a channel, by the channel's number. It has the channel's description."""
        self._besides = 0
        """Offset of the last record that is neither a chunk nor the index of one."""
        self._anew = b""
        """New message indexes for the last chunk, which replace those in the file."""
        self._walk()
        self._drop_damaged()
        self._describe_all()
        if self._chunks and self._chunks[-1][0].start > self._besides:
            self._index_anew(*self._chunks[-1])
        self._check()

    def _walk(self) -> None:
        over = False
        last = BROKEN
        for record in self._records.walk():
            opcode = record.opcode
            if over and opcode in (Opcode.CHUNK, Opcode.ATTACHMENT):
                raise self._damaged(record.start, "there is data after its end")
            if opcode == Opcode.DATA_END:
                over = True
            if over:
                continue
            if opcode == Opcode.CHUNK:
                self._chunk(record)
            elif opcode == Opcode.MESSAGE_INDEX and last in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
                self._index(record)
            else:
                self._besides = record.start
                if opcode == Opcode.ATTACHMENT:
                    self._attachment(record)
                elif opcode == Opcode.METADATA:
                    self._metadatum(record)
            self.cut = record.at + record.size
            last = opcode
        self._reader.require_ours()
        if not over:
            self._tail()

    def _tail(self) -> None:
        """Check that only zeros or the start of one record follow the last complete record."""
        size = self._records.size - self.cut
        if size < HEAD.size:
            return
        opcode, length = HEAD.unpack(self._records.read(self.cut, HEAD.size))
        cut_short = opcode != BROKEN and size - HEAD.size < length <= MAX_CHUNK_BYTES
        if not cut_short and not self._zeros():
            raise self._damaged(self.cut, "the file is damaged to its end")

    def _zeros(self) -> bool:
        end = self._records.size
        return not any(
            any(self._records.read(at, min(ZEROS_BYTES, end - at))) for at in range(self.cut, end, ZEROS_BYTES)
        )

    def _damaged(self, at: int, why: str) -> RecordingError:
        return RecordingError(f"{self._reader.file}: {why}, at byte {at}; save what is intact with shmio-dump recover")

    # ---- reading the records of the file -----------------------------------------------------------------------------

    def _chunk(self, record: Record) -> None:
        head = self._records.read(record.at, min(record.size, LOOK_BYTES))
        begin_ns, end_ns, size, _ = CHUNK.unpack_from(head)
        (name_size,) = U32.unpack_from(head, CHUNK.size)
        at = CHUNK.size + U32.size
        name = head[at : at + name_size].decode("ascii", "replace")
        (packed,) = U64.unpack_from(head, at + name_size)
        index = ChunkIndex(
            chunk_length=record.size + HEAD.size,
            chunk_start_offset=record.start,
            compression=name,
            compressed_size=packed,
            message_end_time=end_ns,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=begin_ns,
            uncompressed_size=size,
        )
        self._chunks.append((record, IndexedChunk(index)))

    def _index(self, record: Record) -> None:
        """Add a message index to the last chunk."""
        of, chunk = self._chunks[-1]
        number, size = INDEX.unpack(self._records.read(record.at, INDEX.size))
        self._described_in.setdefault(number, of)
        chunk.index.message_index_offsets[number] = record.start
        chunk.index.message_index_length += record.size + HEAD.size
        chunk.counts[number] = size // _ENTRY_BYTES

    def _drop_damaged(self) -> None:
        """Cut off the damaged chunks after the last intact record.

        Raises:
            RecordingError: The compression of such a chunk is unknown, so the chunk may be intact.
        """
        while self._chunks and self._chunks[-1][0].start > self._besides and not self._intact(self._chunks[-1][0]):
            record, chunk = self._chunks[-1]
            if chunk.index.compression not in COMPRESSIONS:
                raise RecordingError(
                    f"{self._reader.file}: the chunk at byte {record.start} has the compression "
                    f"{chunk.index.compression[:20]!r}, which this version of shmio does not know"
                )
            self.cut = self._chunks.pop()[0].start
            self.dropped += 1

    def _intact(self, chunk: Record) -> bool:
        with suppress(RecordingError):
            self._records.check_crc(chunk)
            return True
        return False

    def _describe_all(self) -> None:
        """Read the descriptions of all channels that the remaining chunks have."""
        for number, chunk in self._described_in.items():
            if number not in self._summary.channels and chunk.start < self.cut:
                self._describe(chunk)

    def _describe(self, chunk: Record) -> None:
        for opcode, content in self._records.chunk(chunk):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                (number,) = struct.unpack_from("<H", content)
                known = self._summary.schemas if opcode == Opcode.SCHEMA else self._summary.channels
                known[number] = HEAD.pack(opcode, len(content)) + bytes(content)

    def _index_anew(self, record: Record, chunk: IndexedChunk) -> None:
        """Create the message indexes of the last chunk again, because some may be missing."""
        self.cut = record.at + record.size
        found: dict[int, list[int]] = {}
        at = 0
        with suppress(RecordingError, struct.error):  # _check() reports the damage
            self._describe(record)
            for opcode, content in self._records.chunk(record):
                if opcode == Opcode.MESSAGE:
                    number, _, log_ns = _MESSAGE.unpack_from(content)
                    found.setdefault(number, []).extend((log_ns, at))
                at += HEAD.size + len(content)
        chunk.index.message_index_offsets = {}
        for number, entries in found.items():
            chunk.index.message_index_offsets[number] = self.cut + len(self._anew)
            self._anew += message_index(number, entries)
        chunk.index.message_index_length = len(self._anew)
        chunk.counts = {number: len(entries) // 2 for number, entries in found.items()}

    def _attachment(self, record: Record) -> None:
        self._reader.note(record)
        data = stream(self._records.read(record.at, min(record.size, LOOK_BYTES)))
        log_ns, changed_ns = data.read8(), data.read8()
        name, media_type = data.read_prefixed_string(), data.read_prefixed_string()
        length = record.size + HEAD.size
        index = AttachmentIndex(record.start, length, log_ns, changed_ns, data.read8(), name, media_type)
        self._summary.attachments.append(index)

    def _metadatum(self, record: Record) -> None:
        self._reader.note(record)
        name = stream(self._records.read(record.at, record.size)).read_prefixed_string()
        self._summary.metadata.append(MetadataIndex(record.start, record.size + HEAD.size, name))

    def _check(self) -> None:
        """Leave damaged chunks near the end of the file out of the index."""
        last = self._chunks[-CHECKED:]
        self._chunks = [*self._chunks[:-CHECKED], *(chunk for chunk in last if self._intact(chunk[0]))]

    def data(self) -> bytes:
        """Return the bytes to write at offset :attr:`cut`: the index and the footer."""
        self._summary.chunks = [chunk for _, chunk in self._chunks]
        crc = zlib.crc32(self._anew, self._records.crc(0, self.cut))
        return self._anew + self._summary.end(self.cut + len(self._anew), crc)
