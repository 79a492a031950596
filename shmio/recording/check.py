"""Verifies that a whole recording conforms to its format (docs/reference/dump-format.md)."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Final

from mcap.opcode import Opcode

from shmio.errors import RecordingError
from shmio.recording.format.encoding import EVENT, FRAME, Channel, Gap
from shmio.recording.format.records import BROKEN, U32, U64, Damage, DamageLog, Record
from shmio.recording.reading.reader import Reader
from shmio.recording.reading.survey import MAX_BLOCKS, Count, read_index
from shmio.recording.times import lost

MAX_TOLD: Final = 1000
"""A result lists at most this many damaged places, and this many problems, but it counts all of them."""


@dataclass(slots=True)
class Findings:
    """The result of a check."""

    chunks: int = 0
    """Number of intact chunks."""
    messages: int = 0
    damage: list[Damage] = field(default_factory=list)
    """The first damaged places, which are parts of the file that cannot be read."""
    problems: list[str] = field(default_factory=list)
    """Messages about the first places that can be read but are inconsistent."""
    count: int = 0
    """Total number of damaged places and problems."""

    @property
    def whole(self) -> bool:
        """True if the recording is intact."""
        return self.count == 0

    def texts(self) -> list[str]:
        """Return a message for each damage and problem in the lists, and one with the number of all others."""
        found = [lost(damage) for damage in self.damage] + self.problems
        more = self.count - len(found)
        return [*found, f"and {more} more such places"] if more else found


def check(reader: Reader, at: Callable[[int], object] = lambda _: None) -> Findings:
    """Verify all CRCs and messages, and that the file has a gap for each missing frame or event.

    If the file was not closed, check the part that exists.

    Args:
        reader: Reader of the file.
        at: Called with the byte offset that the check has reached, to report progress.

    Raises:
        RecordingError: The file is not a recording of shmio.
    """
    steps = check_by_record(reader)
    while True:
        try:
            at(next(steps))
        except StopIteration as end:
            found: Findings = end.value
            return found


def check_by_record(reader: Reader) -> Generator[int, None, Findings]:
    """Check a file as :func:`check` does, but yield the byte offset of each record before its check.

    Between two records, the caller may do other work, or give up. The generator returns the
    findings.
    """
    work = _Check(reader)
    for record in reader.records.walk():
        yield record.start
        work.take(record)
    return work.end()


class _Check:
    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self._records = reader.records
        self._found = Findings()
        self._log = DamageLog(self._damaged)
        self._numbers = _Numbers(self._problem)
        self._chunk: Record | None = None
        """The last chunk.

        The check compares its messages with the indexes that follow the chunk.
        """
        self._counts: dict[int, Count] = {}
        self._indexes: dict[int, Count] = {}

    def take(self, record: Record) -> None:
        """Check the next record."""
        try:
            if record.opcode == Opcode.MESSAGE_INDEX:
                self._index(record)
                return
            if record.opcode != BROKEN:  # a broken record may be the rest of the indexes
                self._compare_indexes()
            self._chunk, self._counts, self._indexes = None, {}, {}
            if record.opcode == Opcode.CHUNK:
                self._read_chunk(record)
                return
            self._reader.note(record)
            if record.opcode == Opcode.ATTACHMENT:
                self._records.check_crc(record)
            elif record.opcode == Opcode.DATA_END:
                self._check_data(record)
            elif record.opcode == Opcode.FOOTER and (damage := self._records.summary_damage()):
                self._problem(damage)
        except RecordingError as error:
            self._log.add(record, error)

    def end(self) -> Findings:
        """Return the findings.

        Raises:
            RecordingError: The file is not a recording of shmio.
        """
        self._log.end()
        self._reader.require_ours()
        return self._found

    def _damaged(self, damage: Damage) -> None:
        self._found.count += 1
        if len(self._found.damage) < MAX_TOLD:
            self._found.damage.append(damage)

    def _problem(self, text: str) -> None:
        self._found.count += 1
        if len(self._found.problems) < MAX_TOLD:
            self._found.problems.append(text)

    # ---- chunks ------------------------------------------------------------------------------------------------------

    def _read_chunk(self, record: Record) -> None:
        first_ns, last_ns = self._records.chunk_times(record)
        messages = self._reader.raw(record)
        self._log.end(first_ns)
        times: list[int] = []
        problem: RecordingError | None = None
        for channel, log_ns, data in messages:
            times.append(log_ns)
            old = self._counts.get(channel.number, Count(channel.number, 0, log_ns, log_ns))
            self._counts[channel.number] = old._replace(messages=old.messages + 1, last_ns=log_ns)
            try:
                self._message(channel, data)
            except RecordingError as error:
                problem = error
        if problem:
            raise problem
        self._log.after(last_ns)
        self._found.chunks += 1
        self._found.messages += len(times)
        self._chunk = record
        if times and (min(times), max(times)) != (first_ns, last_ns):
            self._problem(f"the chunk at byte {record.at}: its times differ from those of its messages")

    def _message(self, channel: Channel, data: memoryview) -> None:
        if channel.encoding in (EVENT, FRAME) and len(data) >= U64.size:  # count it even if it cannot be decoded
            self._numbers.take(channel, *U64.unpack_from(data))
        item = self._reader.decode(channel, data)
        if isinstance(item, Gap):
            self._numbers.gap(item)

    def _index(self, record: Record) -> None:
        count = read_index(self._reader, record)
        if count is None:
            raise RecordingError(f"{self._reader.file}: the index at byte {record.at} is damaged")
        channel = self._reader.channel(count.channel)
        if channel is None or channel.encoding:  # ignore the channels of other programs
            self._indexes[count.channel] = count

    def _compare_indexes(self) -> None:
        if self._chunk is not None and self._indexes != self._counts:
            self._problem(f"the chunk at byte {self._chunk.at}: its indexes do not match its content")

    # ---- the checksum of all data ------------------------------------------------------------------------------------

    def _check_data(self, record: Record) -> None:
        """Check the CRC of the file's data, which covers chunks, metadata, times and indexes."""
        self._log.end()
        (crc,) = U32.unpack(self._records.read(record.at, U32.size))
        if crc and self._found.whole and self._records.crc(0, record.start) != crc:
            self._problem("bytes between the chunks were changed: the checksum of all data is wrong")


class _Numbers:
    """Checks that a gap is recorded wherever the frame or event numbers of a block have a jump."""

    def __init__(self, problem: Callable[[str], None]) -> None:
        self._problem = problem
        self._last: dict[tuple[str, int, str], int] = {}
        self._first: dict[tuple[str, int, str], int] = {}
        self._known: set[int] = set()

    def take(self, channel: Channel, number: int) -> None:
        """Check the number of the next frame or event."""
        key = channel.source, channel.block, "frames" if channel.encoding == FRAME else "events"
        if channel.number not in self._known:
            self._known.add(channel.number)
            begin = self._first.get(key, number)
            if begin != channel.after + 1:
                self._broken(key, channel.after, begin)
        self._continue(key, number, number)

    def gap(self, gap: Gap) -> None:
        """Check the range of numbers in the next gap."""
        self._continue((gap.source, gap.block, gap.what), gap.first, gap.last)

    def _continue(self, key: tuple[str, int, str], first: int, last: int) -> None:
        if key not in self._last:
            if len(self._last) >= MAX_BLOCKS:
                raise RecordingError(
                    f"the file is too large to check: it has more than {MAX_BLOCKS} series of frames or events (each "
                    "block has one of each)"
                )
            self._first[key] = first
        elif first != self._last[key] + 1:
            self._broken(key, self._last[key], first)
        self._last[key] = max(last, self._last.get(key, 0))

    def _broken(self, key: tuple[str, int, str], last: int, number: int) -> None:
        source, block, what = key
        missing = f"{what} {last + 1} to {number - 1} are missing, but no gap is recorded for them"
        again = f"{what}: number {number} comes after number {last}"
        self._problem(f"{source}, block {block}: {missing if number > last else again}")
