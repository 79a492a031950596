"""The Parquet files of one cell.

New files have hidden names until :meth:`CellFiles.commit`. It syncs them, stores their names and the
number of the last message in the state file, and then gives them their own names. If the process
ends before the state file is stored, the next start removes the hidden files, and the same messages
are written again. If the process ends later, the next start gives the files their names.
"""

from __future__ import annotations

import logging
import os
import re
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np

from shmio.config.model import NAME_PATTERN
from shmio.errors import RecordingError
from shmio.fabric.archive.numbers import NumberSet
from shmio.fabric.entries import log_time
from shmio.fabric.messages import Header, decode_entries
from shmio.fabric.names import CellName
from shmio.layout.model import Layout
from shmio.recording.columns import DECODED_BYTES, Collector
from shmio.recording.export import ParquetTable
from shmio.recording.reading.batch import Batch, record
from shmio.recording.reading.part import DumpBlock
from shmio.segment import Frame

STATE: Final = ".archive.json"
PART: Final = ".part"
MAX_FILES: Final = 64
"""Number of open files of a cell at which they are closed."""
MAX_STREAMS: Final = 16
"""For each source, the written numbers of this many streams are known: those of its last starts."""
_DAY_NS: Final = 86_400_000_000_000
_MAX_DAY: Final = 2_932_896  # 9999-12-31

log = logging.getLogger("shmio.fabric")


class ArchiveState(msgspec.Struct):
    """What the archive has of a cell.

    Attributes:
        created: When the stream of the history was created. A stream that was made anew counts its
            messages from 1 again.
        stream: What distinguishes the stream in the names of files.
        last: Number of the last message in the stream that is in the files.
        files: The files of the last commit, relative to the cell's folder.
        written: The numbers of the written messages, by source and by the uplink's stream.

    """

    created: str = ""
    stream: str = ""
    last: int = 0
    files: list[str] = []
    written: dict[str, dict[str, list[tuple[int, int]]]] = {}


class ClosedFile(NamedTuple):
    """A file that is complete, and its number of rows."""

    path: Path
    rows: int


class CellFiles:
    """Writes the messages of one cell. Use it from one thread at a time."""

    def __init__(self, folder: Path, cell: CellName) -> None:
        """Complete or remove what an earlier process has left.

        Raises:
            RecordingError: The state file is damaged.
            OSError: A file cannot be read or written.

        """
        self._folder = folder / f"cell={cell}"
        self._state = ArchiveState()
        self._open: dict[tuple[str, bytes, str], _OpenFile] = {}
        self.received = 0
        """Number of the last message in the stream that was added."""
        self.messages = 0
        """Number of messages that were added since the last commit."""
        if self._folder.exists():
            self._resume()
        self._written = {
            source: {stream: NumberSet(ranges) for stream, ranges in streams.items()}
            for source, streams in self._state.written.items()
        }
        self.received = self._state.last

    def _resume(self) -> None:
        file = self._folder / STATE
        try:
            self._state = msgspec.json.decode(file.read_bytes(), type=ArchiveState)
        except FileNotFoundError:
            pass
        except msgspec.MsgspecError as error:
            raise RecordingError(
                f"{file}: the file is damaged ({error}); move this cell's folder away, and the archive begins a new one"
            ) from None
        self._rename()
        for left in self._folder.glob(f"day=*/.*{PART}"):
            left.unlink()

    def begin(self, created: datetime, last: int) -> None:
        """Note which stream the next messages come from.

        Args:
            created: When the stream was created.
            last: Number of its last message.

        """
        now = created.astimezone(UTC).isoformat()
        if now == self._state.created and last >= self.received:
            return
        again = now == self._state.created
        if again:
            log.warning(
                "%s: the server has lost its newest messages, and will use their numbers for new ones", self._folder
            )
        self.commit()
        begun = datetime.now(UTC) if again else created.astimezone(UTC)
        self._state.created, self._state.stream = now, begun.strftime("%Y%m%dT%H%M%S%f")
        self._state.last = self.received = 0

    @property
    def memory(self) -> int:
        """Size of the rows that are still in memory, in bytes."""
        return sum(file.memory for file in self._open.values())

    @property
    def largest(self) -> int:
        """Size of the largest open file, in bytes."""
        return max((file.size for file in self._open.values()), default=0)

    @property
    def full(self) -> bool:
        """True if there are too many open files."""
        return len(self._open) >= MAX_FILES

    def flush(self) -> None:
        """Write the rows in memory to their files."""
        for file in self._open.values():
            file.flush()

    def skip(self, sequence: int) -> None:
        """Note that a message has nothing to write."""
        self.received = sequence
        self.messages += 1

    def add(self, sequence: int, source: str, header: Header, layout: Layout, data: bytes) -> None:
        """Add the frames of a message, unless they are written already.

        Args:
            sequence: Number of the message in the stream of the history.
            source: Name of the source.
            header: Header of the message.
            layout: Layout of its frames.
            data: The message.

        """
        self.skip(sequence)
        if not re.match(NAME_PATTERN, source):
            log.warning("a message of %r is left out: this is not the name of a source", source)
            return
        try:
            frames = [entry for entry in decode_entries(data) if isinstance(entry, Frame)]
            if any(len(frame.raw) != layout.size for frame in frames):
                raise ValueError("the size of a frame does not match its layout")
        except ValueError as error:
            log.warning("message %d of %s is malformed, and left out: %s", header.number, source, error)
            return
        if not self._is_new(source, header):
            return
        for frame in frames:
            time_ns = log_time(header, frame)
            self._file(sequence, source, header.layout, layout, time_ns).add(time_ns, frame)

    def _is_new(self, source: str, header: Header) -> bool:
        streams = self._written.setdefault(source, {})
        numbers = streams.pop(str(header.stream), None) or NumberSet()
        streams[str(header.stream)] = numbers  # the newest is the last
        while len(streams) > MAX_STREAMS:
            del streams[next(iter(streams))]
        return numbers.add(header.number)

    def _file(self, sequence: int, source: str, digest: bytes, layout: Layout, time_ns: int) -> _OpenFile:
        day = min(time_ns // _DAY_NS, _MAX_DAY)
        name = f"day={datetime.fromtimestamp(day * 86_400, UTC):%Y-%m-%d}"
        key = source, digest, name
        if key not in self._open:
            path = self._folder / name / f"{source}-{self._state.stream}-{sequence:012d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._open[key] = _OpenFile(path, DumpBlock(source, 1, layout, layout.hash.hex(), 0, 0))
        return self._open[key]

    def commit(self) -> list[ClosedFile]:
        """Close all files, and make them visible. Then the messages so far need not be read again.

        Raises:
            OSError: A file cannot be written.

        """
        files = list(self._open.values())
        for file in files:
            file.close()
        if self._state.last == self.received and not files:
            return []
        state = ArchiveState(
            self._state.created,
            self._state.stream,
            self.received,
            [str(file.path.relative_to(self._folder)) for file in files],
            {
                source: {stream: list(numbers.ranges) for stream, numbers in streams.items()}
                for source, streams in self._written.items()
            },
        )
        self._store(state)
        self._state, self._open, self.messages = state, {}, 0
        self._rename()
        return [ClosedFile(file.path, file.rows) for file in files]

    def _store(self, state: ArchiveState) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        for folder in {(self._folder / file).parent for file in state.files} | {self._folder.parent}:
            _sync_folder(folder)  # the hidden files must be there if the state names them
        new = self._folder / f"{STATE}.new"
        with new.open("wb") as stream:
            stream.write(msgspec.json.encode(state))
            stream.flush()
            os.fsync(stream.fileno())
        new.replace(self._folder / STATE)
        _sync_folder(self._folder)

    def _rename(self) -> None:
        """Give the files of the last commit their names, unless they have them."""
        files = [self._folder / file for file in self._state.files]
        for file in files:
            if (part := _part(file)).exists():
                part.replace(file)
        for folder in {file.parent for file in files if file.parent.exists()}:
            _sync_folder(folder)

    def discard(self) -> None:
        """Close and remove the files that are not committed."""
        for file in self._open.values():
            file.discard()
        self._open = {}


class _OpenFile:
    """A Parquet file that is being written, under its hidden name."""

    def __init__(self, path: Path, block: DumpBlock) -> None:
        self.path = path
        self._block = block
        self._registers = block.layout.registers
        self._stream = _part(path).open("wb")
        self._table = ParquetTable(self._stream, self._registers)
        self._collector = Collector(block.source)
        self._times: list[int] = []
        self._records = bytearray()

    @property
    def memory(self) -> int:
        """Size of the rows that are not in the file yet, in bytes."""
        return len(self._records) + self._table.waiting_bytes

    @property
    def size(self) -> int:
        """Size of the file so far, in bytes."""
        return self._stream.tell()

    @property
    def rows(self) -> int:
        """Number of rows."""
        return self._table.rows

    def add(self, time_ns: int, frame: Frame) -> None:
        """Add a row."""
        self._times.append(time_ns)
        self._records += record(frame)
        if len(self._records) >= DECODED_BYTES:
            self._decode()

    def _decode(self) -> None:
        if not self._times:
            return
        records = np.frombuffer(bytes(self._records), np.uint8).reshape(len(self._times), -1)
        batch = Batch(np.array(self._times, np.int64), records, None)
        self._times, self._records = [], bytearray()
        self._collector.add(self._block, self._registers, batch)
        self._table.write(self._collector.columns())

    def flush(self) -> None:
        """Write all rows to the file."""
        self._decode()
        self._table.flush()

    def close(self) -> None:
        """Write the rest of the file, and wait until the disk has it."""
        self._decode()
        self._table.close()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()

    def discard(self) -> None:
        """Remove the file."""
        with suppress(OSError):  # the disk may be full
            self._table.close()
        with suppress(OSError):
            self._stream.close()
        _part(self.path).unlink(missing_ok=True)


def _part(file: Path) -> Path:
    """Return the hidden name of a file that is being written."""
    return file.with_name(f".{file.name}{PART}")


def _sync_folder(folder: Path) -> None:
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
