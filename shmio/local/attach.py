"""The way in for a local program: attach to an instance, read values by path, follow frames.

Five lines::

    import shmio
    with shmio.attach("a50") as cell:
        print(cell["cell/Robot_800/Axs1_Pos"])
        for view in cell.stream("cell"):
            print(view.cycle, view["Robot_800/Axs1_Pos"], view.missed)

It maps the segment read-only and needs nothing from the instance: no lock, no registration, no server. A program that
writes, too, takes a guest's place.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial

from shmio.config import Declaration
from shmio.errors import CommandError, NotRunningError, PathError, QualityError, SegmentError
from shmio.layout.model import Register
from shmio.layout.topic import Topic, look_up, parse_topic
from shmio.layout.values.codec import Value
from shmio.local.declared_injections import DeclaredInjection, declare
from shmio.local.injection import Diversion, Shadow, lift_all, written
from shmio.local.reading import Reading, View, reading
from shmio.local.timekeeper import TimeMethods
from shmio.local.writer import Outcome, SourceWriter
from shmio.segment.block import Block
from shmio.segment.commands import Direction
from shmio.segment.cursor import Cursor, Entry
from shmio.segment.frame import Frame, Quality
from shmio.segment.processes import Activity, Report
from shmio.segment.segment import Segment, running_instances
from shmio.segment.standing_injections import StandingInjection


def take_guest_slot(segment: Segment) -> int:
    """Take a free guest's place for life; the number of its command queue. SegmentError: none is free."""
    places = segment.processes.guests
    for slot in places:
        if slot.writer is not None and slot.take():
            slot.report = Report(os.getpid(), Activity.RUNNING, time.monotonic_ns())
            return slot.writer
    pids = ", ".join(str(slot.report.pid) for slot in places)
    raise SegmentError(
        f"instance {segment.instance!r} has places for {len(places)} writing programs; end one of pids {pids}"
    )


def of_one_source(what: str, paths: Collection[str], blocks: Mapping[str, Block]) -> tuple[Block, list[Topic]]:
    """The block and the topics of paths that must be of one source; PathError. ``what`` they are given for."""
    default = next(iter(blocks)) if len(blocks) == 1 else None
    topics = [parse_topic(path, blocks, default) for path in paths]
    for path, topic in zip(paths, topics, strict=True):
        if topic.source not in blocks:
            raise PathError(f"{path}: nothing is served under {topic.source} in this version")
    sources = {topic.source for topic in topics}
    if len(sources) != 1:
        raise PathError(f"one {what} is for one source, these are for {', '.join(sorted(sources)) or 'none'}")
    return blocks[sources.pop()], topics


TURN_S = 1.0
"""How often a waiting reader looks whether the instance still is."""


class Attachment(TimeMethods):
    """A running instance as a local program sees it. Use as a context manager, or :meth:`close`."""

    def __init__(self, segment: Segment) -> None:
        super().__init__(segment)
        self._turn = threading.Lock()
        self._guest: int | None = None
        self._source_writers: dict[str, SourceWriter] = {}

    def _blocks(self) -> dict[str, Block]:
        if self._segment.closed:
            raise SegmentError(f"detached from instance {self.instance!r}")
        self._segment.refresh()
        return self._segment.blocks

    @property
    def instance(self) -> str:
        """Name of the instance."""
        return self._segment.instance

    @property
    def sources(self) -> list[str]:
        """Names of the sources."""
        return list(self._blocks())

    @property
    def current(self) -> bool:
        """Whether the instance still is the one attached to; after a stop, attach anew."""
        return self._segment.shared.current()

    def block(self, source: str | None = None) -> Block:
        """A source's block; None is allowed when there is only one source. PathError."""
        blocks = self._blocks()
        if source is None and len(blocks) == 1:
            return next(iter(blocks.values()))
        if source not in blocks:
            raise PathError(f"no source {source!r}; there are: {', '.join(blocks)}")
        return blocks[source]

    def resolve(self, path: str) -> tuple[Block, Register]:
        """Block and register of a topic's path; the source may be left out when there is only one. PathError."""
        blocks = self._blocks()
        topic = parse_topic(path, blocks, next(iter(blocks)) if len(blocks) == 1 else None)
        if topic.source not in blocks:
            raise PathError(f"{path}: nothing is served under {topic.source} in this version")
        if topic.direction == "in":
            raise PathError(f"{path}: what goes into a source is not read but followed: written(); leave out /in")
        block = blocks[topic.source]
        return block, look_up(block.layout, topic)

    def read(self, path: str) -> Reading:
        """A register with quality, reason and age; PathError."""
        block, register = self.resolve(path)
        return reading(block, register, block.latest())

    def __getitem__(self, path: str) -> Value:
        """A register's good value; PathError, and QualityError with the reason when there is none."""
        now = self.read(path)
        if now.quality is Quality.BAD:
            raise QualityError(f"{path}: {now.reason}")
        return now.value

    def frame(self, source: str | None = None) -> View:
        """A copy of a source's newest frame; QualityError before it has published its first."""
        block = self.block(source)
        frame = block.latest()
        if frame is None:
            raise QualityError(f"source {block.source}: no data yet")
        return View(block, frame)

    def stream(self, source: str | None = None, timeout_s: float | None = None) -> Iterator[View]:
        """Every frame from this call on, once, in order, gaps counted; ends after ``timeout_s`` without one.

        NotRunningError when the instance has stopped.
        """
        block = self.block(source)
        return self._views(block, block.cursor(), timeout_s)

    def _views(self, block: Block, cursor: Cursor[Frame], timeout_s: float | None) -> Iterator[View]:
        missed = 0
        while True:
            frame = self._next(block, cursor, timeout_s)
            if frame is not None:
                yield View(block, frame, cursor.missed - missed)
                missed = cursor.missed
            elif block.retired:
                if not cursor.behind:
                    block = self._successor(block)
                    cursor, missed = block.cursor(after=0), 0
            else:
                return

    def _successor(self, block: Block) -> Block:
        """The block that a reload has put in the place of a retired one."""
        successor = self._blocks().get(block.source)
        if successor is None:
            raise NotRunningError(f"source {block.source!r} was removed from instance {self.instance!r} by a reload")
        return successor

    def _next(self, block: Block, cursor: Cursor[Entry], timeout_s: float | None) -> Entry | None:
        """Wait for a frame or an event in turns: a stopped instance rings no bell."""
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            rest_s = TURN_S if deadline_s is None else deadline_s - time.monotonic()
            retired = block.retired  # before looking: what was published before the end is still read
            entry = cursor.next(min(rest_s, TURN_S))
            if entry is not None or retired:
                return entry
            if not self.current:
                raise NotRunningError(f"instance {self.instance!r} has stopped")
            if rest_s < TURN_S:
                return None

    def wait(
        self, source: str | None = None, *, after: View | None = None, timeout_s: float | None = None
    ) -> View | None:
        """The newest frame as soon as it is newer than ``after`` (default: than now); None when the time is over.

        A frame of the block that a reload has put in the place of ``after``'s is newer.
        """
        block = self.block(source)
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        head = block.ring.head()
        last = 0 if after is None or after.section != block.section else after.frame.number
        cursor = block.cursor(after=head if after is None else max(last, head - 1, 0))
        while True:
            frame = self._next(block, cursor, None if deadline_s is None else deadline_s - time.monotonic())
            if frame is not None:
                return View(block, frame)
            if not block.retired:
                return None
            block = self._successor(block)
            cursor = block.cursor(after=0)

    def write(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Write registers, arrays or elements of one source by their paths, as one command; what became of each.

        The attachment must be ``writable``. All values are accepted by the source or none; what the device says is
        told for each. PathError, ValueRangeError, CommandError: nothing has been sent.
        """
        block, topics = of_one_source("write", values, self._blocks())
        for path, topic in zip(values, topics, strict=True):
            if topic.direction == "out":
                raise PathError(f"{path}: what comes out of a source is not written; leave out /out")
        return self._source_writer(block).write(
            {topic.path: value for topic, value in zip(topics, values.values(), strict=True)}, timeout_s
        )

    def inject(self, *paths: str, priority: int = 0, keep: bool = False, name: str = "") -> Shadow:
        """Lay a shadow over registers, elements, structures or patterns of one source, all ``/out`` or all ``/in``.

        Without a suffix it is over ``/out``. Of several over a register the one of the highest ``priority`` is
        outermost, of equal ones the newest. With ``keep`` it stays when this program ends, until somebody lifts it. The
        attachment must be ``writable``. PathError; CommandError: the source refuses, or does not answer.
        """
        block, topics = of_one_source("injection", paths, self._blocks())
        directions = {topic.direction or "out" for topic in topics}
        if len(directions) != 1:
            raise PathError("an injection is over /out or over /in, not over both")
        direction = Direction.IN if "in" in directions else Direction.OUT
        source_writer = self._source_writer(block)
        events = block.events.cursor()  # from before it is laid: what it diverts at once is not missed
        number = source_writer.inject(
            [topic.path or "**" for topic in topics], direction=direction, priority=priority, keep=keep, name=name
        )
        return Shadow(source_writer, number, direction, events, partial(self._next, block), keep=keep)

    def written(self, *paths: str, timeout_s: float | None = None) -> Iterator[Diversion]:
        """What is written to registers, structures or patterns of one source from now on, by whomever, in order.

        Each command when its end is known; it ends after ``timeout_s`` without one. PathError; NotRunningError.
        """
        block, topics = of_one_source("call", paths, self._blocks())
        for path, topic in zip(paths, topics, strict=True):
            if topic.direction == "out":
                raise PathError(f"{path}: what comes out of a source is not written; leave out /out")
        patterns = [topic.path or "**" for topic in topics]
        return written(block, patterns, block.events.cursor(), partial(self._next, block), timeout_s)

    def declare(self, declarations: Sequence[Declaration], *, keep: bool = False) -> list[DeclaredInjection]:
        """Lay injections that their sources run by themselves, all or none; see docs/reference/injections.md.

        Each goes when it is over or lifted, or, unless ``keep``, with this program. The attachment must be
        ``writable``. ConfigError; CommandError: a source refuses, or does not answer.
        """
        return declare(declarations, self._blocks(), self._source_writer, keep=keep)

    def injections(self) -> dict[str, tuple[StandingInjection, ...]]:
        """What stands at present, by source; the innermost first."""
        return {source: block.standing.read() for source, block in self._blocks().items()}

    def lift(self, source: str, number: int) -> None:
        """Lift an injection, whoever laid it. PathError: no such source; CommandError: no such injection."""
        self._source_writer(self.block(source)).lift(number)

    def lift_all(self) -> list[tuple[str, StandingInjection]]:
        """Lift all injections of all sources, whoever laid them: (source, injection) of each.

        All are tried, and at once. CommandError: some still stand, and why.
        """
        standing = [(source, one) for source, ones in self.injections().items() for one in ones if not one.lifted]
        lift_all([(self._source_writer(self.block(source)), one.id) for source, one in standing])
        return standing

    def note(self, text: str, source: str | None = None) -> None:
        """Put a note into a source's events, where it stands between its frames; None: of the first source.

        The attachment must be ``writable``. PathError; ValueRangeError: too long; CommandError: the source's process
        does not answer.
        """
        self._source_writer(self.block(source if source is not None else self.sources[0])).note(text)

    def _source_writer(self, block: Block) -> SourceWriter:
        """The source_writer for a block, in the name of one of the guests' places, kept from the first write on."""
        if not self._segment.shared.writable:
            raise CommandError("this attachment only reads: attach with writable=True")
        with self._turn:
            if self._guest is None:
                self._guest = take_guest_slot(self._segment)
            known = self._source_writers.get(block.source)
            if known is None or known.block is not block:
                known = self._source_writers[block.source] = SourceWriter(block, self._guest)
            return known

    def close(self) -> None:
        """Detach. TimeError: a step failed while time was played."""
        try:
            self._time.close()
        finally:
            self._segment.close()

    def __enter__(self) -> Attachment:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def attach(instance: str | None = None, *, writable: bool = False) -> Attachment:
    """Attach to a running instance, by default the only one; NotRunningError, FormatError, SegmentError.

    ``writable``: to write registers too, which only the instance's own user can.
    """
    if instance is None:
        running = running_instances()
        if not running:
            raise NotRunningError("no instance is running; start one with shmio-supervisor up")
        if len(running) > 1:
            raise NotRunningError(f"several instances are running, name one of them: {', '.join(running)}")
        instance = running[0]
    return Attachment(Segment.open(instance, writable=writable))
