"""A source's block: its layout, its rings of frames, events and commands; for readers and for its one writer."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from shmio.errors import SegmentError
from shmio.segment._atomics import REASON_SIZE, Ring
from shmio.segment.cursor import Cursor
from shmio.segment.events import EventKind, EventRing, Record
from shmio.segment.frame import Frame, Provenance, Quality
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


def _frame(fields: FrameTuple) -> Frame:
    number, cycle, publish_ns, clock_ns, source_ns, incarnation, quality, provenance = fields[:8]
    event, delay_us, reason, raw, effective = fields[8:]
    return Frame(
        number,
        cycle,
        publish_ns,
        clock_ns,
        source_ns,
        incarnation,
        # From shared memory: what is unknown is bad.
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
    """What the configuration says of a source, as far as others want to know."""

    connector: str = ""
    writable: tuple[str, ...] = ()
    """Patterns of what may be written."""
    armed: bool = False
    """Whether an injection may reach the device."""
    stepped: bool = False
    """Whether it lives on the instance's clock: in virtual time it publishes a frame for each step."""
    outputs: tuple[str, ...] = ()
    """Patterns of what a program elsewhere computes."""
    inouts: tuple[str, ...] = ()
    """Patterns of what it is given, and computes what that shows."""
    replay: bool = False
    """Whether it plays a recording."""

    @property
    def remote(self) -> bool:
        """Whether a program elsewhere computes registers of it."""
        return bool(self.outputs or self.inouts)


class Stamp(NamedTuple):
    """When something was published, comparable to CLOCK_MONOTONIC, and the instance's clock then; UTC of an event."""

    publish_ns: int
    clock_ns: int
    utc_ns: int = 0


class Block:
    """Reading side of a block. Needs nothing from the writer and leaves no trace with it.

    A Block may be used from several threads; a :class:`Cursor` belongs to one.
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
        """Index of its layout's section: tells the blocks of one run of the instance apart."""
        self.layout = layout
        self.ring = ring
        self.events = EventRing(events, retired)
        self.commands = commands
        self.standing = standing
        """The injections that stand on it at present."""
        self.declared = declared
        """Those that the configuration has for it."""
        self.attributes = attributes
        self.clock = clock
        self.model_channel = model_channel
        """Toward the program elsewhere that computes it; None: it is no such block."""
        self.playhead = playhead
        """Of the recording that it plays; None: it plays none."""
        self._retired = retired

    @property
    def retired(self) -> bool:
        """Whether a reload has ended this block: nothing is written to it any more."""
        return self._retired()

    @property
    def incarnation(self) -> int:
        """How many processes have written here, one after another; commands name the one they are for."""
        return self.ring.incarnation

    @property
    def period_ns(self) -> int:
        """Time between two cycles."""
        return self.ring.period_ns

    @property
    def stale_ns(self) -> int:
        """Age from which a frame is bad."""
        return self.ring.stale_ns

    def now_ns(self) -> int:
        """What the ages of its frames are taken against: the playhead, the instance's clock or CLOCK_MONOTONIC."""
        if self.playhead is not None:
            return self.playhead.now_ns()
        return self.clock.now_ns() if self.attributes.stepped else time.monotonic_ns()

    def assess(self, frame: Frame) -> tuple[Quality, str]:
        """Quality of a frame of this block as of now, and its reason."""
        return frame.assess(self.stale_ns, self.now_ns())

    def came_with(self, frame: Frame, step: int) -> bool:
        """Whether a frame came with this step, the present one of virtual time, or a later one.

        Of a block that does not live on the instance's clock none does.
        """
        if self.playhead is not None:
            return self.playhead.came_now(frame.number)
        return self.attributes.stepped and frame.cycle >= step

    def latest(self) -> Frame | None:
        """A copy of the newest frame; None before the source has published its first.

        SegmentError when no stable copy could be made: the writer overtook the reader at every attempt.
        """
        fields = self.ring.latest()
        if fields is not None:
            return _frame(fields)
        if self.ring.head() == 0:
            return None
        raise SegmentError(
            f"source {self.source}: its ring turns faster than a frame can be read; raise instance.ring_mb"
        )

    def read(self, number: int) -> Frame | None:
        """A copy of one frame by its number; None when the ring does not hold it."""
        fields = self.ring.read(number)
        return None if fields is None else _frame(fields)

    def cursor(self, *, after: int | None = None) -> Cursor[Frame]:
        """A stream position behind frame ``after`` (default: the newest one, so that the next frame is news)."""
        return Cursor(self.ring, _frame, self.ring.head() if after is None else after, self._retired)


class BlockWriter:
    """Writing side of a block: exactly one, in its source's process; its threads take turns."""

    def __init__(self, block: Block, clock_ns: Callable[[int], int], at: Stamp | None = None) -> None:
        """``clock_ns`` turns CLOCK_MONOTONIC into the instance's clock. ``at``: when the start is told."""
        self.block = block
        self._clock_ns = clock_ns
        self._turn = threading.Lock()  # so that frames and events are in one order
        self.cycle = 0
        """The present cycle, which events are stamped with."""
        self.at_ns: int | None = None
        """What frames and events are stamped with in virtual time, comparable to CLOCK_MONOTONIC; None: now."""
        self.utc_ns: Callable[[int], int] | None = None
        """Turns such a time into UTC, which events are then stamped with, too."""
        self._quality = Quality.BAD
        self.incarnation = block.ring.begin()
        block.events.ring.begin(self.incarnation)
        self.event(Record(EventKind.STARTED, f"pid {os.getpid()}"), at=at)

    def now_ns(self) -> int:
        """The time that a frame would be stamped with now."""
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
        """Publish one frame of ``layout.size`` bytes and wake its readers; returns its number.

        ``source_ns`` is UTC, default now; 0: no image yet. ``reason`` says why quality is not
        good; it is cut at 256 bytes. ``asked_ns`` (as :meth:`now_ns`): when the device was asked for the image, which
        may be as old as that; default now. ``at``: when, other than now.
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
        """Publish one event and wake the readers of frames and events; returns its number.

        ``quality``: the new one, for QUALITY; default: that of the last frame. ``at``: when, other than now.
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
