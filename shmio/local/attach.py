"""Attach to an instance on this host: read values by path, follow frames, write and inject.

For example::

    import shmio
    with shmio.attach("a50") as cell:
        print(cell["cell/Robot_800/Axs1_Pos"])
        for view in cell.stream("cell"):
            print(view.cycle, view["Robot_800/Axs1_Pos"], view.missed)

Attaching maps the shared memory read-only. The program then holds no lock, is not registered with
the instance, and needs no server. A program that also writes (``writable``) maps the memory
writable, and occupies one of the external slots of the process table.
"""

from __future__ import annotations

import os
import threading
import time
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Final

import msgspec

from shmio.errors import CommandError, NotRunningError, PathError, QualityError, SegmentError, ValueRangeError
from shmio.layout.glob import choose
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic, look_up, parse_topic
from shmio.layout.values.codec import Value
from shmio.local.reading import View, reading
from shmio.model.clock import Clock, check_step
from shmio.model.values import Quality, Reading
from shmio.segment.block import Block, Cursor, Entry, Frame, Layouts
from shmio.segment.commands import Direction
from shmio.segment.processes import Activity, Report, program_name
from shmio.segment.segment import Segment, running_instances
from shmio.wording import name_one, unknown

if TYPE_CHECKING:
    from pathlib import Path

    from shmio.config import Declaration
    from shmio.local.events import Events
    from shmio.local.injection import Campaign, ObservedWrite, Shadow
    from shmio.local.replays import Replays
    from shmio.local.snapshots import Snapshots, States
    from shmio.local.subscription import Following, Subscription
    from shmio.local.time_control import Coordinator, Timekeeper
    from shmio.local.writer import SourceWriter
    from shmio.model.injection import Injection, Lifted
    from shmio.model.snapshot import SnapshotInfo
    from shmio.model.values import Outcome
    from shmio.segment.injection_list import InjectionEntry

_TURN_S: Final = 1.0
"""Interval in s at which a waiting reader checks whether the instance still runs."""


class Attachment:
    """A running instance to which a program on the same host has attached.

    Use it as a context manager, or call :meth:`close`. :func:`attach` creates it.
    """

    def __init__(
        self,
        segment: Segment,
        coordinator: Coordinator | None = None,
        states: States | None = None,
        snapshot_folder: Callable[[], Path] | None = None,
    ) -> None:
        self._segment = segment
        self._coordinator, self._states, self._snapshot_folder = coordinator, states, snapshot_folder
        self._timekeeper: Timekeeper | None = None
        self._lock = threading.Lock()
        self._slot: int | None = None
        self._source_writers: dict[str, SourceWriter] = {}
        self._open: weakref.WeakSet[Following[Any]] = weakref.WeakSet()
        self._detached = False

    # Most programs only read values. So a method imports what reading does not need.

    @cached_property
    def replay(self) -> Replays:
        """The instance's replays. Call it as ``replay`` of :class:`shmio.Cell`, or use its methods.

        The attachment must be ``writable`` to change them.
        """
        from shmio.local.replays import Replays  # noqa: PLC0415

        return Replays(self._segment)

    @property
    def _time(self) -> Timekeeper:
        """Moves the instance's time."""
        from shmio.local.time_control import Timekeeper  # noqa: PLC0415

        with self._lock:
            if self._timekeeper is None:
                self._timekeeper = Timekeeper(self._segment, self._coordinator)
            return self._timekeeper

    @property
    def _snapshots(self) -> Snapshots:
        """Saves and restores snapshots."""
        from shmio.local.snapshots import Snapshots  # noqa: PLC0415

        self._segment.require_running()
        return Snapshots(self._segment, self._time, self._states, self._snapshot_folder)

    def _blocks(self) -> dict[str, Block]:
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
        """True if the attached instance still runs.

        After a restart of the instance, attach again.
        """
        return self._segment.shared.current()

    def layouts(self, *sources: str) -> Mapping[str, Layout]:
        """Return the layouts of these sources, by source; of all sources if none is named.

        Raises:
            PathError: There is no such source.
        """
        self._segment.require_running()
        return Layouts({source: self.block(source) for source in sources} if sources else self._blocks())

    def real_sources(self) -> list[str]:
        """Return the names of the sources that steps do not advance, such as those with a real device."""
        self._segment.require_running()
        return [source for source, block in self._blocks().items() if not block.attributes.stepped]

    def block(self, source: str | None = None) -> Block:
        """Return the block of a source.

        Args:
            source: Name of the source; None if there is only one.

        Raises:
            PathError: There is no such source, or there are several sources and you named none.
        """
        blocks = self._blocks()
        if source is None and len(blocks) == 1:
            return next(iter(blocks.values()))
        if source not in blocks:
            raise PathError(name_one("source", blocks) if source is None else unknown("source", source, blocks))
        return blocks[source]

    def resolve(self, path: str) -> tuple[Block, Register]:
        """Return the block and the register that a path names.

        Args:
            path: Path of a register or element; the source may be omitted if there is only one.

        Raises:
            PathError: There is no such register, or the path ends in ``/in``.
        """
        blocks = self._blocks()
        topic = parse_topic(path, blocks, next(iter(blocks)) if len(blocks) == 1 else None)
        if topic.source not in blocks:
            raise PathError(f"{path}: {unknown('source', topic.source, blocks)}")
        if topic.direction == "in":
            raise PathError(f"{path}: an input of a source cannot be read; follow it by written(), or leave out /in")
        block = blocks[topic.source]
        return block, look_up(block.layout_with(topic.path), topic)

    def get(self, *patterns: str) -> list[Reading]:
        """Read the registers that match the patterns, whatever their quality: see :class:`shmio.Cell`.

        Raises:
            PathError: A pattern matches no register.
            NotRunningError: The instance has stopped.
        """
        self._segment.require_running()
        blocks = self._blocks()
        chosen = choose(patterns, Layouts(blocks), lambda topic: blocks[topic.source].layout_with(topic.path))
        frames = {source: blocks[source].latest() for source in {source for source, _ in chosen}}
        return [reading(blocks[source], register, frames[source]) for source, register in chosen]

    def subscribe(self, *patterns: str, every_frame: bool = False, max_rate_hz: float = 0.0) -> Subscription:
        """Return an iterator over the present values of registers, then each change.

        See :class:`shmio.Cell`. The iterator ends when you close it or the attachment.
        """
        from shmio.local.subscription import Subscription  # noqa: PLC0415

        subscription = Subscription(
            self._segment, self._blocks, patterns, every_frame=every_frame, max_rate_hz=max_rate_hz
        )
        self._end_with_this(subscription)
        return subscription

    def events(self, *sources: str) -> Events:
        """Follow the events of these sources from now on; of all sources if none is named.

        See :class:`shmio.Cell`. The iterator ends when you close it or the attachment.

        Raises:
            PathError: There is no such source.
            NotRunningError: The instance has stopped.
        """
        from shmio.local.events import Events  # noqa: PLC0415

        self._segment.require_running()
        followed = [self.block(source) for source in dict.fromkeys(sources) or self._blocks()]
        events = Events(self._segment, self._blocks, followed)
        self._end_with_this(events)
        return events

    def read(self, path: str) -> Reading:
        """Read a register, whatever its quality.

        Args:
            path: Path of a register or element; the source may be omitted if there is only one.

        Returns:
            The value with its quality, reason, provenance and age.

        Raises:
            PathError: There is no such register.
        """
        block, register = self.resolve(path)
        return reading(block, register, block.latest())

    def __getitem__(self, path: str) -> Value:
        """Return a register's value, unless its quality is bad.

        Raises:
            PathError: There is no such register.
            QualityError: The quality is bad; the message gives the reason.
        """
        now = self.read(path)
        if now.quality is Quality.BAD:
            raise QualityError(f"{path}: {now.reason}")
        return now.value

    def frame(self, source: str | None = None) -> View:
        """Return a copy of a source's newest frame.

        Args:
            source: Name of the source; None if there is only one.

        Raises:
            PathError: There is no such source.
            QualityError: The source has not published a frame yet.
        """
        block = self.block(source)
        frame = block.latest()
        if frame is None:
            raise QualityError(f"source {block.source}: no data yet")
        return View(block, frame)

    def stream(self, source: str | None = None, timeout_s: float | None = None) -> Iterator[View]:
        """Iterate over the frames that a source publishes from now on: each frame once, in order.

        A view's ``missed`` counts the frames that were overwritten before they could be read.

        Args:
            source: Name of the source; None if there is only one.
            timeout_s: The iterator ends after this time in s without a frame; None: it waits forever.

        Raises:
            PathError: There is no such source.
            NotRunningError: The instance has stopped, or a reload has removed the source.
        """
        block = self.block(source)
        return self._views(block, block.cursor(), timeout_s)

    def _views(self, block: Block, cursor: Cursor[Frame], timeout_s: float | None) -> Iterator[View]:
        while True:
            frame = self._next(block, cursor, timeout_s)
            if frame is not None:
                yield View(block, frame, cursor.take_missed())
            elif cursor.ended:
                block = self._successor(block)
                cursor = block.cursor(after=0)
            elif not block.retired:
                return

    def _successor(self, block: Block) -> Block:
        """Return the block with which a reload has replaced a retired block."""
        successor = self._blocks().get(block.source)
        if successor is None:
            raise NotRunningError(f"source {block.source!r} was removed from instance {self.instance!r} by a reload")
        return successor

    def _next(self, block: Block, cursor: Cursor[Entry], timeout_s: float | None) -> Entry | None:
        """Wait for the next frame or event, and check meanwhile that the instance has not stopped."""
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            rest_s = _TURN_S if deadline_s is None else deadline_s - time.monotonic()
            retired = block.retired  # before reading, so that nothing published before the end is missed
            entry = cursor.next(min(rest_s, _TURN_S))
            if entry is not None or retired:
                return entry
            self._segment.require_running()
            if rest_s < _TURN_S:
                return None

    def wait(
        self, source: str | None = None, *, after: View | None = None, timeout_s: float | None = None
    ) -> View | None:
        """Wait for a frame that is newer than a given one.

        If a reload replaces the source's block, each frame of the new block counts as newer.

        Args:
            source: Name of the source; None if there is only one.
            after: The given frame; None: the newest frame at the time of the call.
            timeout_s: Time-out in s; None: wait forever.

        Returns:
            The newest frame, or None if none came in time.

        Raises:
            PathError: There is no such source.
            NotRunningError: The instance has stopped, or a reload has removed the source.
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

    def set(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Write values as :meth:`write` does, but return outcomes with the paths that you gave.

        Raises:
            PathError, ValueRangeError, CommandError: As for :meth:`write`; nothing has been sent.
            NotRunningError: The instance has stopped.
        """
        from shmio.local.injection import as_given  # noqa: PLC0415

        self._segment.require_running()
        return as_given(values, self.write(values, timeout_s))

    def write(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Write values to one source as one command, and wait for the outcomes.

        The source accepts all values or none. The attachment must be ``writable``.

        Args:
            values: Values by path: of registers, whole arrays, elements, slices or bits.
            timeout_s: Time in s that the values may wait for a cycle of the source; None: 2 s, or
                three cycles if that is longer.

        Returns:
            The outcome of each value, in the given order.

        Raises:
            PathError: A path names no register, or the paths belong to several sources.
            ValueRangeError: A value does not fit its register, or a register is given twice.
            CommandError: A register is not writable, or the source's queue has no room.
                After any of these errors, nothing has been sent.
        """
        from shmio.local.injection import by_path  # noqa: PLC0415

        block, topics = _of_one_source("write", values, self._blocks(), written=True)
        return self._source_writer(block).write(by_path(topics, values), timeout_s)

    def inject(self, *paths: str, priority: int = 0, keep: bool = False, name: str = "") -> Shadow:
        """Create a shadow: an injection over registers of one source, to which this program gives values.

        The attachment must be ``writable``.

        Args:
            paths: Registers, elements, structures or patterns of one source. With the suffix
                ``/in``, the shadow takes the values that others write. With ``/out``, or without a
                suffix, it replaces the values that consumers see. All paths must have the same
                direction.
            priority: If several injections cover a register, the one with the highest priority is
                outermost: its values count. Among equal priorities, the newest is outermost.
            keep: Whether the shadow stays when this program ends, until a program lifts it.
            name: Name of the injection in events and lists.

        Returns:
            The shadow; leaving its ``with`` block lifts it.

        Raises:
            PathError: A path names no register, or the paths differ in source or direction.
            CommandError: The source refuses, or does not answer.
            NotRunningError: The instance has stopped.
        """
        from shmio.layout.overlay import names_in  # noqa: PLC0415
        from shmio.local.injection import Shadow  # noqa: PLC0415

        self._segment.require_running()
        block, topics = _of_one_source("injection", paths, self._blocks())
        directions = {topic.direction or "out" for topic in topics}
        if len(directions) != 1:
            raise PathError("an injection covers /out or /in, not both")
        direction = Direction.IN if "in" in directions else Direction.OUT
        source_writer = self._source_writer(block)
        events = block.events.cursor()  # created before the shadow is created, so that no diverted write is missed
        patterns = [topic.path or "**" for topic in topics]
        number = source_writer.inject(patterns, direction=direction, priority=priority, keep=keep, name=name)
        names = names_in(block.layout, patterns)
        return Shadow(
            source_writer, number, direction, events, partial(self._next, block), keep=keep, names=names,
            running=self._segment.shared.current,
        )  # fmt: skip

    def written(self, *paths: str, timeout_s: float | None = None) -> Iterator[ObservedWrite]:
        """Iterate over the commands that write to registers of one source from now on.

        The iterator yields accepted commands in order, each when its outcome is known.

        Args:
            paths: Registers, structures or patterns of one source.
            timeout_s: The iterator ends after this time in s without a command; None: it waits
                forever.

        Raises:
            PathError: A path names no register, or the paths belong to several sources.
            NotRunningError: The instance has stopped.
        """
        from shmio.local.injection import written  # noqa: PLC0415

        block, topics = _of_one_source("call", paths, self._blocks(), written=True)
        patterns = [topic.path or "**" for topic in topics]
        return written(block, patterns, block.events.cursor(), partial(self._next, block), timeout_s)

    def declare(self, declarations: Iterable[Mapping[str, Any] | Declaration], *, keep: bool = False) -> Campaign:
        """Create all of these declared injections, or none. Their sources run them on their own.

        An injection ends as its declaration says, or when a program lifts it. The attachment must
        be ``writable``. See docs/reference/injections.md.

        Args:
            declarations: Mappings with the keys of an ``[[injection]]`` table, or declarations.
            keep: Whether the injections continue when this program ends.

        Returns:
            The created injections, as a campaign. Iterate over it to get their events. Leaving its
            ``with`` block lifts the injections, unless ``keep`` is set.

        Raises:
            DeclarationError: A declaration is wrong.
            CommandError: A source refuses, or does not answer.
            NotRunningError: The instance has stopped.
        """
        from shmio.local.injection import Campaign  # noqa: PLC0415

        self._segment.require_running()
        campaign = Campaign(self._segment, declarations, self._blocks(), self._source_writer, keep=keep)
        self._end_with_this(campaign)
        return campaign

    def injections(self, *sources: str) -> list[Injection[Mapping[str, Any]]]:
        """Return the existing injections of these sources; of all sources if none is named.

        Within a source, the innermost injection comes first.

        Raises:
            PathError: There is no such source.
            NotRunningError: The instance has stopped.
        """
        self._segment.require_running()
        return [
            _with_source(source, one)
            for source in dict.fromkeys(sources) or self._blocks()
            for one in self.block(source).injections.read()
        ]

    def lift(self, source: str, number: int) -> None:
        """Lift an injection, whichever program created it.

        Args:
            source: Name of the source.
            number: Number of the injection.

        Raises:
            PathError: There is no such source or injection.
            CommandError: The source does not answer.
            NotRunningError: The instance has stopped.
        """
        self._segment.require_running()
        block = self.block(source)
        if not any(one.number == number and not one.lifted for one in block.injections.read()):
            raise PathError(f"{source}: there is no injection {number}; injections() lists them")
        self._source_writer(block).lift(number)

    def lift_all(self, *sources: str) -> list[Lifted]:
        """Lift all injections of these sources, whichever program created them.

        Without arguments, lift the injections of all sources.

        Returns:
            The lifted injections.

        Raises:
            CommandError: Some injections could not be lifted; the message gives the reasons.
            NotRunningError: The instance has stopped.
        """
        from shmio.local.injection import lift_all  # noqa: PLC0415
        from shmio.model.injection import Lifted  # noqa: PLC0415

        self._segment.require_running()
        blocks = [self.block(source) for source in dict.fromkeys(sources) or self._blocks()]
        present = [(block, one) for block in blocks for one in block.injections.read() if not one.lifted]
        lift_all([(self._source_writer(block), one.number) for block, one in present])
        return [Lifted(block.source, one.number, one.name) for block, one in present]

    def note(self, text: str, source: str | None = None) -> None:
        """Add a note to a source's events. Recordings contain it, too.

        The attachment must be ``writable``.

        Args:
            text: The note, 1 to 256 bytes in UTF-8.
            source: Name of the source; None: the instance's first source.

        Raises:
            PathError: There is no such source.
            ValueRangeError: The note is empty or too long.
            CommandError: The source's process does not answer.
        """
        self._source_writer(self.block(source if source is not None else self.sources[0])).note(text)

    @property
    def clock(self) -> Clock:
        """State of the instance's clock: wall time, or virtual time with its last step.

        Calling the attribute (``clock()``) returns the same state, as for any :class:`shmio.Cell`.
        """
        return self._segment.clock.read()

    def step(self, dt_s: float | None = None, count: int = 1) -> Clock:
        """Step time, and wait after each step until all sources on the instance clock have done it.

        The first call of this method, :meth:`pause` or :meth:`play` takes control of time: from
        then on, only steps move time. This program owns time until it calls :meth:`release` or
        detaches. The attachment must be ``writable``.

        Args:
            dt_s: Length of each step in s, from 1 us to 1 h; None: the step size.
            count: Number of steps.

        Returns:
            The state of the clock after the last step.

        Raises:
            TimeError: Another program owns time, or a step failed. The message names the source
                that failed or did not answer.
            ValueRangeError: The length is not between 1 us and 1 h, or the count is below 1.
        """
        dt_ns = _ns(dt_s)
        if count < 1:
            raise ValueRangeError(f"the number of steps must be at least 1, not {count}")
        self._time.step(dt_ns, count)
        return self.clock

    def play(self, rate: float = 1.0, dt_s: float | None = None) -> Clock:
        """Step time continuously, in a thread, until :meth:`pause`; return the state of the clock.

        Args:
            rate: Speed relative to real time; above 0, at most 1000.
            dt_s: Length of a step in s; None: the step size.

        Raises:
            TimeError: Another program owns time.
            ValueRangeError: The rate or the length is out of range.
        """
        self._time.play(rate, _ns(dt_s))
        return self.clock

    def pause(self) -> Clock:
        """Stop time until the next :meth:`step` or :meth:`play`, and return the state of the clock.

        Raises:
            TimeError: Another program owns time, or a step failed while time was played.
        """
        self._time.pause()
        return self.clock

    def release(self) -> Clock:
        """Return to real time. The clock continues from the present virtual time.

        This program then no longer owns time. If time is real already, nothing happens.

        Returns:
            The state of the clock.

        Raises:
            TimeError: Another program owns time, time was virtual from the instance's start, or a
                step failed while time was played.
        """
        self._time.release()
        return self.clock

    def save_snapshot(self, name: str, *, partial: bool = False) -> SnapshotInfo:
        """Save the state of the instance, whose time must be virtual: see :class:`shmio.Cell`.

        The attachment must be ``writable``.

        Raises:
            SnapshotError: The state of a process cannot be saved, or the file cannot be written.
            TimeError: Time is real, or another program owns it.
        """
        return self._snapshots.save(name, partial=partial)

    def restore_snapshot(self, name: str) -> SnapshotInfo:
        """Restore a snapshot, which may set time back: see :class:`shmio.Cell`.

        The attachment must be ``writable``.

        Raises:
            SnapshotError: There is no such snapshot, or it does not fit the instance, and nothing
                was changed; or a process could not restore its state, and its data are bad.
            TimeError: Time is real, or another program owns it.
        """
        return self._snapshots.restore(name)

    def snapshots(self) -> list[SnapshotInfo]:
        """Return the instance's snapshots, the oldest first.

        Raises:
            SnapshotError: The folder of the snapshots cannot be read.
        """
        return self._snapshots.all()

    def delete_snapshot(self, name: str) -> None:
        """Delete a snapshot.

        Raises:
            SnapshotError: There is no such snapshot, or it cannot be deleted.
        """
        self._snapshots.delete(name)

    def _source_writer(self, block: Block) -> SourceWriter:
        """Return the writer for a block.

        The first call takes an external slot for this attachment, until it is closed.
        """
        from shmio.local.writer import SourceWriter  # noqa: PLC0415

        if not self._segment.shared.writable:
            raise CommandError("this attachment only reads; attach with writable=True")
        with self._lock:
            if self._slot is None:
                self._slot = _take_external_slot(self._segment)
            known = self._source_writers.get(block.source)
            if known is None or known.block is not block:
                known = self._source_writers[block.source] = SourceWriter(block, self._slot)
            return known

    def _end_with_this(self, following: Following[Any]) -> None:
        """Register an iterator that :meth:`close` must end.

        If another thread has just closed this attachment, end the iterator now.
        """
        with self._lock:
            detached = self._detached
            self._open.add(following)
        if detached:
            following.end()

    def close(self) -> None:
        """Detach from the instance, and give up the ownership of time.

        Raises:
            TimeError: A step has failed while this program played time.
        """
        with self._lock:
            self._detached = True
            following = list(self._open)
        for one in following:
            one.end()
        try:
            if self._timekeeper is not None:
                self._timekeeper.close()
        finally:
            self._segment.close()

    def __enter__(self) -> Attachment:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def attach(instance: str | None = None, *, writable: bool = False) -> Attachment:
    """Attach to a running instance on this host.

    Args:
        instance: Name of the instance; None if only one is running.
        writable: Whether to allow writing, injecting and stepping. Only the user who runs the
            instance may do this.

    Raises:
        NotRunningError: The instance is not running; or ``instance`` is None, and not exactly one
            instance is running.
        FormatError: Another version of shmio made the segment.
        SegmentError: The segment cannot be opened, for example because you have no permission.
    """
    if instance is None:
        running = running_instances()
        if not running:
            raise NotRunningError("no instance is running; start one with shmio-supervisor up")
        if len(running) > 1:
            raise NotRunningError(f"several instances are running; name one of them: {', '.join(running)}")
        instance = running[0]
    return Attachment(Segment.open(instance, writable=writable))


def _take_external_slot(segment: Segment) -> int:
    """Take a free external slot of the process table for as long as the segment is open.

    Returns:
        The number of the slot's command queue.

    Raises:
        SegmentError: No slot is free.
    """
    places = segment.processes.external
    for slot in places:
        if slot.writer is not None and slot.take():
            slot.report = Report(os.getpid(), Activity.RUNNING, time.monotonic_ns(), (os.getuid(),), program_name())
            return slot.writer
    pids = ", ".join(str(slot.report.pid) for slot in places)
    raise SegmentError(
        f"instance {segment.instance!r} allows only {len(places)} programs that write; end one of pids {pids}"
    )


def _of_one_source(
    what: str, paths: Collection[str], blocks: Mapping[str, Block], *, written: bool = False
) -> tuple[Block, list[Topic]]:
    """Resolve paths that must all belong to one source.

    Args:
        what: Purpose of the paths for messages, such as "write".
        paths: The paths.
        blocks: The instance's blocks, by source.
        written: Whether the caller writes to the paths. If so, no path may end in ``/out``.

    Returns:
        The source's block, and a topic for each path.

    Raises:
        PathError: The paths are not of exactly one source, or ``written`` is set and a path is an
            output.
    """
    default = next(iter(blocks)) if len(blocks) == 1 else None
    topics = [parse_topic(path, blocks, default) for path in paths]
    for path, topic in zip(paths, topics, strict=True):
        if topic.source not in blocks:
            raise PathError(f"{path}: {unknown('source', topic.source, blocks)}")
    sources = {topic.source for topic in topics}
    if len(sources) != 1:
        raise PathError(
            f"all paths of one {what} must belong to the same source, but these belong to "
            f"{', '.join(sorted(sources)) or 'none'}"
        )
    for path, topic in zip(paths, topics, strict=True):
        if written and topic.direction == "out":
            raise PathError(f"{path}: an output of a source cannot be written; leave out /out")
    return blocks[sources.pop()], topics


def _with_source(source: str, one: InjectionEntry) -> Injection[Mapping[str, Any]]:
    """Convert an injection of the segment to the form for programs, which names the source."""
    from shmio.model.injection import Injection, Running  # noqa: PLC0415

    now, running = one.running, None
    if now is not None:
        declaration = msgspec.to_builtins(now.declaration)
        running = Running(declaration, now.state, now.seed, now.runs, now.cycle, now.time_ns)
    return Injection(
        one.number, one.direction, one.priority, one.keep, one.name, one.writer, one.pid, one.ranges, running, source,
        one.cell,
    )  # fmt: skip


def _ns(dt_s: float | None) -> int | None:
    """Convert the length of a step to ns; raise ValueRangeError if it is out of range."""
    if dt_s is None:
        return None
    check_step(dt_s * 1e9)  # before rounding, which fails for infinity
    return round(dt_s * 1e9)
