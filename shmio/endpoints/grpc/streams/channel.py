"""Who listens to what comes out of a block: a subject, and the streams that want it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sized
from typing import NamedTuple, Protocol

from shmio.endpoints.grpc.streams.subject import Subject
from shmio.segment.changed_registers import ChangeScan, entries


class Stream(Protocol):
    """What goes to one client."""

    refills: dict[Callable[[], object], None]
    """Called, once, as soon as it has nothing to send."""

    @property
    def busy(self) -> bool:
        """Whether its client takes what there was for it."""

    @property
    def behind(self) -> bool:
        """Whether that is far less than there could be."""

    def skip(self, frames: int, topics: int) -> None:
        """So many frames of so many topics were not delivered to it, which is too slow for them."""


class Listener(Protocol):
    """A stream's part in one subject; called in the event loop's thread."""

    @property
    def stream(self) -> Stream:
        """The whole of it."""

    since: int
    """Frame whose value the stream already has."""

    def deliver(self, message: Sized, at_s: float | None = None) -> None:
        """Take one message for this stream. ``at_s``: of when it is, by the clock of its topic; default: now."""

    def keep(self, message: Sized) -> None:
        """Take one message of a step: it must not be left out."""

    def lose(self) -> None:
        """Quality is bad: what was not sent yet must not be sent any more."""


class Channel:
    """A subject as somebody listens to it: how a frame becomes a message, and who gets it."""

    def __init__(self, subject: Subject, slot: int) -> None:
        """``slot``: its place in the feed's table."""
        self.encode = subject.encode
        self.listeners: dict[Listener, None] = {}  # in the order in which they came
        self.slot = slot
        first = subject.registers[0]
        self.order = first.offset, first.bit or 0, subject.path, subject.wire
        """Of those that a step has changed, whoever came first."""
        self.changed = subject.changed
        self.entries = b"" if self.changed else entries(subject.registers, slot)


class ChannelTable(NamedTuple):
    """The channels of a block."""

    slots: tuple[Channel | None, ...]
    scan: ChangeScan
    apart: tuple[Channel, ...]
    """Those that the scan does not look at."""

    @classmethod
    def of(cls, channels: Collection[Channel], slots: int) -> ChannelTable:
        """That of these; ``slots``: of places, of which some may be free."""
        places: list[Channel | None] = [None] * slots
        for channel in channels:
            places[channel.slot] = channel
        apart = tuple(channel for channel in channels if channel.changed)
        return cls(tuple(places), ChangeScan.joined(channel.entries for channel in channels), apart)
