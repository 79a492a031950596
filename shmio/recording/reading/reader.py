"""Reads the messages, layouts and metadata of one recording file."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Header, Metadata

from shmio.errors import LayoutError, RecordingError
from shmio.layout.document import load_layout
from shmio.layout.model import Layout
from shmio.recording.format.encoding import (
    ABOUT,
    EVENT,
    FRAME,
    GAP,
    MAX_CHANNEL_BYTES,
    MAX_CHANNELS,
    PLACES,
    PROCESS,
    PROFILE,
    STEP,
    BlockPosition,
    Channel,
    Gap,
    ProcessChange,
    StepMark,
    decode_channel,
    decode_event,
    decode_frame,
    decode_gap,
    decode_position,
    decode_process,
    decode_step,
    restore,
)
from shmio.recording.format.records import (
    BROKEN,
    LOOK_BYTES,
    MAGIC,
    ONLY_BEGUN,
    Damage,
    DamageLog,
    Record,
    Records,
    stream,
)
from shmio.segment import Event, Frame

MAX_LAYOUT_BYTES: Final = 64 << 20
"""Largest total size of all layouts in a file, in bytes."""
MAX_ATTACHMENTS: Final = 10_000

_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_ATTACHMENT_HEAD: Final = 4096  # bytes for the times, name, media type and size of an attachment
_LAYOUTS: Final = "layouts/"


Item = Frame | Event | Gap | StepMark | ProcessChange

_DECODERS: Final[dict[str, Callable[[bytes], Item]]] = {
    EVENT: decode_event,
    GAP: decode_gap,
    STEP: decode_step,
    PROCESS: decode_process,
}


class Message(NamedTuple):
    """A message of a recording: a frame, an event, a gap, the end of a step or a process change."""

    channel: Channel
    log_ns: int
    item: Item


class AttachmentEntry(NamedTuple):
    """Offset and size of an attachment's data in the file, and the record that contains it."""

    at: int
    size: int
    record: Record


class Reader:
    """Reads one file of a recording. Use it as a context manager.

    The file may be closed, still being written, or left by a killed recorder. :meth:`messages` adds
    the channels that it finds to ``channels``.

    Raises:
        OSError: The file cannot be opened.
        RecordingError: The file is not a recording.
    """

    def __init__(self, file: Path, *, own: bool = False, beat: Callable[[], object] = lambda: None) -> None:
        """Open the file.

        Args:
            file: The path.
            own: True to accept only a regular file of this user.
            beat: Called at intervals during reading, so that a process can write its heartbeat.
        """
        self.file = file
        self.records = Records(file, own=own, beat=beat)
        self.about: dict[str, str] = {}
        """Metadata about the instance that the recorder has written."""
        self.places: dict[int, BlockPosition] = {}
        """Position in each block at which the previous recording ended, by section."""
        self.complete = False
        """True if all channels are known, because the whole file was read."""
        self.channels: dict[int, Channel] = {}
        self.summary_damage = ""
        """Message about the first damaged record of the summary that was needed, else empty."""
        self.attachments: dict[str, AttachmentEntry] = {}
        self._layouts: dict[str, Layout] = {}
        self._layout_bytes = 0
        self._summarized = False
        self._ours = False  # according to the file's header

    def messages(
        self,
        wanted: Callable[[Channel], bool] = lambda _: True,
        from_ns: int = 0,
        to_ns: int = (1 << 64) - 1,
        damaged: Callable[[Damage], object] | None = None,
        records: Iterable[Record] | None = None,
    ) -> Iterator[Message]:
        """Yield the messages of some channels in a range of log times, in file order.

        After the last message, :attr:`Records.closed` and :attr:`Records.damage` say how the file
        ends. As soon as all channels are known, the reader skips chunks outside the range.

        Args:
            wanted: Returns whether to read a channel.
            from_ns: Start of the range, log time in ns.
            to_ns: End of the range, log time in ns.
            damaged: Called for each damaged place in the range; reading then continues with the next
                intact chunk. None: damage raises RecordingError.
            records: The records to read; None for the whole file.
        """

        def report(damage: Damage) -> None:
            if damaged and damage.after_ns <= to_ns and not 0 < damage.before_ns < from_ns:
                damaged(damage)

        log = DamageLog(report)
        for record in self.records.walk() if records is None else records:
            try:
                if record.opcode == Opcode.CHUNK:
                    first_ns, last_ns = self.records.chunk_times(record)
                    if (first_ns <= to_ns and last_ns >= from_ns) or not self.complete:
                        contents = self.raw(record)
                        log.end(first_ns)
                        yield from self._decoded(contents, wanted, from_ns, to_ns)
                    log.after(last_ns)
                else:
                    self.note(record)
            except RecordingError as error:
                if damaged is None:
                    raise
                log.add(record, error)
        log.end()

    def _decoded(
        self,
        contents: Iterator[tuple[Channel, int, memoryview]],
        wanted: Callable[[Channel], bool],
        from_ns: int,
        to_ns: int,
    ) -> Iterator[Message]:
        """Yield the messages of a chunk.

        Raises:
            RecordingError: The chunk is damaged. If only a message is malformed, the error comes
                after the last message.
        """
        problem: RecordingError | None = None
        for channel, log_ns, data in contents:
            if from_ns <= log_ns <= to_ns and wanted(channel):
                try:
                    item = self.decode(channel, data)
                except RecordingError as error:
                    problem = error
                else:
                    yield Message(channel, log_ns, item)
        if problem:
            raise problem

    def raw(self, record: Record) -> Iterator[tuple[Channel, int, memoryview]]:
        """Yield (channel, log time, data) of each message in a chunk.

        Messages of other programs are skipped. Frames of both versions are converted to FRAME. The
        channels that the chunk describes are added to ``channels``.

        Raises:
            RecordingError: The chunk is damaged; or the channel of a message is unknown, and all
                other messages of the chunk were yielded before.
        """
        return self._raw(self.records.chunk(record))

    def _raw(self, contents: Iterator[tuple[int, memoryview]]) -> Iterator[tuple[Channel, int, memoryview]]:
        unknown: int | None = None
        for opcode, content in contents:
            if opcode == Opcode.CHANNEL:
                self._channel(content)
            elif opcode == Opcode.MESSAGE:
                if len(content) < _MESSAGE.size:
                    raise RecordingError(f"{self.file}: a message is shorter than its header")
                number, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content)
                channel = self.channel(number)
                if channel is None:
                    unknown = number
                    continue
                data = content[_MESSAGE.size :]
                if channel.differences:
                    data = memoryview(restore(bytes(data), sequence, log_ns, publish_ns))
                if channel.encoding:
                    yield channel, log_ns, data
        if unknown is not None:
            raise RecordingError(f"{self.file}: the file has messages of channel {unknown}, which has no description")

    def channel(self, number: int) -> Channel | None:
        """Return a channel by its number; None if it is unknown.

        If the chunk that describes the channel is damaged, the description comes from the summary of
        the closed file. If the summary is damaged, too, :attr:`summary_damage` says so; other
        channels are not affected.
        """
        if number not in self.channels and not self._summarized:
            self._summarized = True
            for record in self.records.summary():
                if record.opcode == Opcode.CHANNEL:
                    try:
                        self._channel(memoryview(self.records.read(record.at, record.size)))
                    except RecordingError as error:
                        self.summary_damage = self.summary_damage or f"{error} (byte {record.at}, in the index)"
        return self.channels.get(number)

    def decode(self, channel: Channel, data: memoryview) -> Item:
        """Decode a message.

        Raises:
            RecordingError: The message is malformed.
        """
        try:
            if channel.encoding == FRAME:
                frame = decode_frame(bytes(data))
                if len(frame.raw) != self.layout(channel).size:
                    raise ValueError("the size of a frame does not match its layout")
                return frame
            return _DECODERS[channel.encoding](bytes(data))
        except ValueError as error:
            raise RecordingError(f"{self.file}: {channel.topic}: {error}") from None

    def layout(self, channel: Channel) -> Layout:
        """Return the layout of a channel's block.

        Raises:
            RecordingError: The layout is missing in the file, or is damaged.
        """
        digest = channel.layout
        if digest not in self._layouts:
            entry = self.attachments.get(f"{_LAYOUTS}{digest}.json")
            if entry is None:
                raise RecordingError(f"{self.file}: the layout of {channel.topic} is not in the file")
            self._layout_bytes += entry.size
            data = self.records.read(entry.at, entry.size, MAX_LAYOUT_BYTES - self._layout_bytes + entry.size)
            if hashlib.sha256(data).hexdigest() != digest:
                raise RecordingError(f"{self.file}: the layout of {channel.topic} is damaged")
            try:
                self._layouts[digest] = load_layout(data, bytes.fromhex(digest))
            except LayoutError as error:
                raise RecordingError(f"{self.file}: the layout of {channel.topic}: {error}") from None
        return self._layouts[digest]

    def attachment(self, name: str, limit: int = MAX_LAYOUT_BYTES) -> bytes:
        """Return the data of an attachment, and check its CRC.

        Raises:
            RecordingError: The attachment is damaged, or larger than ``limit`` bytes.
        """
        entry = self.attachments[name]
        self.records.check_crc(entry.record)
        return self.records.read(entry.at, entry.size, limit)

    def note(self, record: Record) -> None:
        """Take the content of a record outside the chunks: metadata, a header or an attachment's entry.

        Raises:
            RecordingError: The record is damaged.
        """
        if record.opcode == BROKEN:
            raise RecordingError(f"{self.file}: bytes {record.at} to {record.at + record.size - 1} are damaged")
        try:
            if record.opcode == Opcode.METADATA:
                metadata = Metadata.read(stream(self.records.read(record.at, record.size)))
                if metadata.name == ABOUT:
                    self.about = metadata.metadata
                elif metadata.name == PLACES:
                    self.places = {int(section): decode_position(place) for section, place in metadata.metadata.items()}
            elif record.opcode == Opcode.HEADER:
                self._ours = self._profile(record) == PROFILE
            elif record.opcode == Opcode.ATTACHMENT and len(self.attachments) < MAX_ATTACHMENTS:
                self._attachment(record)
        except (ValueError, struct.error, McapError):
            raise RecordingError(f"{self.file}: the record at byte {record.at} is damaged") from None

    def _is_cut_short(self) -> bool:
        """Return whether the file ends within its header."""
        start = self.records.read(len(MAGIC), min(1, self.records.size - len(MAGIC)))
        return start in (b"", bytes([Opcode.HEADER])) and self.records.record(len(MAGIC)) is None

    def _profile(self, record: Record) -> str:
        """Return the profile in the file's header; empty if the header is damaged."""
        with suppress(ValueError, struct.error, McapError):
            return str(Header.read(stream(self.records.read(record.at, min(record.size, LOOK_BYTES)))).profile)
        return ""

    def _attachment(self, record: Record) -> None:
        data = stream(self.records.read(record.at, min(record.size, _ATTACHMENT_HEAD)))
        data.read(16)
        name = data.read_prefixed_string()
        data.read_prefixed_string()
        size = data.read8()
        if data.count + size + 4 != record.size:
            raise ValueError("its sizes are inconsistent")
        self.attachments[name] = AttachmentEntry(record.at + data.count, size, record)

    def _channel(self, content: memoryview) -> None:
        if len(content) > MAX_CHANNEL_BYTES or len(self.channels) >= MAX_CHANNELS:
            raise RecordingError(
                f"{self.file}: the file has more, or longer, descriptions of channels than a recorder writes"
            )
        try:
            channel = decode_channel(content)
        except (ValueError, KeyError, struct.error, McapError):
            raise RecordingError(f"{self.file}: the description of a channel is damaged") from None
        if self.channels.setdefault(channel.number, channel) != channel:  # messages would be ambiguous
            raise RecordingError(f"{self.file}: channel {channel.number} has two different descriptions")

    def require_ours(self) -> None:
        """Raise RecordingError unless shmio wrote the part of the file that was read."""
        if not self.about and not any(channel.encoding for channel in self.channels.values()):
            if not self.records.closed and (self._ours or self._is_cut_short()):
                raise RecordingError(f"{self.file} {ONLY_BEGUN}")
            raise RecordingError(f"{self.file} is an MCAP file, but not a recording of shmio")

    def close(self) -> None:
        """Close the file."""
        self.records.close()

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
