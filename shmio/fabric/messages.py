"""Messages of the fabric: a source's frames and events, its injections, requests, and commands.

A message has a fixed header and entries, in the order in which the source published them. An entry
has the encoding of a recording (docs/reference/dump-format.md). The list of the source's injections
is a message of its own. The uplink numbers the messages of each source without gaps, so a mirror
knows which ones it has not received.
docs/reference/fabric.md describes the bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import Any, Final, Literal, NamedTuple

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
from shmio.segment.commands import MAX_NAME_BYTES
from shmio.segment.events import Event
from shmio.segment.header import LIST_SIZE
from shmio.segment.injection_list import InjectionEntry

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
_STATE: Final = 4


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
        The entry, and the position after it. The entry is None if it is a state, or if a
        newer version has made it.

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


class SourceState(msgspec.Struct, frozen=True):
    """The injections and the clock of a source. A message of its own has them.

    Attributes:
        injections: The injections, the innermost first. ``cell`` is the cell whose program has created
            an injection, if it is another one than the owner.
        clock_ns: The owner's clock when the message was made, in ns.
        virtual: True if the owner's time is virtual.

    """

    injections: tuple[InjectionEntry, ...]
    clock_ns: int
    virtual: bool


_STATE_NAMES: Final = frozenset({"waiting", "active", "over", "lifted"})
_STATES: Final = msgspec.json.Decoder(SourceState)  # created before there are threads, as in layout/document.py


def encode_state(header: Header, state: SourceState) -> bytearray:
    """Encode a message with the state of a source."""
    content = msgspec.json.encode(state)
    return with_header(header, bytearray(_ENTRY.pack(_STATE, len(content)) + content))


def decode_state(data: bytes) -> SourceState | None:
    """Return the state of a source if the message has one.

    Raises:
        ValueError: The state is malformed, or a number in it is too large.

    """
    start = _HEADER.size + _ENTRY.size
    if len(data) < start or _ENTRY.unpack_from(data, _HEADER.size)[0] != _STATE:
        return None
    try:
        state = _STATES.decode(memoryview(data)[start:])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"the state is malformed: {error}") from None
    if not (-(1 << 63) <= state.clock_ns < 1 << 63 and all(map(_is_sound, state.injections))):
        raise ValueError("the state is malformed: a number or a word in it is none that an injection can have")
    return state


def _is_sound(one: InjectionEntry) -> bool:
    """Return whether the fields of an injection are in their ranges. JSON itself limits no number."""
    running = one.running
    if running is not None and not (
        running.state in _STATE_NAMES
        and min(running.seed, running.runs, running.cycle) >= 0
        and 0 <= running.time_ns < 1 << 63
        and all(bit < 1 << 32 for bit in running.declaration.bits or ())
    ):
        return False
    return (
        0 <= one.writer < 1 << 32
        and 0 <= one.pid < 1 << 31
        and -(1 << 31) <= one.priority < 1 << 31
        and 0 <= one.number < 1 << 64
        and one.direction in ("in", "out")
        and _fits(msgspec.to_builtins(one))
    )


def _fits(value: Any) -> bool:
    """Return whether all integers in a value have at most 64 bits."""
    if isinstance(value, int):
        return -(1 << 63) <= value < 1 << 64
    if isinstance(value, dict):
        return all(map(_fits, value.values()))
    return not isinstance(value, list | tuple) or all(map(_fits, value))


class MissingRequest(msgspec.Struct, frozen=True):
    """A request for the messages of a stream from ``first`` to ``last``.

    The uplink sends each of them to the request's reply subject, in order, with its age, and then an
    empty message. It leaves out the messages that it no longer has.
    """

    stream: int
    first: int
    last: int


STATE_REQUEST: Final = MissingRequest(0, 0, 0)
"""Request for the state of a source: the uplink publishes it for all. No messages have these numbers."""


def asks_for_state(data: bytes) -> bool:
    """Return whether a request is :data:`STATE_REQUEST`."""
    try:
        return msgspec.json.decode(data, type=MissingRequest) == STATE_REQUEST
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False


MAX_ITEMS: Final = 4096
"""Maximum number of writes of a command."""
MAX_RENEWED: Final = 256
"""Maximum number of injections that a command renews."""
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


InjectionKind = Literal["inject", "shadow", "lift", "declare", "renew"]
"""The kinds of commands about injections; the first four are as in :class:`shmio.segment.commands.CommandKind`."""


class InjectionRequest(msgspec.Struct, frozen=True, omit_defaults=True):
    """The part of a command that is about injections of a source.

    Attributes:
        kind: What to do. ``renew``: the programs that have created injections still run.
        number: Number that the sender gave the command. The owner's events about the command have it,
            and so has an injection that the command creates. 0 with ``renew``.
        injection: With ``lift`` and ``shadow``: number of the injection.
        direction: With ``inject``: 0 for ``/out``, 1 for ``/in``.
        priority: With ``inject``: the priority.
        keep: With ``inject`` and ``declare``: the injection stays, also if it is not renewed.
        name: With ``inject``: the name.
        items: With ``inject``: the bits to cover; with ``shadow``: the values.
        declaration: With ``declare``: the declaration as JSON. Names and times are the owner's.
        renewed: With ``renew``: numbers of the injections.

    """

    kind: InjectionKind
    number: int = 0
    injection: int = 0
    direction: int = 0
    priority: int = 0
    keep: bool = False
    name: str = ""
    items: list[WriteItem] = []
    declaration: bytes = b""
    renewed: list[int] = []


class CommandRequest(msgspec.Struct, frozen=True, omit_defaults=True):
    """A command of another cell to a source: writes, of which the source carries out all or none, or an injection.

    Attributes:
        expires_ns: Time on the owner's clock, as ``made_ns`` of a message, after which the source
            must not begin. The outcome of a command that comes later is expired.
        stream: Number of the uplink's numbering, from its messages. A command that was made for an
            earlier uplink is expired: it may have been stuck on its way since.
        layout: First 8 bytes of the hash of the layout that the offsets belong to. The owner
            rejects a command for another layout.
        writes: The writes; none if the command is about injections.
        injection: What to do with injections; None if the command writes.

    """

    expires_ns: int
    stream: int
    layout: bytes
    writes: list[WriteItem] = []
    injection: InjectionRequest | None = None

    @property
    def outcomes(self) -> int:
        """Number of outcomes in the reply: one for each write or shadowed value, otherwise one."""
        if self.injection is None:
            return len(self.writes)
        return len(self.injection.items) if self.injection.kind == "shadow" else 1


class CommandReply(msgspec.Struct, frozen=True):
    """The outcomes of a command: one for each write, in their order; one for a command about an injection.

    Attributes:
        outcomes: The outcomes, each a value of :class:`shmio.model.values.OutcomeKind`, or ``injected`` or
            ``lifted``.
        reasons: For each outcome, its reason; empty for a success.

    """

    outcomes: list[str]
    reasons: list[str]


_OUTCOMES: Final = frozenset({*map(str, OutcomeKind), "injected", "lifted"})


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
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(f"the message is not a command: {error}") from None
    injection = request.injection
    if injection is not None and not request.writes:
        _check_injection(injection)
        items = injection.items
    elif injection is None and 0 < len(request.writes) <= MAX_ITEMS:
        items = request.writes
    else:
        raise ValueError(f"a command has 1 to {MAX_ITEMS} writes or an injection, not {len(request.writes)} writes")
    for item in items:
        bit = len(item.data) == 1 and 0 < item.mask < 256 and item.mask & (item.mask - 1) == 0
        if item.offset < 0 or not item.data or (item.mask and not bit):
            raise ValueError("a write of the command is malformed")
    return request


def outcomes_of(data: bytes) -> int:
    """Return the number of outcomes in the reply to a message that cannot be decoded as a command.

    For example, a newer version of shmio may have sent it. If it has no items that can be counted, there is one.
    """
    try:
        found = msgspec.msgpack.decode(data)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return 1
    if not isinstance(found, dict):
        return 1
    injection = found.get("injection")
    if isinstance(injection, dict):
        items = injection.get("items") if injection.get("kind") == "shadow" else [None]
    else:
        items = found.get("writes")
    return len(items) if isinstance(items, list) and 0 < len(items) <= MAX_ITEMS else 1


def _check_injection(injection: InjectionRequest) -> None:
    """Raise ValueError if a request about an injection is malformed."""
    kind = injection.kind
    numbers = (injection.number, injection.injection, *injection.renewed)
    sound = (
        all(0 <= number < 1 << 64 for number in numbers)
        and (kind == "renew" or injection.number > 0)
        and (kind not in ("lift", "shadow") or injection.injection > 0)
        and (0 < len(injection.items) <= MAX_ITEMS if kind in ("inject", "shadow") else not injection.items)
        and injection.direction in (0, 1)
        and -(1 << 31) <= injection.priority < 1 << 31
        and len(injection.name.encode("utf-8", "surrogatepass")) <= MAX_NAME_BYTES
        and (0 < len(injection.declaration) <= LIST_SIZE if kind == "declare" else not injection.declaration)
        and len(injection.renewed) <= MAX_RENEWED
    )
    if not sound:
        raise ValueError(f"the {kind} request of the command is malformed")


def decode_reply(data: bytes, items: int) -> CommandReply:
    """Decode the reply to a command with this number of outcomes.

    Raises:
        ValueError: The message is not such a reply.

    """
    try:
        reply = msgspec.msgpack.decode(data, type=CommandReply)
    except msgspec.MsgspecError as error:
        raise ValueError(f"the message is not a reply to a command: {error}") from None
    if not _OUTCOMES.issuperset(reply.outcomes):
        raise ValueError("the message is not a reply to a command: an outcome is unknown")
    if len(reply.outcomes) != items or len(reply.reasons) != items:
        raise ValueError("the reply has another number of outcomes than the command has writes")
    return reply
