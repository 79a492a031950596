"""Writes an MCAP file, byte for byte as the mcap library's own writer does, but faster for many messages.

docs/decisions/0047-recordings-are-written-in-batches.md says why.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from shmio.recording.format import _frames
from shmio.recording.format.records import FOOTER, HEAD, INDEX, MAGIC, U32

if TYPE_CHECKING:
    from shmio.segment import Frame

CHUNK_BYTES: Final = 1 << 20
"""A chunk ends when it has more bytes than this."""

_MESSAGE: Final = struct.Struct("<BQHIQQ")  # opcode, size; channel, sequence, log time, publish time
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)

Message = tuple[int, int, int, Sequence[bytes]]
"""Log time and publish time in ns, sequence, the parts of the data."""


class Output(Protocol):
    """An object to which a recording is written, such as a binary file."""

    def write(self, data: bytes, /) -> object:
        """Append data."""

    def tell(self) -> int:
        """Return the number of bytes written so far."""

    def flush(self) -> None:
        """Pass all buffered data on to the file."""


def encode(*records: McapRecord) -> bytes:
    """Return the bytes of records."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


def message_index(channel: int, entries: list[int]) -> bytes:
    """Return the record with the index of a channel's messages in a chunk.

    Args:
        channel: The channel.
        entries: For each message its log time, then its offset in the chunk.
    """
    size = 8 * len(entries)
    head = HEAD.pack(Opcode.MESSAGE_INDEX, INDEX.size + size) + INDEX.pack(channel, size)
    return head + struct.pack(f"<{len(entries)}Q", *entries)


@dataclass(slots=True)
class IndexedChunk:
    """The index of a chunk, and the number of its messages by channel."""

    index: ChunkIndex
    counts: dict[int, int] = field(default_factory=dict)


@dataclass
class Summary:
    """The content of the records at the end of a file. Schemas and channels are encoded already, by number."""

    schemas: dict[int, bytes] = field(default_factory=dict)
    channels: dict[int, bytes] = field(default_factory=dict)
    chunks: list[IndexedChunk] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)

    def end(self, at: int, crc: int) -> bytes:
        """Return the bytes from the end of the data to the end of the file.

        Args:
            at: Offset in the file at which the data ends.
            crc: CRC-32 of the file up to there.
        """
        data = encode(DataEnd(crc))
        start = at + len(data)
        groups = list(self._groups())
        records = b"".join(content for _, content in groups)
        offsets, begin = [], start
        for opcode, content in groups:
            offsets.append(SummaryOffset(opcode, begin, len(content)))
            begin += len(content)
        summary = records + encode(*offsets)
        covered = summary + HEAD.pack(Opcode.FOOTER, FOOTER.size) + FOOTER.pack(start, begin, 0)[: -U32.size]
        return b"".join((data, summary, encode(Footer(start, begin, zlib.crc32(covered))), MAGIC))

    def _groups(self) -> Iterator[tuple[Opcode, bytes]]:
        """Yield the records, grouped by kind."""
        yield Opcode.SCHEMA, b"".join(self.schemas.values())
        yield Opcode.CHANNEL, b"".join(self.channels.values())
        yield Opcode.STATISTICS, encode(self._statistics())
        yield Opcode.CHUNK_INDEX, encode(*(chunk.index for chunk in self.chunks))
        yield Opcode.ATTACHMENT_INDEX, encode(*self.attachments)
        yield Opcode.METADATA_INDEX, encode(*self.metadata)

    def _statistics(self) -> Statistics:
        counts: dict[int, int] = {}
        for chunk in self.chunks:
            for number, count in chunk.counts.items():
                counts[number] = counts.get(number, 0) + count
        return Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=counts,
            chunk_count=len(self.chunks),
            message_count=sum(counts.values()),
            message_end_time=max((chunk.index.message_end_time for chunk in self.chunks), default=0),
            message_start_time=min((chunk.index.message_start_time for chunk in self.chunks), default=0),
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


class McapWriter:
    """Writes one MCAP file with chunks, which zstd compresses, and with all indexes and checksums."""

    def __init__(self, output: Output, profile: str, library: str) -> None:
        """Begin the file. ``library`` names the program that writes it."""
        self._output = output
        self._crc = 0
        self._summary = Summary()
        self._parts: list[bytes] = []  # of the present chunk
        self._size = 0
        self._indexes: dict[int, list[int]] = {}  # of the present chunk, as for message_index()
        self._compressor = zstandard.ZstdCompressor()
        self._write(MAGIC + encode(Header(profile, library)))

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a record of metadata."""
        record, at = encode(Metadata(name, dict(data))), self._output.tell()
        self._summary.metadata.append(MetadataIndex(at, len(record), name))
        self._write(record)

    def add_attachment(self, create_ns: int, log_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Attach a file. ``create_ns`` is the time of its last change; 0 if unknown."""
        record, at = encode(Attachment(create_ns, log_ns, name, media_type, data)), self._output.tell()
        self._summary.attachments.append(
            AttachmentIndex(at, len(record), log_ns, create_ns, len(data), name, media_type)
        )
        self._write(record)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema, and return its number."""
        number = len(self._summary.schemas) + 1
        self._summary.schemas[number] = self._add(Schema(number, data, encoding, name))
        return number

    def register_channel(
        self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str] | None = None
    ) -> int:
        """Add a channel whose messages have the schema with this number, and return its number."""
        number = len(self._summary.channels) + 1
        record = Channel(number, topic, encoding, dict(metadata or {}), schema)
        self._summary.channels[number] = self._add(record)
        return number

    def _add(self, record: McapRecord) -> bytes:
        """Add a record that is not a message to the present chunk; return its bytes."""
        data = encode(record)
        self._parts.append(data)
        self._size += len(data)
        if self._size > CHUNK_BYTES:
            self._end_chunk()
        return data

    def add_messages(self, channel: int, messages: Iterable[Message]) -> None:
        """Add messages of one channel."""
        parts, index = self._parts, self._indexes.get(channel)
        for log_ns, publish_ns, sequence, data in messages:
            size = _MESSAGE.size - HEAD.size
            for part in data:
                size += len(part)
            parts.append(_MESSAGE.pack(_MESSAGE_OPCODE, size, channel, sequence, log_ns, publish_ns))
            parts += data
            if index is None:
                index = self._indexes[channel] = []
            index += log_ns, self._size
            self._size += HEAD.size + size
            if self._size > CHUNK_BYTES:
                self._end_chunk()
                parts, index = self._parts, None

    def add_frames(self, channel: int, frames: list[tuple[int, Frame]]) -> None:
        """Add frames, each with its log time, to a channel that has the encoding FRAME_V2."""
        done = 0
        while done < len(frames):
            index = self._indexes.get(channel, [])
            done, self._size = _frames.add(self._parts, index, channel, frames, done, self._size, CHUNK_BYTES)
            self._indexes[channel] = index
            if self._size > CHUNK_BYTES:
                self._end_chunk()

    def flush(self) -> None:
        """End the present chunk, and write it to the output. A chunk without messages remains open."""
        self._end_chunk()
        self._output.flush()

    def finish(self) -> None:
        """Write the index and the footer. This does not close the output."""
        self._end_chunk()
        self._output.write(self._summary.end(self._output.tell(), self._crc))

    def _end_chunk(self) -> None:
        if not self._indexes:
            return
        data = b"".join(self._parts)
        packed = self._compressor.compress(data)
        begin_ns = min(min(index[::2]) for index in self._indexes.values())
        end_ns = max(max(index[::2]) for index in self._indexes.values())
        at = self._output.tell()
        chunk = encode(Chunk("zstd", packed, end_ns, begin_ns, zlib.crc32(data), len(data)))
        indexes = {channel: message_index(channel, index) for channel, index in self._indexes.items()}
        offsets, offset = {}, at + len(chunk)
        for channel, index in indexes.items():
            offsets[channel] = offset
            offset += len(index)
        self._summary.chunks.append(
            IndexedChunk(
                ChunkIndex(
                    chunk_length=len(chunk),
                    chunk_start_offset=at,
                    compression="zstd",
                    compressed_size=len(packed),
                    message_end_time=end_ns,
                    message_index_length=offset - at - len(chunk),
                    message_index_offsets=offsets,
                    message_start_time=begin_ns,
                    uncompressed_size=len(data),
                ),
                {channel: len(index) // 2 for channel, index in self._indexes.items()},
            )
        )
        self._write(chunk)
        self._write(b"".join(indexes.values()))
        self._parts, self._size, self._indexes = [], 0, {}

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._output.write(data)
