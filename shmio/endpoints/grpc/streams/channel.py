"""Subjects to listen to, and the channels of a block: each is a subject with its listeners."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sized
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from shmio.layout.model import Register
from shmio.segment.changed_registers import ChangeScan, entries


class BlockImage(Protocol):
    """An image of a block with its number and time: a frame, or a future one."""

    @property
    def number(self) -> int:
        """Number of the frame, or of the step."""

    @property
    def clock_ns(self) -> int:
        """Time of the instance's clock, in ns."""

    @property
    def image(self) -> bytes:
        """The block's bytes as consumers see them."""


class SourceImage(BlockImage, Protocol):
    """An image together with the bytes that the source delivered."""

    @property
    def raw(self) -> bytes:
        """The block's bytes as the source delivered them, without injections."""


Encode = Callable[[BlockImage], Sized | None]
"""Encodes an image as a message, whose ``len`` is in bytes; None: the bytes hold no value."""


@dataclass(frozen=True, slots=True)
class Subject:
    """A register, an array's element or a structure in the encoding of one service.

    Equal subjects are encoded once for all listeners.

    Attributes:
        wire: Name of the encoding.
        path: Canonical path in the block.
        registers: The registers it shows.
        encode: Makes a message of an image.
        changed: Returns whether two images differ in the subject; None: compare the registers
            as consumers see them.

    """

    wire: str
    path: str
    registers: tuple[Register, ...] = field(compare=False)
    encode: Encode = field(compare=False)
    changed: Callable[[SourceImage, SourceImage], bool] | None = field(default=None, compare=False)


class Stream(Protocol):
    """A client's stream, as back-pressure sees it."""

    refills: dict[Callable[[], object], None]
    """Functions that are called once, as soon as the stream has nothing to send."""

    @property
    def busy(self) -> bool:
        """Whether messages wait, or the client is still taking the last one."""

    @property
    def behind(self) -> bool:
        """Whether the client loses so many values that it is far behind."""

    def skip(self, frames: int, topics: int) -> None:
        """Count frames that were not delivered to ``topics`` topics of a slow client."""


class Listener(Protocol):
    """A stream's subscription to one subject; called in the event loop's thread."""

    @property
    def stream(self) -> Stream:
        """The stream that this listener belongs to."""

    since: int
    """Number of the frame whose value the stream already has."""

    def deliver(self, message: Sized, at_s: float | None = None) -> None:
        """Take one message. ``at_s``: its time by the topic's clock, in s; default: now."""

    def keep(self, message: Sized) -> None:
        """Queue a message of a step; such a message must not be dropped."""

    def lose(self) -> None:
        """Drop the messages that were not sent yet, because quality has turned bad."""


class Channel:
    """A subject that has listeners: how a frame becomes a message, and who gets it."""

    def __init__(self, subject: Subject, slot: int) -> None:
        """``slot``: the channel's index in the feed's table."""
        self.encode = subject.encode
        self.listeners: dict[Listener, None] = {}  # in the order in which they came
        self.slot = slot
        first = subject.registers[0]
        self.order = first.offset, first.bit or 0, subject.path, subject.wire
        """Sort key: the channels that a step has changed are delivered in the block's order."""
        self.changed = subject.changed
        self.entries = b"" if self.changed else entries(subject.registers, slot)


class ChannelTable(NamedTuple):
    """All channels of a block, and the change scan over them."""

    slots: tuple[Channel | None, ...]
    scan: ChangeScan
    apart: tuple[Channel, ...]
    """Channels that decide by a function of their own whether they have changed."""

    @classmethod
    def of(cls, channels: Collection[Channel], slots: int) -> ChannelTable:
        """Build the table of these channels. ``slots``: its length; some slots may be free."""
        places: list[Channel | None] = [None] * slots
        for channel in channels:
            places[channel.slot] = channel
        apart = tuple(channel for channel in channels if channel.changed)
        return cls(tuple(places), ChangeScan.joined(channel.entries for channel in channels), apart)
