"""The records of an MCAP file, walked from front to back without an index, so that a file that ends anywhere is read.

Nothing is trusted: lengths are checked against the file and against limits, chunks against their CRC; no more than one
chunk is in memory at a time.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Final, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

from shmio.errors import RecordingError

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES: Final = 32 << 20
"""Far more than a recorder makes: 1 MiB and one message of at most 2 MiB."""
MAX_RECORD_BYTES: Final = 1 << 20
"""Any other record that is read as a whole."""

_HEAD: Final = struct.Struct("<BQ")
_CHUNK: Final = struct.Struct("<QQQI")  # start, end, uncompressed size, CRC; then the compression's name, size, data


class Record(NamedTuple):
    """A record: where its content begins, and how long that is."""

    opcode: int
    at: int
    size: int


class Records:
    """A file's records. ``closed`` and ``damage`` are known when :meth:`walk` has ended."""

    def __init__(self, file: Path) -> None:
        """Open; RecordingError for what is no MCAP file. OSError."""
        self.file = file
        self.closed = False
        """Whether the recorder closed it: index and footer are there."""
        self.damage = ""
        """Where and why the walk ended before the footer."""
        self._fd = os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a FIFO would wait for its writer
        try:
            self.size = os.fstat(self._fd).st_size
            start = os.pread(self._fd, len(MAGIC), 0)
        except OSError:
            os.close(self._fd)
            raise
        if start != MAGIC:
            os.close(self._fd)
            empty = (
                "is empty: its recorder wrote nothing" if not start else "is no recording: it does not begin as MCAP"
            )
            raise RecordingError(f"{file} {empty}")

    def walk(self) -> Iterator[Record]:
        """All records up to the footer; ends where the file ends, or makes no sense any more."""
        self.closed, self.damage = False, ""
        at = len(MAGIC)
        while at < self.size:
            head = os.pread(self._fd, _HEAD.size, at)
            if len(head) < _HEAD.size:
                break
            opcode, size = _HEAD.unpack(head)
            if opcode == 0:
                self.damage = f"no record at byte {at}"
                return
            content = at + _HEAD.size
            if size > self.size - content:
                break
            yield Record(opcode, content, size)
            at = content + size
            if opcode == Opcode.FOOTER:
                self.closed = os.pread(self._fd, len(MAGIC), at) == MAGIC
                self.damage = "" if self.closed else f"it ends within its footer at byte {at}"
                return
        self.damage = f"it ends within a record at byte {at} of {self.size}" if at < self.size else "it has no footer"

    def read(self, at: int, size: int, limit: int = MAX_RECORD_BYTES) -> bytes:
        """Some bytes; RecordingError: more than the limit, or the file became shorter."""
        if size > limit:
            raise RecordingError(f"{self.file}: a record of {size} bytes at byte {at} is larger than {limit}")
        data = os.pread(self._fd, size, at)
        if len(data) != size:
            raise RecordingError(f"{self.file}: it became shorter while it was read")
        return data

    def chunk_times(self, record: Record) -> tuple[int, int]:
        """Log times of a chunk's first and last message."""
        start_ns, end_ns, _, _ = _CHUNK.unpack(self.read(record.at, min(record.size, _CHUNK.size)).ljust(_CHUNK.size))
        return start_ns, end_ns

    def chunk(self, record: Record) -> Iterator[tuple[int, memoryview]]:
        """(opcode, content) of the records in a chunk; RecordingError."""
        try:
            data = memoryview(_unpack(self.read(record.at, record.size, MAX_CHUNK_BYTES)))
        except (ValueError, struct.error, zstandard.ZstdError) as error:
            raise RecordingError(f"{self.file}: the chunk at byte {record.at} is damaged: {error}") from None
        at = 0
        while at < len(data):
            if len(data) - at < _HEAD.size:
                raise RecordingError(f"{self.file}: the chunk at byte {record.at} ends within a record")
            opcode, size = _HEAD.unpack_from(data, at)
            at += _HEAD.size
            if size > len(data) - at:
                raise RecordingError(f"{self.file}: the chunk at byte {record.at} ends within a record")
            yield opcode, data[at : at + size]
            at += size

    def close(self) -> None:
        """Close the file."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def stream(data: bytes | memoryview) -> ReadDataStream:
    """What the mcap library's records are read from; a bounded copy."""
    return ReadDataStream(BytesIO(data))


def _unpack(content: bytes) -> bytes:
    """The records of a chunk, uncompressed; ValueError, struct.error, ZstdError."""
    _, _, size, crc = _CHUNK.unpack_from(content)
    (name_size,) = struct.unpack_from("<I", content, _CHUNK.size)
    at = _CHUNK.size + 4 + name_size
    compression = content[_CHUNK.size + 4 : at].decode()
    (packed_size,) = struct.unpack_from("<Q", content, at)
    packed = content[at + 8 :]
    if packed_size != len(packed):
        raise ValueError("its sizes contradict each other")
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"{size} bytes, more than {MAX_CHUNK_BYTES}")
    if compression == "zstd":
        if zstandard.get_frame_parameters(packed).content_size not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError("its sizes contradict each other")
        data = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES).decompress(packed, max_output_size=size)
    elif not compression:
        data = packed
    else:
        raise ValueError(f"its compression {compression[:20]!r} is none that is known here")
    if len(data) != size:
        raise ValueError("its sizes contradict each other")
    if crc and zlib.crc32(data) != crc:
        raise ValueError("its checksum is wrong")
    return data
