"""Closes recordings that earlier recorders left unclosed, and deletes old ones.

This runs in a separate thread, so that many files or a slow disk do not delay the recording.
"""

from __future__ import annotations

import fcntl
import logging
import os
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    MessageIndex,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)

from shmio.config import Recorder as Settings
from shmio.errors import RecordingError
from shmio.recorder.predecessor import about_of, is_own, own_files
from shmio.recording.format.records import (
    BROKEN,
    CHUNK,
    FOOTER,
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

LOOK_S: Final = 60.0
"""Interval in s at which the folder is checked."""
DAY_S: Final = 86_400
CHECKED: Final = 128
"""Number of chunks at the end of a file to verify. After a power cut, they may have zeros."""
ZEROS_BYTES: Final = 1 << 20

_MESSAGE: Final = struct.Struct("<HIQ")  # channel, sequence, log time
_ENTRY_BYTES: Final = 16

log = logging.getLogger("shmio.recorder")


class _File(NamedTuple):
    """Identity and size of a file at a check. The file is read again only if they have changed."""

    path: Path
    inode: int
    size: int
    changed_ns: int


class Housekeeper:
    """Thread that closes and deletes recordings.

    It changes only recordings of this user and this instance that the same kind of recorder
    (``by``) has written. It never changes a file that another process is writing.
    """

    def __init__(self, instance: str, settings: Settings, by: str, present: Callable[[], set[Path]]) -> None:
        """Create the thread. ``present`` returns the files that this recorder is writing."""
        self._instance = instance
        self._settings = settings
        self._by = by
        self._present = present
        self._own: dict[_File, bool] = {}
        """The recordings by this kind of recorder. The value is True if the recording is closed."""
        self._strange: set[_File] = set()
        self._undeletable: set[_File] = set()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)

    def start(self) -> None:
        """Start the thread, which checks the folder at once."""
        self._thread.start()

    def stop(self, patience_s: float = 0.5) -> None:
        """Stop the thread before it handles the next file.

        Wait for its end, at most ``patience_s``.
        """
        self._stop.set()
        self._thread.join(patience_s)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self.look()
            except Exception:  # an error here must not end the recording
                log.exception("cleaning up earlier recordings failed")
            self._stop.wait(LOOK_S)

    def look(self) -> None:
        """Check the folder once: close recordings that were left unclosed, and delete old ones."""
        present = self._present()
        files = [_file(path) for path in own_files(Path(self._settings.directory), self._instance)]
        found = [file for file in files if file is not None]
        self._own = {file: closed for file, closed in self._own.items() if file in found}
        self._strange &= set(found)
        self._undeletable &= set(found)
        for file in found:
            if self._stop.is_set():
                return
            known = file.path in present or self._own.get(file) or file in self._strange
            if file.size and not known:  # an empty file is new, or its recorder wrote nothing
                self._take_in(file)
        self._delete([file for file in found if file.path in present])

    def _take_in(self, file: _File) -> None:
        try:
            if not about_of(file.path, self._instance, self._by):
                self._strange.add(file)
                return
            with Reader(file.path, own=True) as reader:
                closed = reader.records.footer() is not None
            if not closed and finalise(file.path):
                log.info("closed %s, because its recorder died before it could close the file", file.path)
                file, closed = _file(file.path) or file, True
            self._own[file] = closed
        except (OSError, RecordingError) as error:
            self._strange.add(file)
            log.warning("%s is left unchanged: %s", file.path, error)

    def _delete(self, present: list[_File]) -> None:
        """Delete closed files that are too old.

        Then delete the oldest closed files until all files together are small enough.
        """
        settings = self._settings
        left = sum(file.size for file in (*present, *self._own))
        oldest = sorted((file for file, closed in self._own.items() if closed), key=lambda file: file.changed_ns)
        for file in oldest:
            age_days = (time.time() - file.changed_ns / 1e9) / DAY_S
            if settings.keep_days and age_days > settings.keep_days:
                why = f"it is {age_days:.1f} days old, but recorder.keep_days is {settings.keep_days:g}"
            elif settings.keep_mb and left > settings.keep_mb * 1e6:
                why = f"there are {left / 1e6:.1f} MB of recordings, but recorder.keep_mb is {settings.keep_mb:g}"
            else:
                continue
            if self._remove(file, why):
                left -= file.size

    def _remove(self, file: _File, why: str) -> bool:
        try:
            if _file(file.path) != file or _is_held(file.path):
                return False
            file.path.unlink()
        except OSError as error:
            if file not in self._undeletable:
                self._undeletable.add(file)
                log.warning("%s cannot be deleted: %s; %s", file.path, error.strerror, why)
            return False
        del self._own[file]
        log.info("deleted %s: %s", file.path, why)
        return True


def _is_held(path: Path) -> bool:
    """Return whether a replay uses the file.

    The file must stay: a restarted replay reads it again.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks
        return False
    finally:
        os.close(fd)
    return False


def _file(path: Path) -> _File | None:
    """Return the file's present state; None if it does not exist or belongs to another user."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return _File(path, found.st_ino, found.st_size, found.st_mtime_ns) if is_own(found) else None


def finalise(file: Path, beat: Callable[[], object] = lambda: None) -> bool:
    """Close a recording that a recorder of this user has left unclosed.

    Args:
        file: The file.
        beat: Called at intervals, so that the process can write its heartbeat.

    Returns:
        False if another process is still writing the file.

    Raises:
        RecordingError: The file is not a recording, or is so damaged that only ``shmio-dump
            recover`` can read it.
        OSError: The disk is full. The file is unchanged, except that its incomplete end is cut off.
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
            _write(fd, _RecordingEnd(reader))
            os.utime(fd, ns=(before.st_atime_ns, before.st_mtime_ns))  # keep the times: nothing was recorded since
        finally:
            os.close(fd)
    return True


def _write(fd: int, ending: _RecordingEnd) -> None:
    """Cut off the incomplete end of a file, and append the index and the footer."""
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


@dataclass(slots=True)
class _Chunk:
    """A chunk of a recording, with the number of its messages by channel."""

    record: Record
    index: ChunkIndex
    counts: dict[int, int] = field(default_factory=dict)


class _RecordingEnd:
    """Builds the index and the footer that close a recording after its last complete record."""

    def __init__(self, reader: Reader) -> None:
        """Read the file.

        Raises:
            RecordingError: The file is not a recording, or is damaged before its end.
        """
        self._reader = reader
        self._records = reader.records
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._chunks: list[_Chunk] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self.cut = len(MAGIC)
        """Offset in the file at which the last complete record ends."""
        self._anew = b""
        """New message indexes for the last chunk, which replace those in the file."""
        self._walk()
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
            elif opcode == Opcode.ATTACHMENT:
                self._attachment(record)
            elif opcode == Opcode.METADATA:
                self._metadatum(record)
            self.cut = record.at + record.size
            last = opcode
        self._reader.require_ours()
        if not over:
            self._tail()
        if last in (Opcode.CHUNK, Opcode.MESSAGE_INDEX) and self._chunks:
            self._index_anew()

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
        return RecordingError(f"{self._reader.file}: {why}, at byte {at}: shmio-dump recover saves what is intact")

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
        self._chunks.append(_Chunk(record, index))

    def _index(self, record: Record) -> None:
        """Add a message index to the last chunk.

        If its channel is new, read the channel's description.
        """
        chunk = self._chunks[-1]
        number, size = INDEX.unpack(self._records.read(record.at, INDEX.size))
        if number not in self._channels:
            self._describe(chunk.record)
        chunk.index.message_index_offsets[number] = record.start
        chunk.index.message_index_length += record.size + HEAD.size
        chunk.counts[number] = size // _ENTRY_BYTES

    def _describe(self, chunk: Record) -> None:
        for opcode, content in self._records.chunk(chunk):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                (number,) = struct.unpack_from("<H", content)
                known = self._schemas if opcode == Opcode.SCHEMA else self._channels
                known[number] = HEAD.pack(opcode, len(content)) + bytes(content)

    def _index_anew(self) -> None:
        """Create the message indexes of the last chunk again, because some may be missing."""
        chunk = self._chunks[-1]
        self.cut = chunk.record.at + chunk.record.size
        found: dict[int, MessageIndex] = {}
        at = 0
        with suppress(RecordingError, struct.error):  # _check() reports the damage
            self._describe(chunk.record)
            for opcode, content in self._records.chunk(chunk.record):
                if opcode == Opcode.MESSAGE:
                    number, _, log_ns = _MESSAGE.unpack_from(content)
                    found.setdefault(number, MessageIndex(number, [])).records.append((log_ns, at))
                at += HEAD.size + len(content)
        chunk.index.message_index_offsets = {}
        builder = RecordBuilder()
        for number, entries in found.items():
            chunk.index.message_index_offsets[number] = self.cut + builder.count
            entries.write(builder)
        chunk.index.message_index_length = builder.count
        chunk.counts = {number: len(entries.records) for number, entries in found.items()}
        self._anew = builder.end()

    def _attachment(self, record: Record) -> None:
        self._reader.note(record)
        data = stream(self._records.read(record.at, min(record.size, LOOK_BYTES)))
        log_ns, changed_ns = data.read8(), data.read8()
        name, media_type = data.read_prefixed_string(), data.read_prefixed_string()
        length = record.size + HEAD.size
        index = AttachmentIndex(record.start, length, log_ns, changed_ns, data.read8(), name, media_type)
        self._attachments.append(index)

    def _metadatum(self, record: Record) -> None:
        self._reader.note(record)
        name = stream(self._records.read(record.at, record.size)).read_prefixed_string()
        self._metadata.append(MetadataIndex(record.start, record.size + HEAD.size, name))

    def _check(self) -> None:
        """Leave damaged chunks near the end of the file out of the index."""
        whole = self._chunks[:-CHECKED]
        for chunk in self._chunks[-CHECKED:]:
            with suppress(RecordingError):
                self._records.check_crc(chunk.record)
                whole.append(chunk)
        self._chunks = whole

    # ---- the index and footer to write -------------------------------------------------------------------------------

    def data(self) -> bytes:
        """Return the bytes to write at offset :attr:`cut`."""
        builder = RecordBuilder()
        builder.write(self._anew)
        DataEnd(zlib.crc32(self._anew, self._records.crc(0, self.cut))).write(builder)
        data = builder.end()
        start = self.cut + len(data)
        groups: list[tuple[Opcode, int]] = []
        for opcode, content in self._groups():
            groups.append((opcode, len(content)))
            builder.write(content)
        at, offsets_at = start, start + builder.count
        for opcode, size in groups:
            SummaryOffset(opcode, at, size).write(builder)
            at += size
        summary = builder.end()
        covered = summary + HEAD.pack(Opcode.FOOTER, FOOTER.size) + FOOTER.pack(start, offsets_at, 0)[: -U32.size]
        Footer(start, offsets_at, zlib.crc32(covered)).write(builder)
        return b"".join((data, summary, builder.end(), MAGIC))

    def _groups(self) -> Iterator[tuple[Opcode, bytes]]:
        """Yield the records of the summary, grouped by kind."""
        yield Opcode.SCHEMA, b"".join(self._schemas.values())
        yield Opcode.CHANNEL, b"".join(self._channels.values())
        yield Opcode.STATISTICS, _written(self._statistics())
        yield Opcode.CHUNK_INDEX, _written(*(chunk.index for chunk in self._chunks))
        yield Opcode.ATTACHMENT_INDEX, _written(*self._attachments)
        yield Opcode.METADATA_INDEX, _written(*self._metadata)

    def _statistics(self) -> Statistics:
        counts: dict[int, int] = {}
        for chunk in self._chunks:
            for number, count in chunk.counts.items():
                counts[number] = counts.get(number, 0) + count
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=sum(counts.values()),
            message_end_time=max((chunk.index.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.index.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _written(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())
