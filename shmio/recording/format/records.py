"""The records of an MCAP file, walked from front to back without an index, so that a file that ends anywhere is read.

Nothing is trusted: lengths are checked against the file, against each other and against limits, chunks against their
CRC; no more than one chunk is in memory at a time. Behind a place that makes no sense the walk goes on with the next
chunk or attachment that is whole.
"""

from __future__ import annotations

import fcntl
import os
import re
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Final, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

from shmio.errors import RecordingError
from shmio.recording.format.framing import CHUNK, FOOTER, HEAD, MAX_CHUNK_BYTES, U32, framed, unpack

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES: Final = 1 << 20
"""Any other record that is read as a whole."""

BROKEN: Final = 0
"""The opcode, which no record of MCAP has, of bytes that make no sense."""
ONLY_BEGUN: Final = "ends where it begins: its recorder was killed before it wrote anything, or has just begun"
LOOK_BYTES: Final = 4096
"""So much at a record's beginning tells how long it is: names of attachments and metadata fit in."""
BEAT_BYTES: Final = 1 << 20
"""After so much that was read or unpacked the reader's caller is told that it goes on."""

_MARK: Final = re.compile(  # how each chunk and each attachment of ours begins
    rb"\x06(?=.{36}\x04\x00\x00\x00zstd)|\x09(?=.{24}.\x00\x00\x00(?:layouts|config|sources)/)", re.DOTALL
)
_MARK_BYTES: Final = 64
_SEARCH_BYTES: Final = 1 << 20
_MAX_SEARCHED: Final = 100
"""So many places that look like a chunk or an attachment and are none: then it is not searched any further."""


class Record(NamedTuple):
    """A record: where its content begins, and how long that is."""

    opcode: int
    at: int
    size: int

    @property
    def start(self) -> int:
        """Where the record itself begins."""
        return self.at - HEAD.size


class Records:
    """A file's records. ``closed`` and ``damage`` are known when :meth:`walk` has ended."""

    def __init__(self, file: Path, *, own: bool = False, beat: Callable[[], object] = lambda: None) -> None:
        """Open; RecordingError for what is no MCAP file. OSError.

        ``own``: refuse what is no regular file of this user, a link to one too: nobody else may have made it.
        ``beat`` is called each BEAT_BYTES of work, whatever the work is: a large file takes a while.
        """
        self.file = file
        self._beat = beat
        self._worked_bytes = 0
        self.closed = False
        """Whether the recorder closed it: index and footer are there."""
        self.damage = ""
        """Where and why the walk ended before the footer."""
        flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC  # a FIFO would wait for its writer
        self._fd = os.open(file, flags | os.O_NOFOLLOW if own else flags)
        try:
            found = os.fstat(self._fd)
            if own and not stat.S_ISREG(found.st_mode):
                raise RecordingError(f"{file} is no regular file")
            if own and found.st_uid != os.geteuid():
                raise RecordingError(f"{file} is another user's, of id {found.st_uid}")
            if stat.S_ISDIR(found.st_mode):
                raise RecordingError(f"{file} is a folder; name the recordings in it: {file}/*.mem")
            self.size = found.st_size
            start = self._pread(len(MAGIC), 0)
        except (OSError, RecordingError):
            os.close(self._fd)
            raise
        if start != MAGIC:
            os.close(self._fd)
            if not start:
                raise RecordingError(f"{file} is empty: its recorder wrote nothing")
            if MAGIC.startswith(start):
                raise RecordingError(f"{file} {ONLY_BEGUN}")
            raise RecordingError(f"{file} is no recording: it does not begin as MCAP")

    def walk(self, to: int | None = None) -> Iterator[Record]:
        """All records up to the footer; ends where the file ends.

        ``to``: nothing is looked for from this byte on; how the file ends is then not known.
        Bytes that make no sense are one record of opcode BROKEN, up to the next chunk or attachment that is whole, or
        the footer.
        """
        self.closed, self.damage, self._searched = False, "", 0
        at = len(MAGIC)
        end = self.size if to is None else min(to, self.size)
        while at < end:
            record = self.record(at)
            if record is None:
                goes_on = self._whole(at + 1, end) or self._footer(at + 1)
                if not goes_on:
                    break
                yield Record(BROKEN, at, goes_on - at)
                at = goes_on
                continue
            yield record
            at = record.at + record.size
            if record.opcode == Opcode.FOOTER:
                self.closed = self._peek(at, len(MAGIC)) == MAGIC
                self.damage = "" if self.closed else f"it ends within its footer at byte {at}"
                return
        if self._peek(at, 1) == b"\0":
            self.damage = f"no record at byte {at}"
        else:
            self.damage = (
                f"it ends within a record at byte {at} of {self.size}" if at < self.size else "it has no footer"
            )

    def summary(self) -> Iterator[Record]:
        """The records between data and footer of a file that was closed, which tell of channels once more."""
        footer = self._footer(len(MAGIC))
        if not footer:
            return
        at, _, _ = FOOTER.unpack(self.read(footer + HEAD.size, FOOTER.size))
        while at >= len(MAGIC) and at < footer and (record := self.record(at)) is not None:
            yield record
            at = record.at + record.size

    def summary_damage(self) -> str:
        """What the footer's CRC tells of the summary of a file that was closed; empty: it is whole, or has no CRC."""
        footer = self._footer(len(MAGIC))
        start, _, crc = FOOTER.unpack(self.read(footer + HEAD.size, FOOTER.size))
        end = footer + HEAD.size + FOOTER.size - U32.size
        whole = not crc or (start <= end and self.crc(start, end) == crc)
        return "" if whole else f"the index between byte {start} and byte {footer} is damaged: its checksum is wrong"

    def crc(self, at: int, end: int) -> int:
        """CRC-32 of some bytes, however many; RecordingError: the file became shorter."""
        found = 0
        for begin in range(at, end, _SEARCH_BYTES):
            found = zlib.crc32(self.read(begin, min(_SEARCH_BYTES, end - begin)), found)
        return found

    def _peek(self, at: int, size: int) -> bytes:
        """Some bytes, or as many as there are before the end that the file had when it was opened."""
        return self._pread(max(0, min(size, self.size - at)), at)

    def _pread(self, size: int, at: int) -> bytes:
        self._worked(size)
        try:
            return os.pread(self._fd, size, at)
        except OSError as error:
            error.filename = str(self.file)  # the call knows no name
            raise

    def _worked(self, size: int) -> None:
        self._worked_bytes += size
        if self._worked_bytes >= BEAT_BYTES:
            self._worked_bytes = 0
            self._beat()

    def record(self, at: int) -> Record | None:
        """The record that begins there; None if what is there makes no sense."""
        head = self._peek(at, HEAD.size + LOOK_BYTES)
        if len(head) < HEAD.size:
            return None
        opcode, size = HEAD.unpack_from(head)
        content = at + HEAD.size
        if opcode == BROKEN or size > self.size - content or not framed(opcode, size, head[HEAD.size :]):
            return None
        if opcode == Opcode.FOOTER and not MAGIC.startswith(self._peek(content + size, len(MAGIC))):
            return None
        return Record(opcode, content, size)

    def _whole(self, at: int, end: int) -> int:
        """Where, before ``end``, the next chunk or attachment begins of which all is there, by its CRC; 0: nowhere."""
        for begin in range(at, end, _SEARCH_BYTES):
            for found in _MARK.finditer(self._peek(begin, _SEARCH_BYTES + _MARK_BYTES - 1)):
                record = self.record(begin + found.start())
                if record is not None and record.start < begin + _SEARCH_BYTES:
                    with suppress(RecordingError):
                        self.check_crc(record)
                        return record.start
                    self._searched += 1
                    if self._searched >= _MAX_SEARCHED:
                        return 0
        return 0

    def footer(self) -> Record | None:
        """The footer of a file that was closed."""
        start = self._footer(len(MAGIC))
        return self.record(start) if start else None

    def _footer(self, at: int) -> int:
        """Where the footer is that ends the file, if not before here; 0: there is none."""
        start = self.size - len(MAGIC) - FOOTER.size - HEAD.size
        record = self.record(start) if start >= at else None
        if record is None or record.opcode != Opcode.FOOTER or record.at + record.size + len(MAGIC) != self.size:
            return 0
        return start

    def read(self, at: int, size: int, limit: int = MAX_RECORD_BYTES) -> bytes:
        """Some bytes; RecordingError: more than the limit, or the file became shorter."""
        if size > limit:
            raise RecordingError(f"{self.file}: a record of {size} bytes at byte {at} is larger than {limit}")
        data = self._pread(size, at)
        if len(data) != size:
            raise RecordingError(f"{self.file}: it became shorter while it was read")
        return data

    def chunk_times(self, record: Record) -> tuple[int, int]:
        """Log times of a chunk's first and last message."""
        start_ns, end_ns, _, _ = CHUNK.unpack(self.read(record.at, min(record.size, CHUNK.size)).ljust(CHUNK.size))
        return start_ns, end_ns

    def chunk(self, record: Record) -> Iterator[tuple[int, memoryview]]:
        """(opcode, content) of the records in a chunk. RecordingError: at once if the chunk as a whole is damaged."""
        return self._split(record, memoryview(self.unpacked(record)))

    def unpacked(self, record: Record) -> bytes:
        """The bytes in a chunk, whole by their CRC; RecordingError."""
        try:
            data = unpack(self.read(record.at, record.size, MAX_CHUNK_BYTES))
        except (ValueError, struct.error, zstandard.ZstdError) as error:
            raise RecordingError(f"{self.file}: the chunk at byte {record.at} is damaged: {error}") from None
        self._worked(len(data))
        return data

    def check_crc(self, record: Record) -> None:
        """RecordingError if a chunk's or an attachment's own CRC is wrong."""
        if record.opcode == Opcode.CHUNK:
            self.chunk(record)
        elif record.opcode == Opcode.ATTACHMENT:
            end = record.at + record.size - U32.size
            (crc,) = U32.unpack(self.read(end, U32.size))
            if crc and self.crc(record.at, end) != crc:
                raise RecordingError(f"{self.file}: the attachment at byte {record.at} is damaged")

    def _split(self, record: Record, data: memoryview) -> Iterator[tuple[int, memoryview]]:
        at = 0
        while at < len(data):
            if len(data) - at < HEAD.size:
                raise RecordingError(f"{self.file}: the chunk at byte {record.at} ends within a record")
            opcode, size = HEAD.unpack_from(data, at)
            at += HEAD.size
            if size > len(data) - at:
                raise RecordingError(f"{self.file}: the chunk at byte {record.at} ends within a record")
            yield opcode, data[at : at + size]
            at += size

    def hold(self) -> None:
        """Have recorders that delete what is old spare it, as long as it is open; where the file system has locks."""
        with suppress(OSError):
            fcntl.flock(self._fd, fcntl.LOCK_SH | fcntl.LOCK_NB)

    def close(self) -> None:
        """Close the file."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def stream(data: bytes | memoryview) -> ReadDataStream:
    """What the mcap library's records are read from; a bounded copy."""
    return ReadDataStream(BytesIO(data))
