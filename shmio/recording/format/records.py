"""Reads the records of an MCAP file from front to back, without an index.

Therefore, it can also read a file whose end is missing. It does not trust the content: it compares
lengths with the size of the file, with each other and with limits, and checks the CRC of each chunk.
At most one chunk is in memory at a time. After a damaged place, reading continues with the next
intact chunk or attachment.
"""

from __future__ import annotations

import fcntl
import os
import re
import stat
import struct
import threading
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

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES: Final = 1 << 20
"""Largest size in bytes of a record that is read as a whole. Chunks have their own limit."""

BROKEN: Final = 0
"""Opcode that stands for bytes that are not a valid record. MCAP does not use this opcode."""
ONLY_BEGUN: Final = "has no content: its recorder was killed before it wrote anything, or has just started"
LOOK_BYTES: Final = 4096
"""Number of bytes at the beginning of a record that are read to check the lengths in the record.

These bytes include the name of an attachment or of metadata.
"""
BEAT_BYTES: Final = 1 << 20
"""Number of bytes that are read or decompressed between two calls of ``beat``, the caller's function."""
MAX_CHUNK_BYTES: Final = 32 << 20
"""Largest size of a chunk in bytes.

A recorder ends a chunk as soon as it has 1 MiB; a message has at most 2 MiB.
"""

COMPRESSIONS: Final = ("", "zstd")
"""The compressions of chunks that can be read; "" is none."""

HEAD: Final = struct.Struct("<BQ")  # of any record: opcode, size of its content
CHUNK: Final = struct.Struct("<QQQI")  # start, end, uncompressed size, CRC; then the compression's name, size, data
FOOTER: Final = struct.Struct("<QQI")  # start of the summary, start of its offsets, CRC of the summary up to here
INDEX: Final = struct.Struct("<HI")  # channel, bytes of the entries that follow
U32: Final = struct.Struct("<I")
U64: Final = struct.Struct("<Q")
_MARK: Final = re.compile(  # beginning of each chunk and attachment that shmio writes
    rb"\x06(?=.{36}\x04\x00\x00\x00zstd)|\x09(?=.{24}.\x00\x00\x00(?:layouts|config|sources)/)", re.DOTALL
)
_MARK_BYTES: Final = 64
_SEARCH_BYTES: Final = 1 << 20
_MAX_SEARCHED: Final = 100
"""A search for the next chunk or attachment ends after this number of places that only look like one."""
_SIZES: Final[dict[int, int]] = {Opcode.DATA_END: 4, Opcode.FOOTER: FOOTER.size}


class Record(NamedTuple):
    """A record's opcode, and the offset and size of its content in the file."""

    opcode: int
    at: int
    size: int

    @property
    def start(self) -> int:
        """Offset at which the record begins, with its header."""
        return self.at - HEAD.size


class Records:
    """Reads the records of a file.

    :attr:`closed` and :attr:`damage` are valid when :meth:`walk` has reached its end.
    """

    def __init__(self, file: Path, *, own: bool, beat: Callable[[], object]) -> None:
        """Open a file.

        Args:
            file: The path.
            own: True to accept only a regular file of this user, and no symbolic link.
            beat: Called after each BEAT_BYTES of work, as a heartbeat.

        Raises:
            RecordingError: The file is not an MCAP file.
            OSError: The file cannot be opened.
        """
        self.file = file
        self._beat = beat
        self._worked_bytes = 0
        self.closed = False
        """True if the recorder has closed the file, so that it has an index and a footer."""
        self.damage = ""
        """Message that says where and why the walk ended early; empty if it reached the footer."""
        flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC  # opening a FIFO would block
        self._fd = os.open(file, flags | os.O_NOFOLLOW if own else flags)
        try:
            found = os.fstat(self._fd)
            if own and not stat.S_ISREG(found.st_mode):
                raise RecordingError(f"{file} is not a regular file")
            if own and found.st_uid != os.geteuid():
                raise RecordingError(f"{file} belongs to another user (uid {found.st_uid})")
            if stat.S_ISDIR(found.st_mode):
                raise RecordingError(f"{file} is a directory; name the recordings in it: {file}/*.mem")
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
            raise RecordingError(f"{file} is not a recording: it does not begin like an MCAP file")

    def walk(self, to: int | None = None) -> Iterator[Record]:
        """Yield all records up to the footer, or to the end of the file.

        Damaged bytes, up to the next intact chunk, attachment or footer, become one record with
        opcode BROKEN. If ``to`` is not None, the walk stops at this byte offset, and does not set
        :attr:`closed` and :attr:`damage`.
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
            self.damage = f"there is no valid record at byte {at}"
        else:
            self.damage = (
                f"it ends within a record at byte {at} of {self.size}" if at < self.size else "it has no footer"
            )

    def summary(self) -> Iterator[Record]:
        """Yield the records in the summary of a closed file.

        These records include the description of each channel.
        """
        footer = self._footer(len(MAGIC))
        if not footer:
            return
        at, _, _ = FOOTER.unpack(self.read(footer + HEAD.size, FOOTER.size))
        while at >= len(MAGIC) and at < footer and (record := self.record(at)) is not None:
            yield record
            at = record.at + record.size

    def summary_damage(self) -> str:
        """Check the CRC of a closed file's summary. Return a message if the CRC is wrong, else ""."""
        footer = self._footer(len(MAGIC))
        start, _, crc = FOOTER.unpack(self.read(footer + HEAD.size, FOOTER.size))
        end = footer + HEAD.size + FOOTER.size - U32.size
        whole = not crc or (start <= end and self.crc(start, end) == crc)
        return "" if whole else f"the index between byte {start} and byte {footer} is damaged: its checksum is wrong"

    def crc(self, at: int, end: int) -> int:
        """Return the CRC-32 of the bytes from offset ``at`` up to, but not including, ``end``.

        Raises:
            RecordingError: The file became shorter.
        """
        found = 0
        for begin in range(at, end, _SEARCH_BYTES):
            found = zlib.crc32(self.read(begin, min(_SEARCH_BYTES, end - begin)), found)
        return found

    def _peek(self, at: int, size: int) -> bytes:
        """Return up to ``size`` bytes from offset ``at``.

        Ignore bytes that were appended after the file was opened.
        """
        return self._pread(max(0, min(size, self.size - at)), at)

    def _pread(self, size: int, at: int) -> bytes:
        self._worked(size)
        try:
            return os.pread(self._fd, size, at)
        except OSError as error:
            error.filename = str(self.file)  # os.pread does not know the name
            raise

    def _worked(self, size: int) -> None:
        self._worked_bytes += size
        if self._worked_bytes >= BEAT_BYTES:
            self._worked_bytes = 0
            self._beat()

    def record(self, at: int) -> Record | None:
        """Return the record that begins at byte ``at``; None if no valid record begins there."""
        head = self._peek(at, HEAD.size + LOOK_BYTES)
        if len(head) < HEAD.size:
            return None
        opcode, size = HEAD.unpack_from(head)
        content = at + HEAD.size
        if opcode == BROKEN or size > self.size - content or not _framed(opcode, size, head[HEAD.size :]):
            return None
        if opcode == Opcode.FOOTER and not MAGIC.startswith(self._peek(content + size, len(MAGIC))):
            return None
        return Record(opcode, content, size)

    def _whole(self, at: int, end: int) -> int:
        """Return the start of the next chunk or attachment with a correct CRC; else 0."""
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
        """Return the footer of a closed file; None if the file was not closed."""
        start = self._footer(len(MAGIC))
        return self.record(start) if start else None

    def _footer(self, at: int) -> int:
        """Return the start of the footer at the end of the file; 0 if none begins after ``at``."""
        start = self.size - len(MAGIC) - FOOTER.size - HEAD.size
        record = self.record(start) if start >= at else None
        if record is None or record.opcode != Opcode.FOOTER or record.at + record.size + len(MAGIC) != self.size:
            return 0
        return start

    def read(self, at: int, size: int, limit: int = MAX_RECORD_BYTES) -> bytes:
        """Return ``size`` bytes from offset ``at``.

        Raises:
            RecordingError: The size exceeds the limit, or the file became shorter.
        """
        if size > limit:
            raise RecordingError(f"{self.file}: the record at byte {at} has {size} bytes, which is larger than {limit}")
        data = self._pread(size, at)
        if len(data) != size:
            raise RecordingError(f"{self.file}: the file became shorter while it was read")
        return data

    def chunk_times(self, record: Record) -> tuple[int, int]:
        """Return the log times of a chunk's first and last message."""
        start_ns, end_ns, _, _ = CHUNK.unpack(self.read(record.at, min(record.size, CHUNK.size)).ljust(CHUNK.size))
        return start_ns, end_ns

    def chunk(self, record: Record) -> Iterator[tuple[int, memoryview]]:
        """Yield the opcode and the content of each record in a chunk.

        Raises:
            RecordingError: The chunk or one of its records is damaged.
        """
        return self._split(record, memoryview(self.unpacked(record)))

    def unpacked(self, record: Record) -> bytes:
        """Return the uncompressed bytes of a chunk.

        Raises:
            RecordingError: The chunk is damaged or its CRC is wrong.
        """
        try:
            data = _unpack(self.read(record.at, record.size, MAX_CHUNK_BYTES))
        except (ValueError, struct.error, zstandard.ZstdError) as error:
            raise RecordingError(f"{self.file}: the chunk at byte {record.at} is damaged: {error}") from None
        self._worked(len(data))
        return data

    def check_crc(self, record: Record) -> None:
        """Raise RecordingError if the CRC of a chunk or an attachment is wrong."""
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

    def lock(self) -> None:
        """Lock the file until it is closed, so that no recorder deletes it.

        This has no effect on a file system without locks.
        """
        with suppress(OSError):
            fcntl.flock(self._fd, fcntl.LOCK_SH | fcntl.LOCK_NB)

    def close(self) -> None:
        """Close the file."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class Damage(NamedTuple):
    """A damaged place in a file: the bytes ``first`` to ``last`` cannot be read, or only in part.

    ``after_ns`` is the log time of the last readable entry before this place. ``before_ns`` is the
    log time of the first readable entry after it. Each is 0 if there is no such entry.
    """

    first: int
    last: int
    why: str
    after_ns: int
    before_ns: int


class DamageLog:
    """Collects damage while a file is read from front to back.

    The log reports all damage between two intact chunks as one place. Call :meth:`end` before each
    readable chunk and at the end of the file. Call :meth:`after` after each readable chunk.
    """

    def __init__(self, report: Callable[[Damage], object]) -> None:
        self._report = report
        self._after_ns = 0
        self._found: Damage | None = None

    def add(self, record: Record, why: object) -> None:
        """Add a record that cannot be read completely, and the reason."""
        first, last = record.at, record.at + record.size - 1
        if self._found is None:
            self._found = Damage(first, last, str(why), self._after_ns, 0)
        else:
            self._found = self._found._replace(last=last)

    def after(self, last_ns: int) -> None:
        """Remember that a chunk was read; ``last_ns`` is the log time of the chunk's last entry."""
        self._after_ns = last_ns

    def end(self, before_ns: int = 0) -> None:
        """Report the damage since the last chunk.

        ``before_ns`` is the log time of the first entry after the damage; 0 if no entry follows.
        """
        if self._found is not None:
            self._report(self._found._replace(before_ns=before_ns))
            self._found = None


def stream(data: bytes | memoryview) -> ReadDataStream:
    """Return a stream with a copy of the data, from which the mcap library can read records."""
    return ReadDataStream(BytesIO(data))


class _OfThread(threading.local):
    """A decompressor for each thread.

    Creating a decompressor takes longer than decompressing a chunk.
    """

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)


_of_thread = _OfThread()


def _framed(opcode: int, size: int, look: bytes) -> bool:
    """Return whether the lengths inside a record are consistent with the length of the record.

    Without this check, a damaged length would make the reader skip intact records. ``look`` is the
    beginning of the content.
    """
    try:
        if opcode == Opcode.CHUNK:
            (name,) = U32.unpack_from(look, CHUNK.size)
            (data,) = U64.unpack_from(look, CHUNK.size + 4 + name)
            return bool(size == CHUNK.size + 12 + name + data)
        if opcode == Opcode.MESSAGE_INDEX:
            (data,) = U32.unpack_from(look, 2)
            return bool(size == 6 + data)
        if opcode == Opcode.ATTACHMENT:
            (name,) = U32.unpack_from(look, 16)
            (media_type,) = U32.unpack_from(look, 20 + name)
            (data,) = U64.unpack_from(look, 24 + name + media_type)
            return bool(size == 36 + name + media_type + data)
        if opcode == Opcode.METADATA:
            (name,) = U32.unpack_from(look)
            (data,) = U32.unpack_from(look, 4 + name)
            return bool(size == 8 + name + data)
    except struct.error:
        return False
    return size == _SIZES.get(opcode, size)


def _unpack(content: bytes) -> bytes:
    """Return the uncompressed records of a chunk.

    Raises:
        ValueError: A size or the checksum is wrong, or the compression is unknown.
        struct.error: The chunk is too short.
        ZstdError: The compressed data is damaged.
    """
    _, _, size, crc = CHUNK.unpack_from(content)
    (name_size,) = U32.unpack_from(content, CHUNK.size)
    at = CHUNK.size + 4 + name_size
    compression = content[CHUNK.size + 4 : at].decode()
    (packed_size,) = U64.unpack_from(content, at)
    packed = memoryview(content)[at + 8 :]
    if packed_size != len(packed):
        raise ValueError("its sizes are inconsistent")
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"it has {size} bytes, but at most {MAX_CHUNK_BYTES} are allowed")
    if compression == "zstd":
        if zstandard.get_frame_parameters(packed).content_size not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError("its sizes are inconsistent")
        data = _of_thread.decompressor.decompress(packed, max_output_size=size)
    elif not compression:
        data = bytes(packed)
    else:
        raise ValueError(f"its compression {compression[:20]!r} is unknown")
    if len(data) != size:
        raise ValueError("its sizes are inconsistent")
    if crc and zlib.crc32(data) != crc:
        raise ValueError("its checksum is wrong")
    return data
