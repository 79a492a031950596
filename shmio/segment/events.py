"""What happened to a block between frames: commands and their outcomes, injections, changes of quality, starts, ends.

An event ring works like a frame ring and is written by the same process. An event names the frame it follows, a frame
the event it follows, so that both together are one order.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

from shmio.segment.cursor import Cursor
from shmio.segment.frame import Quality

if TYPE_CHECKING:
    from collections.abc import Callable

    from shmio.segment._atomics import FrameTuple, Ring

EVENT_DATA_SIZE: Final = 256
"""Most data bytes in one event; a longer write is several events with consecutive parts."""
EVENT_SLOTS: Final = 2048
NO_WRITER: Final = 0xFFFFFFFF

_RECORD: Final = struct.Struct("<HHIQIIBxHIQ")
EVENT_SIZE: Final = _RECORD.size + EVENT_DATA_SIZE


class EventKind(IntEnum):
    """What happened. A command's item is accepted or rejected; if accepted, one of the :data:`ENDS` follows."""

    STARTED = 1
    STOPPED = 2
    QUALITY = 3
    ACCEPTED = 4
    REJECTED = 5
    """By the source, before anything was done; of a command as a whole."""
    WRITTEN = 6
    """The device confirmed it."""
    REFUSED = 7
    """The device said no."""
    EXPIRED = 8
    """Not sent, and will not be."""
    UNKNOWN = 9
    """Sent, but no answer came."""
    DIVERTED = 10
    """What was written, or given by an injection beneath it, went to an injection: these bits, with data."""
    TAKEN = 11
    """The end of an item of which nothing was left for the device: an injection took it."""
    INJECTED = 12
    """An injection was laid; the end of the command that asked for it, whose number is its own.

    Its data, JSON in parts, say how: of one that was declared its declaration, with the seed that it runs with; of a
    client's ``direction``, ``priority``, ``keep`` and ``ranges``: (offset, size, bits).
    """
    LIFTED = 13
    """An injection was lifted, with the reason; the end of the command that asked for it, if one did."""
    SHADOWED = 14
    """An injection gave values, with data, that consumers see since the frame before."""
    ACTIVATED = 15
    """A declared injection became active: over ``/out`` in the frame before; ``item`` counts its activations."""
    DEACTIVATED = 16
    """It is no longer."""
    NOTED = 17
    """Somebody has noted something, as text; the end of the command that brought it."""

    def __str__(self) -> str:
        return self.name.lower()


ENDS: Final = frozenset(
    {
        EventKind.REJECTED,
        EventKind.WRITTEN,
        EventKind.REFUSED,
        EventKind.EXPIRED,
        EventKind.UNKNOWN,
        EventKind.TAKEN,
        EventKind.INJECTED,
        EventKind.LIFTED,
        EventKind.SHADOWED,
        EventKind.NOTED,
    }
)
"""Kinds after which nothing more is said of an item; REJECTED: of a command."""
DONE: Final = frozenset({EventKind.WRITTEN, EventKind.TAKEN, EventKind.SHADOWED})
"""Ends with which a value has gone where it was meant to, or to the injection on its way."""


class Event(NamedTuple):
    """A copy of one event. Times in ns as in a frame: CLOCK_MONOTONIC, the instance's clock, UTC.

    ``frame``: number of the last frame before it. ``kind`` is a plain number where this version does not know it.
    ``writer``: the command ring it is about, or NO_WRITER; ``command``: the writer's number of the command. It tells
    of ``items`` of its items from ``item`` on; ``offset``, ``mask``, ``size``: what the first of them writes (mask 0:
    whole bytes); ``data``: these bytes, with ACCEPTED, DIVERTED, SHADOWED and INJECTED only. ``text``: the reason, the
    note, or the name of ``injection``, the one it is about (0: none).
    """

    number: int
    kind: int
    frame: int
    cycle: int
    publish_ns: int
    clock_ns: int
    utc_ns: int
    incarnation: int
    quality: Quality
    writer: int
    command: int
    item: int
    items: int
    offset: int
    mask: int
    size: int
    data: bytes
    text: str
    injection: int = 0


class Record(NamedTuple):
    """The part of an event that its writer chooses."""

    kind: EventKind
    text: str = ""
    writer: int = NO_WRITER
    command: int = 0
    item: int = 0
    items: int = 0
    offset: int = 0
    mask: int = 0
    size: int = 0
    data: bytes = b""
    injection: int = 0

    def pack(self) -> bytes:
        """The payload, EVENT_SIZE bytes."""
        what = (self.kind, len(self.data), self.writer, self.command)
        packed = _RECORD.pack(*what, self.item, self.offset, self.mask, self.items, self.size, self.injection)
        return packed + self.data.ljust(EVENT_DATA_SIZE, b"\0")


def decode(fields: FrameTuple) -> Event:
    """An event from a ring's copy; bounds are checked, for the bytes are another process's."""
    number, cycle, publish_ns, clock_ns, utc_ns, incarnation, quality, _, frame, _, text, raw, _ = fields
    kind, data_size, writer, command, item, offset, mask, items, size, injection = _RECORD.unpack_from(raw)
    data = raw[_RECORD.size : _RECORD.size + min(data_size, EVENT_DATA_SIZE)]
    known = Quality(quality) if quality <= Quality.GOOD else Quality.BAD
    return Event(
        number, kind, frame, cycle, publish_ns, clock_ns, utc_ns, incarnation, known,
        writer, command, item, items, offset, mask, size, data, text, injection,
    )  # fmt: skip


class EventRing:
    """Reading side of a block's events."""

    def __init__(self, ring: Ring, retired: Callable[[], bool]) -> None:
        self.ring = ring
        self._retired = retired

    def head(self) -> int:
        """Number of the newest event; 0: none yet."""
        return self.ring.head()

    def read(self, number: int) -> Event | None:
        """A copy of one event by its number; None when the ring does not hold it."""
        fields = self.ring.read(number)
        return None if fields is None else decode(fields)

    def cursor(self, *, after: int | None = None) -> Cursor[Event]:
        """A stream position behind event ``after`` (default: the newest one)."""
        return Cursor(self.ring, decode, self.head() if after is None else after, self._retired)
