"""Reads one file of a recording: its blocks, and its entries in a range of time."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import groupby, islice
from pathlib import Path
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np
from mcap.opcode import Opcode

from shmio.errors import RecordingError
from shmio.layout.glob import named
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic, find, parse_topic
from shmio.layout.values.codec import Value, codec
from shmio.recording.format.encoding import EVENT, FRAME, Gap, encode_frame
from shmio.recording.format.records import Damage, DamageLog, Record
from shmio.recording.reading.batch import HEAD, Batch, batch, frames
from shmio.recording.reading.reader import Item, Message, Reader
from shmio.recording.reading.survey import Track, survey, survey_by_index
from shmio.segment import Frame

MAX_NS: Final = (1 << 63) - 1
"""The largest log time, used as the end of a range that has no end."""
BATCH_FRAMES: Final = 256
"""Number of frames that :func:`batches_of` joins to a batch."""

Damaged = Callable[[Path, Damage], object]
T = TypeVar("T")
ItemT_co = TypeVar("ItemT_co", bound=Item, covariant=True)


@dataclass(slots=True, eq=False)
class DumpBlock:
    """A part of a recording in which a source has one layout. A reload that changes it begins a new block.

    No two blocks of a run have the same ``section``, even in different files. ``layout_hash`` is a
    SHA-256 in hexadecimal digits.
    """

    source: str
    section: int
    layout: Layout
    layout_hash: str
    period_ns: int
    stale_ns: int
    of: str = ""
    """Hash of the source's whole layout if only some registers were recorded; else empty."""
    frames: int = 0
    """Number of recorded frames; a frame that is in two files counts twice."""
    events: int = 0
    after: dict[str, int] = field(default_factory=dict)
    """The numbers of the last frame (key ``frames``) and the last event (key ``events``) before the recording."""
    begin_ns: int = 0
    end_ns: int = 0
    """Log times of the first (``begin_ns``) and the last (``end_ns``) frame or event."""
    first_ns: int = 0
    last_ns: int = 0
    """Log times of the first (``first_ns``) and the last (``last_ns``) frame."""

    def add(self, kind: str, track: Track) -> None:
        """Add the count and the times of the block's frames or events in a file, according to ``kind``."""
        if kind == FRAME:
            self.frames += track.count
            self.first_ns = min(self.first_ns or track.first_ns, track.first_ns)
            self.last_ns = max(self.last_ns, track.last_ns)
        else:
            self.events += track.count
        self.begin_ns = min(self.begin_ns or track.first_ns, track.first_ns)
        self.end_ns = max(self.end_ns, track.last_ns)

    def register(self, path: str) -> Register:
        """Return a register or array element by its path, with or without the source.

        Raises:
            PathError: There is no such register.
        """
        return find(self.layout, parse_topic(path, (self.source,), self.source).path)

    def named(self, topic: Topic) -> list[Register]:
        """Return the registers of the block that a topic names.

        Raises:
            PathError: There is no such register.
        """
        return named(self.layout, topic)

    def value(self, frame: Frame, path: str) -> Value:
        """Return the value of a register, as readers saw it, in a frame of this block.

        Raises:
            PathError: There is no such register.
        """
        return codec(self.register(path), self.layout.byte_order).decode(frame.image)


@dataclass(slots=True)
class Contents:
    """The channels of one file, grouped by block."""

    blocks: dict[int, DumpBlock] = field(default_factory=dict)
    """The block of each channel with frames or events, by the channel's number."""
    kinds: dict[int, str] = field(default_factory=dict)
    instance: set[int] = field(default_factory=set)
    """The numbers of the channels with gaps, steps and process changes of the instance."""
    numbered: dict[tuple[str, int], DumpBlock] = field(default_factory=dict)
    """Each block, by its source and its number in this file."""
    number: dict[DumpBlock, int] = field(default_factory=dict)

    def frames(self, source: str) -> list[int]:
        """Return the numbers of the channels with frames of a source, in the order in which the blocks began."""
        return [number for number, kind in self.kinds.items() if kind == FRAME and self.blocks[number].source == source]

    def events(self, sources: Collection[str]) -> list[int]:
        """Return the numbers of the channels with events of these sources."""
        return [
            number for number, kind in self.kinds.items() if kind == EVENT and self.blocks[number].source in sources
        ]


def contents(part: Part, blocks: dict[tuple[str, int, str], DumpBlock]) -> Contents:
    """Return the contents of a file, and add its new blocks to ``blocks``.

    Leave out each block with a damaged layout, and add a message about it to the damage in the
    file's survey.
    """
    found = Contents()
    for channel in sorted(part.reader.channels.values(), key=lambda channel: (channel.block, channel.number)):
        if channel.encoding not in (FRAME, EVENT):
            if channel.encoding:
                found.instance.add(channel.number)
            continue
        key = channel.source, channel.section, channel.layout
        if key not in blocks:
            try:
                layout = part.reader.layout(channel)
            except RecordingError as error:
                if str(error) not in part.found.damage:
                    part.found.damage.append(str(error))
                continue
            blocks[key] = DumpBlock(*key[:2], layout, channel.layout, channel.period_ns, channel.stale_ns, channel.of)
        block = blocks[key]
        block.after.setdefault("frames" if channel.encoding == FRAME else "events", channel.after)
        if track := part.found.tracks.get(channel.number):
            block.add(channel.encoding, track)
        found.blocks[channel.number] = found.numbered[channel.source, channel.block] = block
        found.kinds[channel.number] = channel.encoding
        found.number[block] = channel.block
    return found


class Part:
    """One file of a recording, with a survey of its contents.

    Raises:
        OSError: The file cannot be opened.
        RecordingError: The file is not a recording of shmio.
    """

    def __init__(
        self,
        file: Path,
        damaged: Damaged | None,
        *,
        own: bool = False,
        beat: Callable[[], object] = lambda: None,
    ) -> None:
        """Open a file.

        Args:
            file: The path.
            damaged: Called for damage; if it is None, damage raises RecordingError.
            own: True to accept only a regular file of this user.
            beat: Called at intervals during reading. If it raises an exception, reading ends.
        """
        self.file = file
        self.reader = Reader(file, own=own, beat=beat)
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
        """Yield the messages of some channels in a range of log times, in file order."""
        records = (record for record, _, _ in self._chunks(from_ns, to_ns, channels))
        damaged = self._report if self._damaged else None
        yield from self.reader.messages(
            lambda channel: channel.number in channels, max(from_ns, 0), to_ns, damaged, records
        )

    def messages_before(self, channels: Collection[int], time_ns: int) -> Iterator[list[Message]]:
        """Yield the messages of each chunk up to a time, from the last chunk to the first.

        The messages of a chunk are in file order.
        """
        for record, _, _ in self.found.chunks.before(time_ns, self._sure(channels)):
            damaged = self._report if self._damaged else None
            wanted = lambda channel: channel.number in channels  # noqa: E731
            yield list(self.reader.messages(wanted, 0, time_ns, damaged, [record]))

    def batches(self, number: int, size: int, from_ns: int, to_ns: int, *, raw: bool) -> Iterator[Batch]:
        """Yield the frames of a channel as arrays, chunk by chunk.

        Args:
            number: Number of the channel.
            size: Size of an image in bytes.
            from_ns: First log time, in ns.
            to_ns: Last log time, in ns.
            raw: True for the images that the source delivered; False for the images that readers saw.
        """
        channel = self.reader.channels[number]
        for found in self._each(
            number, from_ns, to_ns, lambda data: batch(data, channel, size, from_ns, to_ns, raw=raw)
        ):
            if found is not None:
                yield found

    def frames(self, number: int, size: int, from_ns: int, to_ns: int) -> Iterator[tuple[int, Frame]]:
        """Yield the frames of a channel as objects, with their log times: see :meth:`batches`."""
        channel = self.reader.channels[number]
        for found in self._each(number, from_ns, to_ns, lambda data: frames(data, channel, size, from_ns, to_ns)):
            yield from found

    def _each(self, channel: int, from_ns: int, to_ns: int, decode: Callable[[bytes], T]) -> Iterator[T]:
        """Decode each chunk that may have messages of a channel in a range of log times."""
        log = DamageLog(self._report)
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
            self.reader.note(record)  # raises RecordingError if the record is damaged
        data = self.reader.records.unpacked(record)
        try:
            return decode(data)
        except RecordingError as error:
            raise RecordingError(f"{self.file}: the chunk at byte {record.at}: {error}") from None

    def _chunks(self, from_ns: int, to_ns: int, channels: Collection[int]) -> Iterator[tuple[Record, int, int]]:
        return self.found.chunks.between(from_ns, to_ns, self._sure(channels))

    def _sure(self, channels: Collection[int]) -> Collection[int] | None:
        """Return the channels if the summary's CRC was correct, else None to select all chunks.

        Without the summary, only each chunk's own index says which channels it has. This index has
        no CRC. If it is damaged, it must not hide an intact chunk.
        """
        return channels if self._indexed else None

    def _report(self, damage: Damage) -> None:
        if self._damaged:
            self._damaged(self.file, damage)

    def close(self) -> None:
        """Close the file."""
        self.reader.close()

    def __enter__(self) -> Part:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Entry(NamedTuple, Generic[ItemT_co]):
    """A recorded item with its log time.

    ``block`` is None if the item concerns the whole instance.
    """

    time_ns: int
    block: DumpBlock | None
    item: ItemT_co


def messages_of(
    part: Part, within: Contents, channels: Collection[int], from_ns: int, to_ns: int
) -> Iterator[tuple[Contents, Entry[Item]]]:
    """Yield the messages of some channels of ``part`` in a range of log times.

    Each is yielded together with ``within``, the contents of the file.
    """
    for channel, log_ns, item in part.messages(channels, from_ns, to_ns):
        block = (
            within.numbered.get((item.source, item.block))
            if isinstance(item, Gap)
            else within.blocks.get(channel.number)
        )
        yield within, Entry(log_ns, block, item)


def batches_of(frames: Iterable[Entry[Frame]], *, raw: bool) -> Iterator[tuple[DumpBlock, Batch]]:
    """Yield frames as batches of arrays; with ``raw``, the images are those without injections."""
    for block, of_block in groupby(frames, key=lambda entry: entry.block):
        while block is not None and (some := list(islice(of_block, BATCH_FRAMES))):
            items = [entry.item for entry in some]
            data = b"".join(encode_frame(f)[: HEAD.itemsize] + (f.raw if raw else f.image) for f in items)
            records = np.frombuffer(data, np.uint8).reshape(len(items), HEAD.itemsize + block.layout.size)
            times = np.array([entry.time_ns for entry in some], np.int64)
            yield block, Batch(times, records, [frame.reason for frame in items])


def latest_of(part: Part, within: Contents, source: str, time_ns: int) -> Entry[Frame] | None:
    """Return a source's last frame at or before a time in one file; None if there is none.

    ``within`` has the contents of the file.
    """
    for messages in part.messages_before(within.frames(source), time_ns):
        for message in reversed(messages):
            if isinstance(message.item, Frame):
                return Entry(message.log_ns, within.blocks[message.channel.number], message.item)
    return None
