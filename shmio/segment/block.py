"""The block of a source in shared memory: its frames and events, which readers copy or follow.

The source's process calls :meth:`BlockWriter.publish` for each frame. Readers copy the newest frame
(:meth:`Block.latest`), or read each frame in order, with :class:`Cursor` or with
:class:`FrameFollower`, which also reports changes of the quality. The ring is written in C
(``ring.h``).
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar

import msgspec

from shmio.errors import SegmentError
from shmio.model.statuses import StatusArea, status_area
from shmio.model.values import Provenance, Quality
from shmio.segment._atomics import REASON_SIZE, Ring
from shmio.segment.events import Event, EventKind, Record, decode_event
from shmio.segment.header import cut
from shmio.segment.reader_lag import ReportedPosition

if TYPE_CHECKING:
    from shmio.layout.model import ByteOrder, Layout
    from shmio.segment._atomics import FrameTuple
    from shmio.segment.clock import ClockPage
    from shmio.segment.commands import CommandQueues
    from shmio.segment.injection_list import DeclaredCell, InjectionListCell
    from shmio.segment.model_channel import ModelChannel
    from shmio.segment.playhead import Playhead
    from shmio.segment.processes import ProcessSlot
    from shmio.segment.reader_lag import ReaderLag, ReaderTable


class Frame(NamedTuple):
    """A validated copy of one frame of a block. All times are in ns.

    Attributes:
        number: Number of the frame in its ring, from 1.
        cycle: Cycle of the source's schedule; in virtual time, the number of the step.
        publish_ns: CLOCK_MONOTONIC at publication; in virtual time, its equivalent on the virtual
            clock.
        clock_ns: The instance's clock at publication.
        source_ns: The source's time stamp, UTC. A bad frame repeats the last image and its time
            stamp. 0: the source has never delivered an image, and all bytes of the image are zero.
        incarnation: Number of times that the source's process has been started, including the
            present start.
        quality: Quality of the image at publication.
        provenance: Where the raw image comes from.
        event: Number of the last event before the frame.
        delay_us: Maximum age of the image at publication, in us: the time that the device took to
            answer.
        reason: Reason why the quality is not good; empty if it is good.
        raw: The image that the source delivered, in its own byte order.
        effective: The image with injections, which consumers see; None if no injection is active.
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
        """The image that consumers see: ``effective``; ``raw`` if ``effective`` is None."""
        return self.raw if self.effective is None else self.effective

    def age_ns(self, now_ns: int) -> int:
        """Return the maximum age of the image in ns: the time since the source requested it.

        Args:
            now_ns: The present time on the block's clock (:meth:`Block.now_ns`).
        """
        return now_ns - self.publish_ns + 1000 * self.delay_us

    def assess(self, stale_ns: int, now_ns: int) -> tuple[Quality, str]:
        """Return the quality at the time ``now_ns``, and its reason; a frame older than ``stale_ns`` is bad."""
        if self.quality is not Quality.BAD:
            age_ns = self.age_ns(now_ns)
            if age_ns > stale_ns:
                return Quality.BAD, f"stale: no newer frame, and this frame is {age_ns / 1e9:.1f} s old"
        return self.quality, self.reason


# The bytes come from another process: an unknown quality counts as bad.
_QUALITIES: Final = (*Quality, *[Quality.BAD] * 256)[:256]
_PROVENANCES: Final = (*Provenance, *[Provenance.SIMULATED] * 256)[:256]


def decode_frame(fields: FrameTuple) -> Frame:
    """Convert the tuple that :class:`Ring` returns for a frame to a :class:`Frame`."""
    (number, cycle, publish_ns, clock_ns, source_ns, incarnation, quality, provenance, event, delay_us, reason,
     raw, effective) = fields  # fmt: skip
    return Frame(
        number, cycle, publish_ns, clock_ns, source_ns, incarnation, _QUALITIES[quality], _PROVENANCES[provenance],
        event, delay_us, reason, raw, effective,
    )  # fmt: skip


def read_frames(ring: Ring, first: int, count: int) -> list[Frame]:
    """Return copies of up to ``count`` consecutive frames, before the first one that is not in the ring.

    For many frames, this is faster than :meth:`Block.read`.
    """
    return ring.read_many(first, count, Frame, _QUALITIES, _PROVENANCES)


Entry = TypeVar("Entry")

CLOCK_RESOLUTION_NS: Final = 1_000_000
"""By how much the clocks of two processors may differ, in ns, with a wide margin."""
FAR_NS: Final = (1 << 63) - 1
_POLL_NS: Final = 1_000_000_000
"""Interval in ns at which a waiting reader checks whether its block has been retired.

To wait for the doorbell is not enough: a supervisor may retire the block and die before it rings.
"""


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
        """Number of the last entry that this cursor has read or counted as missed."""
        return self._last

    @property
    def behind(self) -> int:
        """Number of unread entries in the ring."""
        return max(0, self._ring.head() - self._last)

    @property
    def ended(self) -> bool:
        """True if a reload has retired the block, and all its entries have been read."""
        return self._retired() and not self.behind  # in this order: nothing is published after retirement

    def take_missed(self) -> int:
        """Return the number of entries missed since the last call."""
        missed, self._reported = self.missed - self._reported, self.missed
        return missed

    def resume(self, *, after: int) -> None:
        """Continue after the entry with this number. Entries that this skips do not count as missed."""
        self._last = after

    def poll(self) -> Entry | None:
        """Return the next entry without waiting; None if there is none yet."""
        ring = self._ring
        margin = 0
        while ring.head() > self._last:
            fields = ring.read(self._last + 1)
            if fields is not None:
                self._last += 1
                return self._decode(fields)
            # The writer has overtaken this reader: go on with the oldest entry, or with a later one if that too
            # is overwritten.
            resume = max(self._last + 1, ring.head() - ring.slot_count + margin)
            margin = min(2 * margin + 1, ring.slot_count // 2)
            self.missed += resume - self._last
            self._last = resume
        return None

    def next(self, timeout_s: float | None = None) -> Entry | None:
        """Return the next entry, and wait for it for at most ``timeout_s`` seconds (None: forever).

        Return None if no entry came in time, or if a reload has retired the block and all its
        entries have been read.
        """
        ring = self._ring
        deadline_ns = None if timeout_s is None else time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            seen = ring.doorbell()  # before polling, so that no wake-up is lost
            retired = self._retired()  # also before polling, so that all entries are still read
            entry = self.poll()
            if entry is not None or retired:
                return entry
            rest_ns = _POLL_NS if deadline_ns is None else min(_POLL_NS, deadline_ns - time.monotonic_ns())
            if rest_ns <= 0:
                return None
            ring.wait(seen, rest_ns)

    def __iter__(self) -> Iterator[Entry]:
        """Iterate over the entries that follow, until the block is retired."""
        while True:
            entry = self.next()
            if entry is not None:
                yield entry
            elif self._retired():
                return


class Attributes(msgspec.Struct, frozen=True):
    """The part of a source's configuration that other processes need."""

    connector: str = ""
    writable: tuple[str, ...] = ()
    """Patterns of the registers that may be written."""
    armed: bool = False
    """True if injections may change what is written to the device."""
    stepped: bool = False
    """True if the source uses the instance clock: it publishes a frame for each step of time."""
    outputs: tuple[str, ...] = ()
    """Patterns of the registers that a remote model computes."""
    inouts: tuple[str, ...] = ()
    """Patterns of the registers that a remote model both reads and computes."""
    replay: bool = False
    """True if the source replays a recording."""

    @property
    def remote(self) -> bool:
        """True if a remote model computes registers of the source."""
        return bool(self.outputs or self.inouts)


class EventRing:
    """The ring of a block's events, for readers."""

    def __init__(self, ring: Ring, retired: Callable[[], bool]) -> None:
        self.ring = ring
        self._retired = retired

    def head(self) -> int:
        """Return the number of the newest event; 0: there is none yet."""
        return self.ring.head()

    def read(self, number: int) -> Event | None:
        """Return a copy of the event with this number; None if it is not in the ring."""
        fields = self.ring.read(number)
        return None if fields is None else decode_event(fields)

    def cursor(self, *, after: int | None = None) -> Cursor[Event]:
        """Return a cursor that starts after the event with number ``after``; None: after the newest event."""
        return Cursor(self.ring, decode_event, self.head() if after is None else after, self._retired)


_MAX_PARTS: Final = 8
"""Number of paths that are looked up one by one, before the whole layout is read."""


class Block:
    """A block of a source, for readers. Readers never delay the writer.

    Several threads may use a block; a :class:`Cursor` belongs to one thread.
    """

    def __init__(
        self,
        source: str,
        load_layout: Callable[[], Layout],
        load_part: Callable[[str], Layout | None],
        ring: Ring,
        events: Ring,
        commands: CommandQueues,
        lists: tuple[memoryview, int, int],
        readers: ReaderTable,
        attributes: Attributes,
        retired: Callable[[], bool],
        section: int,
        clock: ClockPage,
        model_channel: ModelChannel | None = None,
        playhead: Playhead | None = None,
    ) -> None:
        self.source = source
        self.section = section
        """Index of the section with the block's layout, unique within this run of the instance."""
        self._load_layout, self._load_part = load_layout, load_part
        self._parts: dict[str, Layout] = {}
        self.ring = ring
        self.events = EventRing(events, retired)
        self.commands = commands
        self._lists = lists
        self._readers = readers
        self.attributes = attributes
        self.clock = clock
        self.model_channel = model_channel
        """The channel to a remote model; None if no remote model computes the block."""
        self.playhead = playhead
        """The playhead of the replayed recording; None if the block replays none."""
        self._retired = retired
        self._newest: Frame | None = None  # the last result of latest()

    @cached_property
    def layout(self) -> Layout:
        """Layout of the block. It is read from the segment when it is first used.

        Raises:
            FormatError: The layout is inconsistent.
        """
        return self._load_layout()

    def layout_with(self, path: str) -> Layout:
        """Return the block's layout, or one with only the register that a path names or lies in.

        To read single registers of a large layout is much faster than to read all of it. A program
        that names more than a few paths reads all.

        Args:
            path: Canonical path of a register, element, slice or part.

        Raises:
            FormatError: The layout is inconsistent.
        """
        if "layout" in vars(self):
            return self.layout
        part = self._parts.get(path)
        if part is None and len(self._parts) < _MAX_PARTS and (part := self._load_part(path)) is not None:
            self._parts[path] = part
        return self.layout if part is None else part

    @property
    def _known_layout(self) -> Layout:
        """The layout with at least one register: what has been read of it, else all of it."""
        return next(iter(self._parts.values())) if self._parts and "layout" not in vars(self) else self.layout

    @property
    def byte_order(self) -> ByteOrder:
        """Byte order of the block's images."""
        return self._known_layout.byte_order

    @property
    def statuses(self) -> StatusArea | None:
        """The status area of the block's images; None if the source gives its registers no statuses."""
        return status_area(self._known_layout)

    # Most programs read no lists of injections, and the modules for them take long to import.

    @cached_property
    def injections(self) -> InjectionListCell:
        """The existing injections of the source."""
        from shmio.segment.injection_list import injection_list_cell  # noqa: PLC0415

        return injection_list_cell(self._lists[0], self._lists[1])

    @cached_property
    def declared(self) -> DeclaredCell:
        """The injections that the configuration declares for the source."""
        from shmio.segment.injection_list import declared_cell  # noqa: PLC0415

        return declared_cell(self._lists[0], self._lists[2])

    @property
    def retired(self) -> bool:
        """True if a reload has retired this block: nothing more is written to it."""
        return self._retired()

    @property
    def incarnation(self) -> int:
        """Number of times that the source's process has been started, including the present start.

        A process accepts only commands that name its incarnation.
        """
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
        """Return the present time in ns on the clock that determines the age of frames.

        For a source that replays a recording, this is the clock of its playhead. For any other
        source that uses the instance clock, this is the instance clock. For all other sources, this
        is CLOCK_MONOTONIC.
        """
        if self.playhead is not None:
            return self.playhead.now_ns()
        return self.clock.now_ns() if self.attributes.stepped else time.monotonic_ns()

    def assess(self, frame: Frame, now_ns: int | None = None) -> tuple[Quality, str]:
        """Return a frame's present quality, and the reason if it is not good.

        Args:
            frame: The frame.
            now_ns: The present time, from :meth:`now_ns`; None: read the clock.
        """
        if now_ns is None:
            now_ns = self.now_ns()
        if frame.publish_ns > now_ns and frame.quality is not Quality.BAD and self.playhead is None:
            ahead_ns = frame.publish_ns - self._latest_ns()
            if ahead_ns > 0:
                return Quality.BAD, f"its publish time is {ahead_ns / 1e9:.3g} s in the future, so its age is unknown"
        return frame.assess(self.stale_ns, now_ns)

    def _latest_ns(self) -> int:
        """Return the latest publish time that a frame can have now, also in the eyes of another process."""
        if not self.attributes.stepped:
            return time.monotonic_ns() + CLOCK_RESOLUTION_NS
        if self.clock.step_request().virtual:  # a restored snapshot may have turned time back
            return FAR_NS
        return self.clock.now_ns() + max(self.period_ns, CLOCK_RESOLUTION_NS)

    def came_with(self, frame: Frame, step: int) -> bool:
        """Return whether a frame belongs to the step of virtual time with this number, or to a later one.

        For a block that replays a recording, ``step`` must be the present step. For a block that
        does not use the instance clock, the result is always False.
        """
        if self.playhead is not None:
            return self.playhead.came_now(frame.number)
        return self.attributes.stepped and frame.cycle >= step

    def latest(self) -> Frame | None:
        """Return a copy of the newest frame; None if the source has not published one yet.

        Raises:
            SegmentError: The writer overtook the reader at every attempt to copy.
        """
        newest, head = self._newest, self.ring.head()
        if newest is not None and newest.number == head:
            return newest  # a frame never changes
        fields = self.ring.latest()
        if fields is not None:
            self._newest = newest = decode_frame(fields)
            return newest
        if head == 0:
            return None
        raise SegmentError(
            f"source {self.source}: its ring is overwritten faster than a frame can be read; raise instance.ring_mb"
        )

    def read(self, number: int) -> Frame | None:
        """Return a copy of the frame with this number; None if it is not in the ring."""
        fields = self.ring.read(number)
        return None if fields is None else decode_frame(fields)

    def reader_lag(self, slot: ProcessSlot) -> ReaderLag | None:
        """Return how far the slowest reader in a process is behind; None if the process does not read the block."""
        return self._readers.read(slot.index, slot.report.pid, self.ring.head())

    def report_reader(self, slot: ProcessSlot, last: int | None) -> None:
        """Report how far this process's slowest reader is behind. Only the process in ``slot`` may call this.

        Args:
            slot: The slot of this process.
            last: Number of the last frame that the reader has read; None: the process no longer reads
                the block.
        """
        if last is None:
            self._readers.write(slot.index, ReportedPosition(0, 0, 0, 0, 0))
            return
        frames, behind_ns, at_ns = max(0, self.ring.head() - last), 0, time.monotonic_ns()
        if frames:
            oldest = self.cursor(after=last).poll()  # or the oldest that is left, if that frame is overwritten
            behind_ns = 0 if oldest is None else max(0, self.now_ns() - oldest.publish_ns)
        self._readers.write(slot.index, ReportedPosition(os.getpid(), frames, last, behind_ns, at_ns))

    def cursor(self, *, after: int | None = None) -> Cursor[Frame]:
        """Return a cursor that starts after the frame with number ``after``; None: after the newest frame."""
        return Cursor(self.ring, decode_frame, self.ring.head() if after is None else after, self._retired)


class Layouts(Mapping[str, "Layout"]):
    """Layouts of blocks, by source. A layout is read from the segment when it is first used."""

    def __init__(self, blocks: Mapping[str, Block]) -> None:
        self._blocks = blocks

    def __contains__(self, source: object) -> bool:
        """Return whether there is such a source."""
        return source in self._blocks

    def __getitem__(self, source: str) -> Layout:
        """Return the layout of a source; raise FormatError if the layout is inconsistent."""
        return self._blocks[source].layout

    def __iter__(self) -> Iterator[str]:
        """Iterate over the sources."""
        return iter(self._blocks)

    def __len__(self) -> int:
        """Return the number of sources."""
        return len(self._blocks)


Bytes = bytes | bytearray | memoryview

_MAX_DELAY_US: Final = 2**32 - 1
_MIN_I64: Final = -(2**63)
_MAX_I64: Final = 2**63 - 1


class Stamp(msgspec.Struct, frozen=True, gc=False):  # each step makes one: faster than a tuple
    """The times of one publication, in ns.

    Attributes:
        publish_ns: CLOCK_MONOTONIC; in virtual time, its equivalent on the virtual clock.
        clock_ns: The instance's clock.
        utc_ns: UTC, which only events have; 0: the present time.
    """

    publish_ns: int
    clock_ns: int
    utc_ns: int = 0


class BlockWriter:
    """A block, for the process of its source, which writes it. Several threads may use it."""

    def __init__(self, block: Block, clock_ns: Callable[[int], int], at: Stamp | None = None) -> None:
        """Increase the block's incarnation by one, and publish the STARTED event.

        Args:
            block: The block to write.
            clock_ns: Converts CLOCK_MONOTONIC to the instance's clock.
            at: Times of the start event; None: now.
        """
        self.block = block
        self._frames, self._events = block.ring, block.events.ring
        self._clock_ns = clock_ns
        self._lock = threading.Lock()  # frames and events must have one common order
        self.cycle = 0
        """The present cycle. Each event gets this number."""
        self.at_ns: int | None = None
        """In virtual time, the publish time of frames and events: CLOCK_MONOTONIC's equivalent; None: now."""
        self.utc_ns: Callable[[int], int] | None = None
        """Converts :attr:`at_ns` to the UTC time of events.

        None: events get the present UTC time.
        """
        self._quality = Quality.BAD
        self._event = self._events.head()  # number of the last event
        self.incarnation = self._frames.begin()
        self._events.begin(self.incarnation)
        self.event(Record(EventKind.STARTED, f"pid {os.getpid()}"), at=at)

    def now_ns(self) -> int:
        """Return the publish time that a frame would get if it were published now."""
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
            source_ns: The source's time stamp, UTC in ns; None: now; 0: there is no image yet.
            quality: Quality of the image.
            provenance: Where the image comes from.
            reason: Reason why the quality is not good; cut at 256 bytes.
            effective: The image that consumers see; None: ``raw``.
            asked_ns: Time of the request to the device in ns, on the clock of :meth:`now_ns`; None:
                now.
            at: Times of the publication; None: now.

        Returns:
            The frame's number.
        """
        with self._lock:
            if at is None:
                now_ns = self.block.now_ns() if self.at_ns is None else self.at_ns
                clock_ns = self._clock_ns(now_ns)
            else:
                now_ns, clock_ns = at.publish_ns, at.clock_ns
            self._quality = quality
            return self._frames.publish(
                raw,
                effective,
                cycle,
                now_ns,
                clock_ns,
                time.time_ns() if source_ns is None else source_ns,
                quality,
                provenance,
                self._event,
                0 if asked_ns is None or asked_ns >= now_ns else min(-(-(now_ns - asked_ns) // 1000), _MAX_DELAY_US),
                cut(reason, REASON_SIZE) if reason else b"",
            )

    def publish_packed(self, data: Bytes, at: int, *, number: int, made_ns: int, late_ns: int) -> tuple[int, int, int]:
        """Publish the good frames at a position of a message of the fabric, and wake their readers once.

        Args:
            data: The message.
            at: Position of an entry.
            number: Number of the owner's frame before the first one. Frames after a gap are not
                published, nor those after another entry.
            made_ns: CLOCK_MONOTONIC of the owner when it made the message, in ns. The frames are as
                much older as they waited until then.
            late_ns: Age of the message in ns.

        Returns:
            The number of frames, the position of the last one, and the position after it.
        """
        with self._lock:
            now_ns = self.now_ns()
            done = self._frames.publish_packed(
                data, at, number, now_ns, self._clock_ns(now_ns), self._event,
                max(_MIN_I64, min(made_ns, _MAX_I64)), max(0, min(late_ns, 1000 * _MAX_DELAY_US)),
            )  # fmt: skip
            if done[0]:
                self._quality = Quality.GOOD
            return done

    def _present(self) -> Stamp:
        now_ns = self.now_ns()
        if self.at_ns is None or self.utc_ns is None:
            return Stamp(now_ns, self._clock_ns(now_ns))
        return Stamp(now_ns, self._clock_ns(now_ns), self.utc_ns(now_ns))

    def event(self, record: Record, *, quality: Quality | None = None, at: Stamp | None = None) -> int:
        """Publish an event, and wake the readers of frames and events.

        Args:
            record: The content of the event.
            quality: The new quality, for a QUALITY event; None: the quality of the last frame.
            at: Times of the publication; None: now.

        Returns:
            The event's number.
        """
        with self._lock:
            at = at or self._present()
            payload, text = record.pack()
            number = self._event = self._events.publish(
                payload,
                None,
                self.cycle,
                at.publish_ns,
                at.clock_ns,
                at.utc_ns or time.time_ns(),
                self._quality if quality is None else quality,
                Provenance.LIVE,
                self._frames.head(),
                0,
                text,
            )
            self._frames.wake()
            return number


class QualityChange(Enum):
    """Change of a block's quality since the previous frame."""

    NONE = "none"
    DETAIL = "detail"
    """The reason has changed, or the quality has changed between good and uncertain."""
    RECOVERED = "recovered"
    """The quality is no longer bad, or the first frame is not bad."""
    BAD = "bad"
    GAP = "gap"
    """The quality is not bad, but the previous frame had become stale before the new frame came."""


_BAD: Final = Quality.BAD  # each frame needs these, and looking up a member of an enum is slow
_NONE: Final = QualityChange.NONE


class FrameFollower(Cursor[Frame]):
    """Reads a block's frames from the newest frame on, and tracks the quality.

    Use it from one thread.

    Read a frame with :meth:`poll`, :meth:`read` or :meth:`newest`, then pass it to :meth:`take`. If
    there is no new frame, call :meth:`became_stale`.
    """

    def __init__(self, block: Block, *, catch_up_s: float | None = None, notice_gaps: bool = False) -> None:
        """Start to follow a block.

        Args:
            block: The block.
            catch_up_s: If the unread frames cover more than this time, or more than half the ring,
                :meth:`read` skips to the newest frame and counts the skipped frames as missed.
                None: it never skips.
            notice_gaps: Whether :meth:`take` reports :attr:`QualityChange.GAP`.
        """
        super().__init__(block.ring, decode_frame, max(0, block.ring.head() - 1), lambda: block.retired)
        self.block = block
        self.frame: Frame | None = None
        """The last frame taken; None before the first."""
        self.quality = Quality.BAD
        """Present quality, as of the last call of :meth:`take` or :meth:`became_stale`."""
        self.reason = "no data yet"
        """Reason why the quality is not good; empty if it is good."""
        self._notice_gaps = notice_gaps
        self._most_behind = None
        if catch_up_s is not None:
            self._most_behind = max(1, min(round(catch_up_s * 1e9 / block.period_ns), block.ring.slot_count // 2))

    @property
    def stale(self) -> bool:
        """True if the last frame is bad only because of its age."""
        return self.quality is _BAD and self.frame is not None and self.frame.quality is not _BAD

    def read(self, limit: int) -> Iterator[Frame]:
        """Yield at most ``limit`` new frames; if more than ``most_behind`` are unread, first skip to the newest."""
        if self._most_behind is not None and self.behind > self._most_behind:
            newest = self._ring.head()
            self.missed += newest - 1 - self._last
            self._last = newest - 1
        for _ in range(limit):
            if (frame := self.poll()) is None:
                return
            yield frame

    def newest(self) -> Frame | None:
        """Return the newest frame, and continue reading after it; None if there is no frame yet.

        Raises:
            SegmentError: The writer overtook the reader at every attempt to copy.
        """
        frame = self.block.latest()
        if frame is not None:
            self._last = frame.number
        return frame

    def take(self, frame: Frame, *, aged: bool = True) -> QualityChange:
        """Take a frame as the last frame, and return how the quality has changed.

        Args:
            frame: The frame.
            aged: True: assess the frame's quality now, by its age. False: use the quality that it
                had at publication.
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
            and frame.number == last.number + 1  # otherwise, frames in between may have come in time
            and last.age_ns(frame.publish_ns) > self.block.stale_ns
        ):
            return QualityChange.GAP
        return change

    def became_stale(self) -> bool:
        """Return True at the first call after the last frame has become stale, else False."""
        if self.frame is None or self.quality is _BAD:
            return False
        quality, reason = self.block.assess(self.frame)
        if quality is not _BAD:
            return False
        self.quality, self.reason = quality, reason
        return True

    def restart(self) -> None:
        """Forget the last frame, and start again with the newest frame."""
        self._last = max(0, self._ring.head() - 1)
        self.frame, self.quality, self.reason = None, Quality.BAD, "no data yet"
