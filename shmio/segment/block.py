"""The block of a source: its layout and its rings of frames, events and commands."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from shmio.errors import SegmentError
from shmio.model.values import Provenance, Quality
from shmio.segment._atomics import REASON_SIZE, Ring
from shmio.segment.cursor import Cursor
from shmio.segment.events import EventKind, EventRing, Record
from shmio.segment.frame import Frame
from shmio.segment.header import cut

if TYPE_CHECKING:
    from shmio.layout.model import Layout
    from shmio.segment._atomics import FrameTuple
    from shmio.segment.clock import ClockPage
    from shmio.segment.commands import CommandQueues
    from shmio.segment.model_channel import ModelChannel
    from shmio.segment.playhead import Playhead
    from shmio.segment.standing_injections import DeclaredCell, StandingCell

Bytes = bytes | bytearray | memoryview


MAX_DELAY_US = 2**32 - 1

_QUALITIES = tuple(Quality)
_PROVENANCES = tuple(Provenance)


def decode_frame(fields: FrameTuple) -> Frame:
    """Make a frame of what the ring returns."""
    number, cycle, publish_ns, clock_ns, source_ns, incarnation, quality, provenance = fields[:8]
    event, delay_us, reason, raw, effective = fields[8:]
    return Frame(
        number,
        cycle,
        publish_ns,
        clock_ns,
        source_ns,
        incarnation,
        # The bytes come from another process: an unknown quality counts as bad.
        _QUALITIES[quality] if quality < len(_QUALITIES) else Quality.BAD,
        _PROVENANCES[provenance] if provenance < len(_PROVENANCES) else Provenance.SIMULATED,
        event,
        delay_us,
        reason,
        raw,
        effective,
    )


@dataclass(frozen=True, slots=True)
class Attributes:
    """The part of a source's configuration that other processes need."""

    connector: str = ""
    writable: tuple[str, ...] = ()
    """Patterns of the registers that may be written."""
    armed: bool = False
    """Whether an injection may reach the device."""
    stepped: bool = False
    """Whether the source uses the instance clock: in virtual time it publishes a frame for each step."""
    outputs: tuple[str, ...] = ()
    """Patterns of the registers that a remote model computes."""
    inouts: tuple[str, ...] = ()
    """Patterns of the registers that a remote model both reads and computes."""
    replay: bool = False
    """Whether the source replays a recording."""

    @property
    def remote(self) -> bool:
        """Whether a remote model computes registers of the source."""
        return bool(self.outputs or self.inouts)


class Stamp(NamedTuple):
    """Times of a publication: comparable to CLOCK_MONOTONIC, by the instance's clock, and, for an event, in UTC."""

    publish_ns: int
    clock_ns: int
    utc_ns: int = 0


class Block:
    """Reading side of a block. Reading leaves the writer undisturbed.

    Several threads may use a block; a :class:`Cursor` belongs to one thread.
    """

    def __init__(
        self,
        source: str,
        layout: Layout,
        ring: Ring,
        events: Ring,
        commands: CommandQueues,
        standing: StandingCell,
        declared: DeclaredCell,
        attributes: Attributes,
        retired: Callable[[], bool],
        section: int,
        clock: ClockPage,
        model_channel: ModelChannel | None = None,
        playhead: Playhead | None = None,
    ) -> None:
        self.source = source
        self.section = section
        """Index of the layout's section; unique among the blocks of one run of the instance."""
        self.layout = layout
        self.ring = ring
        self.events = EventRing(events, retired)
        self.commands = commands
        self.standing = standing
        """The present injections of the source."""
        self.declared = declared
        """The injections that the configuration declares for the source."""
        self.attributes = attributes
        self.clock = clock
        self.model_channel = model_channel
        """The channel to a remote model; None if no remote model computes the block."""
        self.playhead = playhead
        """The playhead of the replayed recording; None if the block replays none."""
        self._retired = retired

    @property
    def retired(self) -> bool:
        """Whether a reload has retired this block: nothing more is written to it."""
        return self._retired()

    @property
    def incarnation(self) -> int:
        """Number of the process that writes here, counted from 1; a command names the one it is for."""
        return self.ring.incarnation

    @property
    def period_ns(self) -> int:
        """Time between two cycles, in ns."""
        return self.ring.period_ns

    @property
    def stale_ns(self) -> int:
        """Age above which a frame is bad, in ns."""
        return self.ring.stale_ns

    def now_ns(self) -> int:
        """Return the present time by which frames age: that of the playhead, the instance clock or CLOCK_MONOTONIC."""
        if self.playhead is not None:
            return self.playhead.now_ns()
        return self.clock.now_ns() if self.attributes.stepped else time.monotonic_ns()

    def assess(self, frame: Frame) -> tuple[Quality, str]:
        """Return a frame's quality as of now, and the reason if it is not good."""
        return frame.assess(self.stale_ns, self.now_ns())

    def came_with(self, frame: Frame, step: int) -> bool:
        """Whether a frame was published for the present step of virtual time, or a later one.

        Always False for a block that does not use the instance clock.
        """
        if self.playhead is not None:
            return self.playhead.came_now(frame.number)
        return self.attributes.stepped and frame.cycle >= step

    def latest(self) -> Frame | None:
        """Return a copy of the newest frame; None if the source has not published one yet.

        Raises:
            SegmentError: The writer overtook the reader at every attempt to copy.
        """
        fields = self.ring.latest()
        if fields is not None:
            return decode_frame(fields)
        if self.ring.head() == 0:
            return None
        raise SegmentError(
            f"source {self.source}: its ring is overwritten faster than a frame can be read; raise instance.ring_mb"
        )

    def read(self, number: int) -> Frame | None:
        """Return a copy of the frame with this number; None if the ring does not hold it."""
        fields = self.ring.read(number)
        return None if fields is None else decode_frame(fields)

    def cursor(self, *, after: int | None = None) -> Cursor[Frame]:
        """Return a cursor that starts behind frame ``after`` (default: the newest one)."""
        return Cursor(self.ring, decode_frame, self.ring.head() if after is None else after, self._retired)


class BlockWriter:
    """Writing side of a block. There is one, in the source's process; several threads may use it."""

    def __init__(self, block: Block, clock_ns: Callable[[int], int], at: Stamp | None = None) -> None:
        """Begin a new incarnation, and publish its start.

        Args:
            block: The block to write.
            clock_ns: Converts CLOCK_MONOTONIC to the instance's clock.
            at: Times of the start event; None: now.
        """
        self.block = block
        self._clock_ns = clock_ns
        self._turn = threading.Lock()  # so that frames and events are in one order
        self.cycle = 0
        """The present cycle, used to stamp events."""
        self.at_ns: int | None = None
        """Publish time in virtual time, comparable to CLOCK_MONOTONIC; None: now."""
        self.utc_ns: Callable[[int], int] | None = None
        """Converts :attr:`at_ns` to UTC, which is then used for events."""
        self._quality = Quality.BAD
        self.incarnation = block.ring.begin()
        block.events.ring.begin(self.incarnation)
        self.event(Record(EventKind.STARTED, f"pid {os.getpid()}"), at=at)

    def now_ns(self) -> int:
        """Return the publish time that a frame would get now."""
        return self.block.now_ns() if self.at_ns is None else self.at_ns

    def publish(
        self,
        raw: Bytes,
        *,
        cycle: int,
        source_ns: int | None = None,
        quality: Quality = Quality.GOOD,
        provenance: Provenance = Provenance.LIVE,
        reason: str = "",
        effective: Bytes | None = None,
        asked_ns: int | None = None,
        at: Stamp | None = None,
    ) -> int:
        """Publish a frame, and wake its readers.

        Args:
            raw: The image that the source delivers, ``layout.size`` bytes.
            cycle: Cycle of the source's schedule.
            source_ns: The source's time stamp, UTC; None: now; 0: there is no image yet.
            quality: Quality of the image.
            provenance: Where the image comes from.
            reason: Why the quality is not good; cut at 256 bytes.
            effective: The image that consumers see; None: ``raw``.
            asked_ns: When the device was asked for the image, as :meth:`now_ns`; None: now.
            at: Times of the publication; None: now.

        Returns:
            The frame's number.
        """
        with self._turn:
            now_ns, clock_ns, _ = at or self._present()
            self._quality = quality
            return self.block.ring.publish(
                raw,
                effective,
                cycle,
                now_ns,
                clock_ns,
                time.time_ns() if source_ns is None else source_ns,
                quality,
                provenance,
                self.block.events.head(),
                0 if asked_ns is None else min(-(-max(0, now_ns - asked_ns) // 1000), MAX_DELAY_US),
                cut(reason, REASON_SIZE) if reason else b"",
            )

    def _present(self) -> Stamp:
        now_ns = self.now_ns()
        if self.at_ns is None or self.utc_ns is None:
            return Stamp(now_ns, self._clock_ns(now_ns))
        return Stamp(now_ns, self._clock_ns(now_ns), self.utc_ns(now_ns))

    def event(self, record: Record, *, quality: Quality | None = None, at: Stamp | None = None) -> int:
        """Publish an event, and wake the readers of frames and events.

        Args:
            record: The content of the event.
            quality: The new quality, for a QUALITY event; None: that of the last frame.
            at: Times of the publication; None: now.

        Returns:
            The event's number.
        """
        with self._turn:
            now_ns, clock_ns, utc_ns = at or self._present()
            number = self.block.events.ring.publish(
                record.pack(),
                None,
                self.cycle,
                now_ns,
                clock_ns,
                utc_ns or time.time_ns(),
                self._quality if quality is None else quality,
                Provenance.LIVE,
                self.block.ring.head(),
                0,
                cut(record.text, REASON_SIZE),
            )
            self.block.ring.wake()
            return number
