"""One file of a dump, read from any time on."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Final, TypeVar

from mcap.opcode import Opcode

from shmio.dump.batch import Batch, batch, frames
from shmio.dump.damage import Damage, DamageLog
from shmio.dump.reader import Message, Reader
from shmio.dump.records import Record
from shmio.dump.summary import survey_by_index
from shmio.dump.survey import survey
from shmio.errors import RecordingError
from shmio.segment.frame import Frame

MAX_NS: Final = (1 << 63) - 1

Damaged = Callable[[Path, Damage], object]
T = TypeVar("T")


class Part:
    """A file, and where in it what is. OSError, RecordingError: it cannot be opened, or is no recording of ours."""

    def __init__(self, file: Path, damaged: Damaged | None) -> None:
        """``damaged`` is told of what cannot be read; without it RecordingError is raised there."""
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
        """Messages of the channels with these numbers in a range of log times, as the file has them."""
        records = (record for record, _, _ in self._chunks(from_ns, to_ns, channels))
        damaged = self._tell if self._damaged else None
        yield from self.reader.messages(
            lambda channel: channel.number in channels, max(from_ns, 0), to_ns, damaged, records
        )

    def messages_before(self, channels: Collection[int], time_ns: int) -> Iterator[list[Message]]:
        """Messages not after a time, chunk by chunk, the last chunk first; in each as the file has them."""
        for record, _, _ in self.found.chunks.before(time_ns, self._sure(channels)):
            damaged = self._tell if self._damaged else None
            wanted = lambda channel: channel.number in channels  # noqa: E731
            yield list(self.reader.messages(wanted, 0, time_ns, damaged, [record]))

    def batches(self, number: int, size: int, from_ns: int, to_ns: int, *, raw: bool) -> Iterator[Batch]:
        """Frames of a channel, whose images have this size, chunk by chunk."""
        channel = self.reader.channels[number]
        for found in self._each(
            channel.number, from_ns, to_ns, lambda data: batch(data, channel, size, from_ns, to_ns, raw=raw)
        ):
            if found is not None:
                yield found

    def frames(self, number: int, size: int, from_ns: int, to_ns: int) -> Iterator[tuple[int, Frame]]:
        """The same as objects, with their log times."""
        channel = self.reader.channels[number]
        for found in self._each(number, from_ns, to_ns, lambda data: frames(data, channel, size, from_ns, to_ns)):
            yield from found

    def _each(self, channel: int, from_ns: int, to_ns: int, decode: Callable[[bytes], T]) -> Iterator[T]:
        """What is made of each chunk that may have something of a channel in a range of log times."""
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
            self.reader.note(record)  # which says what is wrong with it
        data = self.reader.records.unpacked(record)
        try:
            return decode(data)
        except RecordingError as error:
            raise RecordingError(f"{self.file}: the chunk at byte {record.at}: {error}") from None

    def _chunks(self, from_ns: int, to_ns: int, channels: Collection[int]) -> Iterator[tuple[Record, int, int]]:
        return self.found.chunks.between(from_ns, to_ns, self._sure(channels))

    def _sure(self, channels: Collection[int]) -> Collection[int] | None:
        """A chunk's own index has no CRC: it must not hide a chunk that is whole."""
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
