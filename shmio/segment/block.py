"""The block of a source: the source's process publishes frames and events, and readers copy and follow them.

A frame is published by :meth:`BlockWriter.publish`. Readers copy the newest one (:meth:`Block.latest`), read
each one in order (:class:`Cursor`), or also learn when the quality changes (:class:`FrameFollower`).
The ring itself is ``ring.h``, in C.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar

from shmio.errors import SegmentError
from shmio.model.values import Provenance, Quality
from shmio.segment._atomics import REASON_SIZE, Ring
from shmio.segment.events import Event, EventKind, Record, decode_event
from shmio.segment.header import cut

if TYPE_CHECKING:
    from shmio.layout.model import Layout
    from shmio.segment._atomics import FrameTuple
    from shmio.segment.clock import ClockPage
    from shmio.segment.commands import CommandQueues
    from shmio.segment.model_channel import ModelChannel
    from shmio.segment.playhead import Playhead
    from shmio.segment.standing_injections import DeclaredCell, StandingCell


class Frame(NamedTuple):
    """A validated copy of one frame of a block. All times are in ns.

    Attributes:
        number: Number of the frame in its ring, from 1.
        cycle: Period of the source's schedule; in virtual time the number of the step.
        publish_ns: CLOCK_MONOTONIC at publication, or a comparable time in virtual time.
        clock_ns: The instance's clock at publication.
        source_ns: The source's time stamp, UTC. A bad frame has that of the image it repeats; 0: the
            source never had an image, and the bytes are zeros.
        incarnation: Number of the source's process.
        quality: Quality of the image when it was published.
        provenance: Where the raw image comes from.
        event: Number of the last event before the frame.
        delay_us: Maximum age of the image when it was published: the time that the device took to answer.
        reason: Why the quality is not good.
        raw: The image that the source delivered, in its own byte order.
        effective: The image that consumers see; None while nothing is injected.
    """

    number: int
    cycle: int
    publish_ns: int
    clock_ns: int
    source_ns: int
    incarnation: int
    quality: Quality
    provenance: Provenance
    event: int
    delay_us: int
    reason: str
    raw: bytes
    effective: bytes | None

    @property
    def image(self) -> bytes:
        """The image that consumers see: the effective one if there is one, else the raw one."""
        return self.raw if self.effective is None else self.effective

    def age_ns(self, now_ns: int) -> int:
        """Return the maximum age of the image: the time since the device was asked for it.

        Args:
            now_ns: The present time by the block's clock, :meth:`Block.now_ns`.
        """
        return now_ns - self.publish_ns + 1000 * self.delay_us

    def assess(self, stale_ns: int, now_ns: int) -> tuple[Quality, str]:
        """Return quality and reason at ``now_ns``: a frame older than ``stale_ns`` is bad."""
        if self.quality is not Quality.BAD:
            age_ns = self.age_ns(now_ns)
            if age_ns > stale_ns:
                return Quality.BAD, f"stale: no newer frame, this one is {age_ns / 1e9:.1f} s old"
        return self.quality, self.reason


_QUALITIES: Final = tuple(Quality)
_PROVENANCES: Final = tuple(Provenance)


def decode_frame(fields: FrameTuple) -> Frame:
    """Make a frame of what the ring returns."""
    (number, cycle, publish_ns, clock_ns, source_ns, incarnation, quality, provenance, event, delay_us, reason,
     raw, effective) = fields  # fmt: skip
    return Frame(
        number, cycle, publish_ns, clock_ns, source_ns, incarnation,
        # The bytes come from another process: an unknown quality counts as bad.
        _QUALITIES[quality] if quality < len(_QUALITIES) else Quality.BAD,
        _PROVENANCES[provenance] if provenance < len(_PROVENANCES) else Provenance.SIMULATED,
        event, delay_us, reason, raw, effective,
    )  # fmt: skip


Entry = TypeVar("Entry")

_POLL_NS: Final = 1_000_000_000
"""How often a waiting reader polls: if the supervisor dies, the doorbell for a block's end is never rung."""


class Cursor(Generic[Entry]):
    """A reader's position in a ring of frames or events. Use it from one thread.

    >>> cursor = block.cursor()
    >>> while (frame := cursor.next(timeout_s=1.0)) is not None:
    ...     print(frame.number, cursor.missed)
    """

    def __init__(
        self, ring: Ring, decode: Callable[[FrameTuple], Entry], after: int, retired: Callable[[], bool]
    ) -> None:
        self._ring = ring
        self._decode = decode
        self._retired = retired
        self._last = after
        self.missed = 0
        """Total number of entries that were overwritten or skipped before this cursor read them."""
        self._reported = 0

    @property
    def last(self) -> int:
        """Number of the last entry read, or counted as missed."""
        return self._last

    @property
    def behind(self) -> int:
        """Number of entries that are not read yet."""
        return max(0, self._ring.head() - self._last)

    @property
    def ended(self) -> bool:
        """Whether a reload has retired the block, and all its entries have been read."""
        return self._retired() and not self.behind  # in this order: nothing is published after the end

    def take_missed(self) -> int:
        """Return how many entries were missed since the last call."""
        missed, self._reported = self.missed - self._reported, self.missed
        return missed

    def resume(self, *, after: int) -> None:
        """Continue with the entry behind this number; those in between do not count as missed."""
        self._last = after

    def poll(self) -> Entry | None:
        """Return the next entry if there is one, without waiting."""
        ring = self._ring
        margin = 0
        while ring.head() > self._last:
            fields = ring.read(self._last + 1)
            if fields is not None:
                self._last += 1
                return self._decode(fields)
            # Lapped: resume with the oldest entry, and further ahead each time the writer is faster.
            resume = max(self._last + 1, ring.head() - ring.slot_count + margin)
            margin = min(2 * margin + 1, ring.slot_count // 2)
            self.missed += resume - self._last
            self._last = resume
        return None

    def next(self, timeout_s: float | None = None) -> Entry | None:
        """Return the next entry, waiting at most ``timeout_s`` (None: forever).

        Returns:
            The entry. None if none came in time, or if a reload has retired the block and all of it
            has been read.
        """
        ring = self._ring
        deadline_ns = None if timeout_s is None else time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            seen = ring.doorbell()  # before polling, so that no ring is lost
            retired = self._retired()  # also before polling: what was published before the end is still read
            entry = self.poll()
            if entry is not None or retired:
                return entry
            rest_ns = _POLL_NS if deadline_ns is None else min(_POLL_NS, deadline_ns - time.monotonic_ns())
            if rest_ns <= 0:
                return None
            ring.wait(seen, rest_ns)

    def __iter__(self) -> Iterator[Entry]:
        """Iterate over all entries to come, until the block is retired."""
        while True:
            entry = self.next()
            if entry is not None:
                yield entry
            elif self._retired():
                return


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


class EventRing:
    """Reading side of a block's events."""

    def __init__(self, ring: Ring, retired: Callable[[], bool]) -> None:
        self.ring = ring
        self._retired = retired

    def head(self) -> int:
        """Return the number of the newest event; 0: there is none yet."""
        return self.ring.head()

    def read(self, number: int) -> Event | None:
        """Return a copy of the event with this number; None if the ring does not hold it."""
        fields = self.ring.read(number)
        return None if fields is None else decode_event(fields)

    def cursor(self, *, after: int | None = None) -> Cursor[Event]:
        """Return a cursor that starts behind event ``after`` (default: the newest one)."""
        return Cursor(self.ring, decode_event, self.head() if after is None else after, self._retired)


class Block:
    """Reading side of a block. Reading leaves the writer undisturbed.

    Several threads may use a block; a :class:`Cursor` belongs to one thread.
    """

    def __init__(
        self,
        source: str,
        load_layout: Callable[[], Layout],
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
        self._load_layout = load_layout
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

    @cached_property
    def layout(self) -> Layout:
        """The layout of the block, which is read from the segment when it is first needed.

        Raises:
            FormatError: It is inconsistent.
        """
        return self._load_layout()

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


class Layouts(Mapping[str, "Layout"]):
    """The layouts of blocks, by source. A layout that nobody asks for is not read."""

    def __init__(self, blocks: Mapping[str, Block]) -> None:
        self._blocks = blocks

    def __contains__(self, source: object) -> bool:
        """Return whether there is such a source."""
        return source in self._blocks

    def __getitem__(self, source: str) -> Layout:
        """Return the layout of a source. FormatError: it is inconsistent."""
        return self._blocks[source].layout

    def __iter__(self) -> Iterator[str]:
        """Iterate over the sources."""
        return iter(self._blocks)

    def __len__(self) -> int:
        """Return the number of sources."""
        return len(self._blocks)


Bytes = bytes | bytearray | memoryview

_MAX_DELAY_US: Final = 2**32 - 1


class Stamp(NamedTuple):
    """Times of a publication: comparable to CLOCK_MONOTONIC, by the instance's clock, and, for an event, in UTC."""

    publish_ns: int
    clock_ns: int
    utc_ns: int = 0


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
                0 if asked_ns is None else min(-(-max(0, now_ns - asked_ns) // 1000), _MAX_DELAY_US),
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


class QualityChange(Enum):
    """How a block's quality has changed since the frame before."""

    NONE = "none"
    DETAIL = "detail"
    """Another quality or reason, but bad as before, or not bad as before."""
    RECOVERED = "recovered"
    """No longer bad, or not bad from the first frame on."""
    BAD = "bad"
    GAP = "gap"
    """Not bad, but the frame before was stale when this one came."""


_BAD: Final = Quality.BAD  # members of an enum are slow to look up, and these are for each frame
_NONE: Final = QualityChange.NONE


class FrameFollower(Cursor[Frame]):
    """Reads a block's frames from the newest one on, and assesses the last one. For one thread.

    The caller reads a frame with :meth:`poll`, :meth:`read` or :meth:`newest`, and then calls :meth:`take`.
    If there is no new frame, it asks whether the last one :meth:`became_stale`.
    """

    def __init__(self, block: Block, *, catch_up_s: float | None = None, notice_gaps: bool = False) -> None:
        """Start to follow a block.

        Args:
            block: The block.
            catch_up_s: When :meth:`read` is further behind than this time, or than half the ring,
                it skips to the newest frame, and counts the others as missed. None: it does not.
            notice_gaps: Whether :meth:`take` reports :attr:`QualityChange.GAP`.
        """
        super().__init__(block.ring, decode_frame, max(0, block.ring.head() - 1), lambda: block.retired)
        self.block = block
        self.frame: Frame | None = None
        """The last frame taken; None before the first."""
        self.quality = Quality.BAD
        """Quality when the last frame was taken or its age checked."""
        self.reason = "no data yet"
        """Why the quality is not good; empty if it is."""
        self._notice_gaps = notice_gaps
        self._most_behind = None
        if catch_up_s is not None:
            self._most_behind = max(1, min(round(catch_up_s * 1e9 / block.period_ns), block.ring.slot_count // 2))

    @property
    def stale(self) -> bool:
        """Whether the last frame is bad only because of its age."""
        return self.quality is _BAD and self.frame is not None and self.frame.quality is not _BAD

    def read(self, limit: int) -> Iterator[Frame]:
        """Yield new frames, at most ``limit``; when too far behind, skip to the newest first."""
        if self._most_behind is not None and self.behind > self._most_behind:
            newest = self._ring.head()
            self.missed += newest - 1 - self._last
            self._last = newest - 1
        for _ in range(limit):
            if (frame := self.poll()) is None:
                return
            yield frame

    def newest(self) -> Frame | None:
        """Return the newest frame, and continue behind it; None: there is none yet.

        Raises:
            SegmentError: The writer overtook the reader at every attempt to copy.
        """
        frame = self.block.latest()
        if frame is not None:
            self._last = frame.number
        return frame

    def take(self, frame: Frame, *, aged: bool = True) -> QualityChange:
        """Make a frame the last one, and return how it changes the quality.

        Args:
            frame: The frame.
            aged: Whether its quality is that of now, which depends on its age; otherwise it is the
                one that the frame was published with.
        """
        last, before = self.frame, self.quality
        self.frame = frame
        quality, reason = self.block.assess(frame) if aged else (frame.quality, frame.reason)
        change = _NONE
        if quality is not before or reason != self.reason:
            self.quality, self.reason = quality, reason
            change = QualityChange.DETAIL
        if quality is _BAD:
            return change if before is _BAD else QualityChange.BAD
        if before is _BAD:
            return QualityChange.RECOVERED
        if (
            self._notice_gaps
            and last is not None
            and frame.number == last.number + 1  # else the frames between may have come in time
            and last.age_ns(frame.publish_ns) > self.block.stale_ns
        ):
            return QualityChange.GAP
        return change

    def became_stale(self) -> bool:
        """Return whether the last frame has become stale since it was taken, once."""
        if self.frame is None or self.quality is _BAD:
            return False
        quality, reason = self.block.assess(self.frame)
        if quality is not _BAD:
            return False
        self.quality, self.reason = quality, reason
        return True

    def restart(self) -> None:
        """Forget the last frame, and begin with the newest one again."""
        self._last = max(0, self._ring.head() - 1)
        self.frame, self.quality, self.reason = None, Quality.BAD, "no data yet"
