"""Events of a block: commands and their outcomes, injections, changes of quality, starts and ends.

An event ring works like a frame ring, and the same process writes both. Each event has the number of
the last frame before it, and each frame has the number of the last event before it. So the order of
frames and events is known.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

from shmio.model.values import NO_WRITER, Quality
from shmio.segment._atomics import REASON_SIZE
from shmio.segment.header import cut
from shmio.wording import printable

if TYPE_CHECKING:
    from shmio.segment._atomics import FrameTuple

EVENT_DATA_SIZE: Final = 256
"""Maximum number of data bytes in an event; a longer write becomes several consecutive events."""
EVENT_SLOTS: Final = 2048
MAX_BY_BYTES: Final = 120
"""Maximum number of bytes of the text that says who sent a command."""

_RECORD: Final = struct.Struct("<HHIQIIBxHIQ")
EVENT_SIZE: Final = _RECORD.size + EVENT_DATA_SIZE


class EventKind(IntEnum):
    """Kind of an event. For each item with an ACCEPTED event, an event of :data:`ENDS` follows."""

    STARTED = 1
    STOPPED = 2
    QUALITY = 3
    ACCEPTED = 4
    REJECTED = 5
    """The source rejected the whole command, and carried out no part of it."""
    WRITTEN = 6
    """The device confirmed the write."""
    REFUSED = 7
    """The device refused the write."""
    EXPIRED = 8
    """The source has not sent the write to the device, and never will."""
    UNKNOWN = 9
    """The source sent the write to the device, but no answer came."""
    DIVERTED = 10
    """An injection took these values, which came from a writer or from an inner injection."""
    TAKEN = 11
    """Injections took the whole item, so the device gets nothing."""
    INJECTED = 12
    """The source created an injection, which has the number of the command that requested it.

    The event ends that command. Its data are a part of a JSON document. For a declared injection,
    the document is the declaration with the seed in use. For other injections, it has the keys
    ``direction``, ``priority``, ``keep`` and ``ranges``; each range is (offset, size, bits).
    """
    LIFTED = 13
    """An injection ended; the text is the reason.

    If a command lifted it, the event ends the command.
    """
    SHADOWED = 14
    """A client gave these values to an injection. The last frame before the event is the first with the values."""
    ACTIVATED = 15
    """A declared injection became active.

    If the injection covers ``/out``, the last frame before the event is the first that it changes.
    ``item`` is the number of activations so far.
    """
    DEACTIVATED = 16
    """A declared injection is no longer active."""
    NOTED = 17
    """A client added a note, which is the event's text. The event ends the client's command."""
    SAVED = 18
    """The state of the source was saved in a snapshot, whose name is the event's text."""
    RESTORED = 19
    """The state of the source was restored from a snapshot, whose name is the event's text.

    Time may have gone back. The next frame shows the restored state.
    """

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
"""Kinds of events that give the outcome of an item; REJECTED gives the outcome of a whole command."""
DONE: Final = frozenset({EventKind.WRITTEN, EventKind.TAKEN, EventKind.SHADOWED})
"""Those kinds in :data:`ENDS` that are successes: the device, consumers or an injection got the value."""
_WITH_DATA: Final = frozenset({EventKind.ACCEPTED, EventKind.DIVERTED, EventKind.INJECTED, EventKind.SHADOWED})
_WITHOUT_DATA: Final = ENDS - _WITH_DATA
_SEPARATOR: Final = "\x1f"


class Event(NamedTuple):
    """A copy of an event.

    Attributes:
        number: Number of the event.
        kind: The :class:`EventKind`; a plain number if this version of shmio does not know the
            kind.
        frame: Number of the last frame before the event.
        cycle: Cycle of the source's schedule.
        publish_ns: CLOCK_MONOTONIC at publication in ns; in virtual time, its equivalent on the
            virtual clock.
        clock_ns: The instance's clock at publication, in ns.
        utc_ns: UTC at publication, in ns.
        incarnation: Number of times that the source's process has been started, including the
            present start.
        quality: Quality after the event.
        writer: Number of the queue from which the command came; NO_WRITER: the event is not about
            a command from a queue.
        command: Number that the writer gave the command; 0: none.
        item: Index of the first item of the command that the event is about.
        items: Number of the command's items that the event is about.
        offset: Offset of the first item's write in the image, in bytes.
        mask: Mask of the first item's write; 0: whole bytes.
        size: Size of the first item's write in bytes.
        data: The written bytes, with ACCEPTED, DIVERTED, SHADOWED and INJECTED only.
        text: A reason, the note, or the name of the injection, depending on the kind.
        injection: Number of the injection that the event is about; 0: none.
        by: Who sent the command, such as ``web: anonymous (127.0.0.1)``; empty if no command caused
            the event, or if its sender has not said it.
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
    by: str = ""

    @property
    def command_key(self) -> tuple[int, int, int]:
        """Key that identifies the event's command within its block: incarnation, writer and number."""
        return self.incarnation, self.writer, self.command


class Record(NamedTuple):
    """The content of an event that a source is about to publish; see :class:`Event`."""

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
    by: str = ""

    def pack(self) -> tuple[bytes, bytes]:
        """Encode the record as the payload of an event, EVENT_SIZE bytes, and the event's text."""
        data, text = with_sender(self.kind, self.data, self.text, self.by)
        what = (self.kind, len(data), self.writer, self.command)
        packed = _RECORD.pack(*what, self.item, self.offset, self.mask, self.items, self.size, self.injection)
        return packed + data.ljust(EVENT_DATA_SIZE, b"\0"), cut(text, REASON_SIZE)


def sender_text(by: str) -> str:
    """Return the text that says who sent a command, as events have it: one line, at most MAX_BY_BYTES in UTF-8."""
    return cut(printable(by), MAX_BY_BYTES).decode()


def with_sender(kind: int, data: bytes, text: str, by: str) -> tuple[bytes, str]:
    """Return an event's data and text, with the sender of the command put into one of them.

    Readers of earlier versions ignore the data of most kinds. Kinds with data of their own have the sender
    in the text, as far as it fits.
    """
    if kind in _WITHOUT_DATA:
        return (sender_text(by).encode() or data), text
    if kind in _WITH_DATA and (by or _SEPARATOR in text):  # always, so that no name looks like a sender
        text = cut(text, REASON_SIZE - 1).decode()
        room = max(0, REASON_SIZE - 1 - len(text.encode()))
        return data, f"{text}{_SEPARATOR}{cut(sender_text(by), room).decode()}"
    return data, text


def without_sender(kind: int, data: bytes, text: str) -> tuple[bytes, str, str]:
    """Return what :func:`with_sender` has put together: an event's data, its text, and the sender."""
    if kind in _WITHOUT_DATA:
        return b"", text, sender_text(data.decode("utf-8", "replace"))
    if kind in _WITH_DATA and _SEPARATOR in text:
        text, _, by = text.rpartition(_SEPARATOR)
        return data, text, sender_text(by)
    return data, text, ""


def decode_event(fields: FrameTuple) -> Event:
    """Decode an event, and check the bounds of its fields, because another process wrote the bytes."""
    number, cycle, publish_ns, clock_ns, utc_ns, incarnation, quality, _, frame, _, text, raw, _ = fields
    kind, data_size, writer, command, item, offset, mask, items, size, injection = _RECORD.unpack_from(raw)
    data = raw[_RECORD.size : _RECORD.size + min(data_size, EVENT_DATA_SIZE)]
    data, text, by = without_sender(kind, data, text)
    known = Quality(quality) if quality <= Quality.GOOD else Quality.BAD
    return Event(
        number, kind, frame, cycle, publish_ns, clock_ns, utc_ns, incarnation, known,
        writer, command, item, items, offset, mask, size, data, text, injection, by,
    )  # fmt: skip
