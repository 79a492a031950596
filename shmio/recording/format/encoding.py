"""Encodes and decodes the messages of a recording (docs/reference/dump-format.md).

Messages are frames, events, gaps, steps and process changes. Decoding checks all fields, and raises
ValueError for malformed bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple, TypeVar

import msgspec
from mcap.records import Channel as ChannelRecord

from shmio.model.values import Provenance, Quality
from shmio.recording.format.records import stream
from shmio.segment.block import Frame
from shmio.segment.events import EVENT_DATA_SIZE, Event, with_sender, without_sender

MAX_JSON_BYTES: Final = 4096
MAX_CHANNELS: Final = 10_000
MAX_CHANNEL_BYTES: Final = 4096

PROFILE: Final = "shmio"
ABOUT: Final = "shmio"
"""Name of the metadata record about the instance."""
SUPERVISED: Final = "supervised"
"""Value of the key ``recorder`` in the record ABOUT if the supervisor has started the recorder."""
PLACES: Final = "places"
"""Name of the metadata record with the position in each block after which the recording begins."""
GAPS_TOPIC: Final = "gaps"
STEPS_TOPIC: Final = "steps"
PROCESSES_TOPIC: Final = "processes"

FRAME: Final = "shmio.frame.v1"
FRAME_V2: Final = "shmio.frame.v2"
"""Like FRAME, but five fields are differences from the message's header. ``_frames.c`` encodes it.

The differences hardly change from frame to frame, so they compress well.
"""
EVENT: Final = "shmio.event.v1"
PLAIN: Final = "json"
GAP: Final = "gap"
STEP: Final = "step"
PROCESS: Final = "process"
"""In this program, GAP, STEP and PROCESS are the encodings of gaps, steps and process changes.

In the file, all three have the encoding PLAIN; only their topics differ.
"""

_FRAME: Final = struct.Struct("<QQqqqQIBBHHHII")
_COUNTED: Final = struct.Struct("<QQQQQ")  # the first fields of a frame: number, cycle, publish, clock, source
_EVENT: Final = struct.Struct("<QQQqqqQQIIIIIIHBBHH")
_MAX_TEXT: Final = 0xFFFF // 3  # an invalid byte becomes a character of three bytes, and the text is encoded again
_QUALITIES: Final = (*Quality, Quality.BAD)  # an unknown quality counts as bad
_PROVENANCES: Final = tuple(Provenance)
_MAX_U64: Final = (1 << 64) - 1
_EFFECTIVE: Final = 1  # flag: an effective image follows the raw one

_OWN: Final = {GAPS_TOPIC: GAP, STEPS_TOPIC: STEP, PROCESSES_TOPIC: PROCESS}

T = TypeVar("T")

FRAME_SCHEMA: Final = b"""Little-endian. u64 number, u64 cycle, i64 publish (ns, CLOCK_MONOTONIC), i64 clock (ns since \
the instance's start), i64 source (ns UTC), u64 event (last one before), u32 incarnation, u8 quality (0 bad, \
1 uncertain, 2 good), u8 provenance (0 live, 1 simulated, 2 replayed, 3 injected), u16 flags (1: effective), \
u16 reason size, u16 0, u32 image size, u32 delay (us; age of the image when published); then reason (UTF-8), raw, \
effective."""
FRAME_V2_SCHEMA: Final = (
    b"As shmio.frame.v1, but for five fields, which are differences modulo 2^64: number - sequence, cycle - number, "
    b"publish - clock, clock - log_time, source - publish_time. " + FRAME_SCHEMA
)
EVENT_SCHEMA: Final = b"""Little-endian. u64 number, u64 frame (last one before), u64 cycle, i64 publish (ns, \
CLOCK_MONOTONIC), i64 clock (ns since the instance's start), i64 UTC (ns), u64 command, u64 injection, \
u32 incarnation, u32 writer, u32 item, u32 items, u32 offset, u32 size, u16 kind, u8 quality, u8 mask, \
u16 data size, u16 text size; then data, text (UTF-8)."""
GAP_SCHEMA: Final = b"""{"type": "object", "properties": {"source": {"type": "string"}, "block": {"type": "integer"}, \
"what": {"enum": ["frames", "events"]}, "first": {"type": "integer"}, "last": {"type": "integer"}, \
"count": {"type": "integer"}, "reason": {"enum": ["overtaken", "not running", "elsewhere", \
"no room", "unsure", "damaged", "left out"]}, \
"after_ns": {"type": "integer"}, "before_ns": {"type": "integer"}}}"""


STEP_SCHEMA: Final = b"""{"type": "object", "properties": {"step": {"type": "integer"}, \
"time_ns": {"type": "integer"}, "dt_ns": {"type": "integer"}}}"""


PROCESS_SCHEMA: Final = b"""{"type": "object", "properties": {"name": {"type": "string"}, \
"kind": {"type": "string"}, "pid": {"type": "integer"}, \
"what": {"enum": ["is", "started", "ended", "died", "gave up", "removed"]}, \
"why": {"type": "string"}, "restarts": {"type": "integer"}}}"""


class Reason(StrEnum):
    """The reason why frames or events are missing."""

    OVERTAKEN = "overtaken"
    """The source overwrote the entries before the recorder read them."""
    NOT_RUNNING = "not running"
    """The entries were overwritten while no recorder ran."""
    ELSEWHERE = "elsewhere"
    """The entries are in the file of the previous recorder, but the folder does not have this file.

    The file was moved, or ``recorder.directory`` has changed.
    """
    NO_ROOM = "no room"
    """The disk was full or too slow, so the recorder's buffer overflowed."""
    UNSURE = "unsure"
    """The entries were written to the previous file, but may be lost, because its fsync failed."""
    DAMAGED = "damaged"
    """The file was made from another recording in which these entries could not be read."""
    LEFT_OUT = "left out"
    """The file was made from the history of a fabric. A rule of the cell's uplink leaves the entries out."""


class Gap(msgspec.Struct, frozen=True):
    """Frames or events of a block, from ``first`` to ``last``, that are missing in the recording.

    ``after_ns`` is the log time of the entry before the gap, and ``before_ns`` is the log time of
    the entry after it. Each is 0 if there is no such entry.
    """

    source: str
    block: int
    what: str
    first: int
    last: int
    count: int
    reason: Reason
    after_ns: int = 0
    before_ns: int = 0


class StepMark(msgspec.Struct, frozen=True):
    """The end of a step of virtual time, recorded after all frames of the step.

    ``time_ns`` is the instance's clock after the step; ``dt_ns`` is the length of the step, in ns.
    """

    step: int
    time_ns: int
    dt_ns: int


class ProcessEvent(StrEnum):
    """The kind of a process change."""

    IS = "is"
    """The process was running when the recording began."""
    STARTED = "started"
    """The process was started or restarted. In a restart, ENDED or DIED was recorded before."""
    ENDED = "ended"
    """The process ended on request, for example to be restarted."""
    DIED = "died"
    """The process ended unexpectedly; the supervisor restarts it."""
    GAVE_UP = "gave up"
    """The process cannot work as configured; the supervisor does not restart it."""
    REMOVED = "removed"
    """A reload has removed the process from the instance."""


class ProcessChange(msgspec.Struct, frozen=True):
    """The start or end of a process, with the reason. ``pid`` is 0 if it is unknown."""

    name: str
    kind: str
    pid: int
    what: ProcessEvent
    why: str
    restarts: int


class BlockPosition(NamedTuple):
    """A position in a block: the last frame and the last event before it, and the log time of the later one."""

    frame: int = 0
    event: int = 0
    log_ns: int = 0


def encode_frame(frame: Frame) -> bytes:
    """Encode a frame with all its fields."""
    reason = frame.reason.encode()
    head = _FRAME.pack(
        frame.number, frame.cycle, frame.publish_ns, frame.clock_ns, frame.source_ns, frame.event, frame.incarnation,
        frame.quality, frame.provenance, 0 if frame.effective is None else _EFFECTIVE, len(reason), 0, len(frame.raw),
        frame.delay_us,
    )  # fmt: skip
    return b"".join((head, reason, frame.raw, frame.effective or b""))


def decode_frame(data: bytes) -> Frame:
    """Decode a frame; raise ValueError if it is malformed."""
    if len(data) < _FRAME.size:
        raise ValueError("a frame is shorter than its header")
    number, cycle, publish_ns, clock_ns, source_ns, event, incarnation, *rest = _FRAME.unpack_from(data)
    quality, provenance, flags, reason_size, _, size, delay_us = rest
    raw_at = _FRAME.size + reason_size
    images = 2 if flags & _EFFECTIVE else 1
    if len(data) != raw_at + images * size or provenance > Provenance.INJECTED or reason_size > _MAX_TEXT:
        raise ValueError("a frame does not match its header")
    return Frame(
        number, cycle, publish_ns, clock_ns, source_ns, incarnation,
        _QUALITIES[min(quality, 3)], _PROVENANCES[provenance], event, delay_us,
        data[_FRAME.size : raw_at].decode("utf-8", "replace"),
        data[raw_at : raw_at + size],
        data[raw_at + size :] if images == 2 else None,
    )  # fmt: skip


def restore(data: bytes, sequence: int, log_ns: int, publish_ns: int) -> bytes:
    """Convert a frame from FRAME_V2 to FRAME.

    If the bytes are too short for a frame, return them unchanged.
    """
    if len(data) < _FRAME.size:
        return data
    number, cycle, publish, clock, source = _COUNTED.unpack_from(data)
    number += sequence
    clock += log_ns
    head = _COUNTED.pack(
        number & _MAX_U64, cycle + number & _MAX_U64, publish + clock & _MAX_U64, clock & _MAX_U64,
        source + publish_ns & _MAX_U64,
    )  # fmt: skip
    return head + data[_COUNTED.size :]


def encode_event(event: Event) -> bytes:
    """Encode an event with all its fields."""
    data, shown = with_sender(event.kind, event.data, event.text, event.by)
    text = shown.encode()
    head = _EVENT.pack(
        event.number, event.frame, event.cycle, event.publish_ns, event.clock_ns, event.utc_ns, event.command,
        event.injection, event.incarnation, event.writer, event.item, event.items, event.offset, event.size,
        event.kind, event.quality, event.mask, len(data), len(text),
    )  # fmt: skip
    return b"".join((head, data, text))


def decode_event(data: bytes) -> Event:
    """Decode an event; raise ValueError if it is malformed."""
    if len(data) < _EVENT.size:
        raise ValueError("an event is shorter than its header")
    number, frame, cycle, publish_ns, clock_ns, utc_ns, command, injection, incarnation, *rest = _EVENT.unpack_from(
        data
    )
    writer, item, items, offset, size, kind, quality, mask, data_size, text_size = rest
    text_at = _EVENT.size + data_size
    if len(data) != text_at + text_size or data_size > EVENT_DATA_SIZE or text_size > _MAX_TEXT:
        raise ValueError("an event does not match its header")
    own, shown, by = without_sender(kind, data[_EVENT.size : text_at], data[text_at:].decode("utf-8", "replace"))
    known = Quality(quality) if quality <= Quality.GOOD else Quality.BAD
    return Event(
        number, kind, frame, cycle, publish_ns, clock_ns, utc_ns, incarnation, known,
        writer, command, item, items, offset, mask, size,
        own, shown, injection, by,
    )  # fmt: skip


def encode_json(item: Gap | StepMark | ProcessChange) -> bytes:
    """Encode a gap, a step or a process change as JSON."""
    return msgspec.json.encode(item)


def _decode_json(data: bytes, kind: type[T], name: str) -> T:
    if len(data) > MAX_JSON_BYTES:
        raise ValueError(f"{name} has {len(data)} bytes, but at most {MAX_JSON_BYTES} are allowed")
    return msgspec.json.decode(data, type=kind)


def decode_gap(data: bytes) -> Gap:
    """Decode a gap; raise ValueError if it is malformed."""
    gap = _decode_json(data, Gap, "a gap")
    if gap.what not in ("frames", "events") or not 0 < gap.first <= gap.last or gap.count != gap.last - gap.first + 1:
        raise ValueError("the numbers of a gap are inconsistent")
    if min(gap.after_ns, gap.before_ns) < 0:
        raise ValueError("a gap has a negative time")
    return gap


def decode_step(data: bytes) -> StepMark:
    """Decode the end of a step; raise ValueError if it is malformed."""
    mark = _decode_json(data, StepMark, "a step")
    if min(mark.step, mark.time_ns, mark.dt_ns) < 0:
        raise ValueError("a step has a negative number, time or length")
    return mark


def decode_process(data: bytes) -> ProcessChange:
    """Decode a process change; raise ValueError if it is malformed."""
    return _decode_json(data, ProcessChange, "a change of a process")


def encode_position(place: BlockPosition) -> str:
    """Encode a position as text."""
    return " ".join(map(str, place))


def decode_position(text: str) -> BlockPosition:
    """Decode a position; raise ValueError if it is malformed."""
    frame, event, log_ns = (int(number) for number in text.split(" ") if len(number) <= 20)
    if min(frame, event, log_ns) < 0:
        raise ValueError("a position has a negative number or time")
    return BlockPosition(frame, event, log_ns)


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel with a block's frames or events, or with gaps, steps or process changes.

    ``layout`` is the hash of the block's layout, including its tag tables, in hexadecimal digits.
    ``encoding`` is FRAME for both versions of frames; it is empty if another program wrote the
    channel's messages.
    """

    number: int
    encoding: str
    topic: str
    source: str = ""
    block: int = 0
    section: int = 0
    after: int = 0
    """Number of the last frame or event before the first frame or event in the channel."""
    layout: str = ""
    period_ns: int = 0
    stale_ns: int = 0
    of: str = ""
    """Hash of the source's whole layout if only some registers were recorded; else empty."""
    differences: bool = False
    """True if frames are encoded as FRAME_V2."""


def decode_channel(content: memoryview) -> Channel:
    """Decode a channel's record.

    Raises:
        ValueError, KeyError, struct.error, McapError: The record is malformed.
    """
    found = ChannelRecord.read(stream(content))
    about = found.metadata
    if found.message_encoding in (FRAME, FRAME_V2, EVENT):
        block, section, after = (int(about[name]) for name in ("block", "section", "after"))
        period_ns, stale_ns = (int(about[name]) for name in ("period_ns", "stale_ns"))
        source, layout = about["source"], about.get("names", about["layout"])
        encoding = EVENT if found.message_encoding == EVENT else FRAME
        return Channel(
            found.id, encoding, found.topic, source, block, section, after, layout, period_ns, stale_ns,
            about.get("of", ""), found.message_encoding == FRAME_V2,
        )  # fmt: skip
    if found.message_encoding == PLAIN and found.topic in _OWN:
        return Channel(found.id, _OWN[found.topic], found.topic)
    return Channel(found.id, "", found.topic)  # a channel of another program
