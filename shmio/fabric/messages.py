"""Messages of the fabric: a source's frames and events, requests for those missing, and commands.

A message has a fixed header and entries, in the order in which the source published them. An entry
has the encoding of a recording (docs/reference/dump-format.md). The uplink numbers the messages of
each source without gaps, so a mirror knows which ones it has not received.
docs/reference/fabric.md describes the bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

import msgspec

from shmio.model.values import OutcomeKind
from shmio.recording.format.encoding import (
    Gap,
    decode_event,
    decode_frame,
    decode_gap,
    encode_event,
    encode_frame,
    encode_json,
)
from shmio.segment.block import Frame
from shmio.segment.events import Event

VERSION: Final = 1
MAX_MESSAGE_BYTES: Final = 1 << 20
"""Largest message: the limit that a NATS server has if its configuration gives no other."""
MAX_ENTRY_BYTES: Final = MAX_MESSAGE_BYTES - 4096
PREFERRED_BYTES: Final = 1 << 18
"""A message is ended when it has this many bytes."""

LEFT_OUT_LIMIT: Final = 1 << 32
"""The number of frames that were left out is counted modulo this."""

_HEADER: Final = struct.Struct("<BBHIQQ8sqqQ")
_ENTRY: Final = struct.Struct("<BI")
ENTRIES_AT: Final = _HEADER.size
"""Position of the first entry in a message."""
_AGE_AT: Final = _HEADER.size - 8
_FRAME: Final = 1
_EVENT: Final = 2
_GAP: Final = 3


class Header(NamedTuple):
    """The header of a message.

    Attributes:
        left_out: Number of frames that a rule of the uplink has left out since the stream began,
            before the last frame of this message, modulo 2^32. They are not missing.
        stream: Number of the uplink's numbering; a restarted uplink has another.
        number: Number of the message within the stream; the first is 1.
        layout: First 8 bytes of the hash of the layout of the frames.
        made_ns: UTC time on the owner's host at which the uplink made the message, in ns since 1970.
        age_ns: Time in ns from ``made_ns`` until the message was sent. For a message that is
            published as soon as it is made, this is 0.
        zero_ns: UTC time in ns since 1970 at which the owner's CLOCK_MONOTONIC was 0. Added to the
            publish time of a frame or event, it gives its log time in recordings. Each start of the
            owner has another.

    """

    left_out: int
    stream: int
    number: int
    layout: bytes
    made_ns: int
    age_ns: int = 0
    zero_ns: int = 0


Entry = Frame | Event | Gap


def encode(header: Header, entries: Iterable[Entry]) -> bytearray:
    """Encode a message. :func:`with_age` changes its age later."""
    return with_header(header, encode_entries(entries))


def with_header(header: Header, entries: bytearray) -> bytearray:
    """Encode a message whose entries are encoded."""
    data = bytearray(
        _HEADER.pack(
            VERSION, 0, 0, header.left_out % LEFT_OUT_LIMIT, header.stream, header.number, header.layout,
            header.made_ns, header.zero_ns, header.age_ns,
        )
    )  # fmt: skip
    data += entries
    return data


def encode_entries(entries: Iterable[Entry]) -> bytearray:
    """Encode entries of a message. For runs of plain frames, ``Ring.pack`` does the same (frames.h)."""
    data = bytearray()
    for entry in entries:
        if isinstance(entry, Frame):
            kind, content = _FRAME, encode_frame(entry)
        elif isinstance(entry, Event):
            kind, content = _EVENT, encode_event(entry)
        else:
            kind, content = _GAP, encode_json(entry)
        data += _ENTRY.pack(kind, len(content))
        data += content
    return data


def with_age(data: bytearray, age_ns: int) -> bytes:
    """Return a message with another age."""
    struct.pack_into("<Q", data, _AGE_AT, max(0, age_ns))
    return bytes(data)


def decode_header(data: bytes) -> Header:
    """Decode the header of a message.

    Raises:
        ValueError: The message is malformed, or a newer version of shmio made it.

    """
    if len(data) < _HEADER.size:
        raise ValueError("the message is shorter than its header")
    version, _, _, left_out, stream, number, layout, made_ns, zero_ns, age_ns = _HEADER.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"the message has version {version}, but this version of shmio reads only {VERSION}")
    if not stream or not number:
        raise ValueError("the message has no number")
    return Header(left_out, stream, number, layout, made_ns, age_ns, zero_ns)


def decode_entries(data: bytes, at: int = ENTRIES_AT) -> Iterator[Entry]:
    """Yield the entries of a message, from the one at a position on.

    Raises:
        ValueError: The message is malformed.

    """
    while at < len(data):
        entry, at = decode_entry(data, at)
        if entry is not None:
            yield entry


def decode_entry(data: bytes, at: int) -> tuple[Entry | None, int]:
    """Decode the entry at a position of a message.

    Returns:
        The entry, and the position after it. The entry is None if a newer version has made it, of a
        kind that this version skips.

    Raises:
        ValueError: The message is malformed.

    """
    if len(data) - at < _ENTRY.size:
        raise ValueError("the message ends within an entry")
    kind, size = _ENTRY.unpack_from(data, at)
    at += _ENTRY.size
    content = data[at : at + size]
    if len(content) != size:
        raise ValueError("the message ends within an entry")
    at += size
    if kind == _FRAME:
        return decode_frame(content), at
    if kind == _EVENT:
        return decode_event(content), at
    if kind != _GAP:
        return None, at
    try:
        return decode_gap(content), at
    except msgspec.MsgspecError as error:
        raise ValueError(f"a gap is malformed: {error}") from None


class MissingRequest(msgspec.Struct, frozen=True):
    """A request for the messages of a stream from ``first`` to ``last``.

    The uplink sends each of them to the request's reply subject, in order, with its age, and then an
    empty message. It leaves out the messages that it no longer has.
    """

    stream: int
    first: int
    last: int


MAX_ITEMS: Final = 4096
"""Maximum number of writes of a command."""
MAX_WAIT_S: Final = 60.0
"""Longest time for which the owner waits for the outcome of a command, in s."""


class WriteItem(msgspec.Struct, frozen=True, array_like=True):
    """A write to bytes of a source, or to one bit of a byte, as in the commands of a segment.

    Attributes:
        offset: Position of the first byte in the source's image.
        mask: 0: write all of ``data``. Otherwise one bit: write only this bit of one byte.
        data: The bytes.

    """

    offset: int
    mask: int
    data: bytes


class CommandRequest(msgspec.Struct, frozen=True):
    """A command of another cell to a source. The source carries out all writes or none.

    Attributes:
        expires_ns: Time on the owner's clock, as ``made_ns`` of a message, after which the source
            must not begin. The outcome of a command that comes later is expired.
        stream: Number of the uplink's numbering, from its messages. A command that was made for an
            earlier uplink is expired: it may have been stuck on its way since.
        layout: First 8 bytes of the hash of the layout that the offsets belong to. The owner
            rejects a command for another layout.
        writes: The writes.

    """

    expires_ns: int
    stream: int
    layout: bytes
    writes: list[WriteItem]


class CommandReply(msgspec.Struct, frozen=True):
    """The outcomes of a command: one for each write, in their order.

    Attributes:
        outcomes: The outcomes, each a value of :class:`shmio.model.values.OutcomeKind`.
        reasons: For each outcome, its reason; empty for a success.

    """

    outcomes: list[str]
    reasons: list[str]


def encode_command(message: CommandRequest | CommandReply) -> bytes:
    """Encode a command or its reply."""
    return msgspec.msgpack.encode(message)


def decode_request(data: bytes) -> CommandRequest:
    """Decode a command.

    Raises:
        ValueError: The message is not a command.

    """
    try:
        request = msgspec.msgpack.decode(data, type=CommandRequest)
    except msgspec.MsgspecError as error:
        raise ValueError(f"the message is not a command: {error}") from None
    if not 0 < len(request.writes) <= MAX_ITEMS:
        raise ValueError(f"a command has 1 to {MAX_ITEMS} writes, but this one has {len(request.writes)}")
    for item in request.writes:
        bit = len(item.data) == 1 and 0 < item.mask < 256 and item.mask & (item.mask - 1) == 0
        if item.offset < 0 or not item.data or (item.mask and not bit):
            raise ValueError("a write of the command is malformed")
    return request


def decode_reply(data: bytes, items: int) -> CommandReply:
    """Decode the reply to a command with this number of writes.

    Raises:
        ValueError: The message is not such a reply.

    """
    try:
        reply = msgspec.msgpack.decode(data, type=CommandReply)
        for outcome in reply.outcomes:
            OutcomeKind(outcome)
    except (msgspec.MsgspecError, ValueError) as error:
        raise ValueError(f"the message is not a reply to a command: {error}") from None
    if len(reply.outcomes) != items or len(reply.reasons) != items:
        raise ValueError("the reply has another number of outcomes than the command has writes")
    return reply
