"""An instance on this host, accessed through its shared memory."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Final

from shmio.cli.cell import CampaignEvent, Change, Selected
from shmio.cli.readings import choose
from shmio.config import Declaration
from shmio.errors import CommandError, NotRunningError, PathError
from shmio.layout.model import Layout, Register
from shmio.local.attach import Attachment
from shmio.local.injection import Shadow
from shmio.local.reading import Reading, reading
from shmio.local.replays import ReplayRequest
from shmio.model.clock import Clock
from shmio.model.outcome import Outcome
from shmio.model.replay_status import Playing
from shmio.segment import Block, Cursor, Event, EventKind, Frame, Quality
from shmio.segment.standing_injections import StandingInjection

IDLE_S: Final = 0.5
WAITING_FRAMES: Final = 64
"""Frames whose changes may wait for a slow terminal; a block further behind skips to its newest."""

_TOLD: Final = frozenset({EventKind.INJECTED, EventKind.ACTIVATED, EventKind.DEACTIVATED, EventKind.LIFTED})

_Changes = list[tuple[Block, Register, Reading]]


class Local:
    """An attachment as a :class:`shmio.cli.cell.Cell`."""

    def __init__(self, attachment: Attachment) -> None:
        self.attachment = attachment

    @property
    def sources(self) -> list[str]:
        """Names of the sources."""
        return self.attachment.sources

    def layout(self, source: str) -> Layout:
        """Return the layout of a source; PathError if there is no such source."""
        return self.attachment.block(source).layout

    def readings(self, patterns: Sequence[str], chosen: Sequence[Selected]) -> list[Reading]:  # noqa: ARG002
        """Return the present readings of ``chosen``; those of one source come from one frame.

        NotRunningError: the instance has stopped.
        """
        self._check_running()
        blocks = {source: self.attachment.block(source) for source in {one.source for one in chosen}}
        frames = {source: block.latest() for source, block in blocks.items()}
        return [reading(blocks[one.source], one.register, frames[one.source]) for one in chosen]

    def news(self, patterns: Sequence[str]) -> Iterator[Change]:
        """Yield the changes of all blocks; a thread waits on each block.

        NotRunningError: the instance has stopped, or a reload has removed a source or a register.
        """
        news: queue.Queue[_Changes] = queue.Queue(WAITING_FRAMES)
        followed: set[int] = set()
        chosen = choose(self, patterns)
        width = self._follow_new(chosen, followed, news)
        while True:
            try:
                batch = news.get(timeout=IDLE_S)
            except queue.Empty:
                self._check_running()
                continue
            if not batch:  # a reload has ended a block
                self._check_running()
                chosen = self._choose_again(patterns, {one.source for one in chosen})
                width = self._follow_new(chosen, followed, news)
            yield from (Change(Selected(block.source, register), now, width) for block, register, now in batch)

    def _check_running(self) -> None:
        if not self.attachment.current:
            raise NotRunningError(f"instance {self.attachment.instance!r} has stopped")

    def _choose_again(self, patterns: Sequence[str], sources: set[str]) -> list[Selected]:
        """Return what the patterns name after a reload; NotRunningError if that is nothing.

        ``sources`` are those of what they named before.
        """
        try:
            return choose(self, patterns)
        except PathError as error:
            if gone := sorted(sources.difference(self.sources)):
                named = f"source {gone[0]!r} was" if len(gone) == 1 else f"sources {', '.join(gone)} were"
                raise NotRunningError(
                    f"{named} removed from instance {self.attachment.instance!r} by a reload"
                ) from None
            raise NotRunningError(f"{error}: a reload has taken it away") from None

    def _follow_new(self, chosen: Sequence[Selected], followed: set[int], news: queue.Queue[_Changes]) -> int:
        """Start a thread for each block that none follows yet; return the longest path's length."""
        registers: dict[int, tuple[Block, list[Register]]] = {}
        for one in chosen:
            block = self.attachment.block(one.source)
            if block.section not in followed:
                registers.setdefault(block.section, (block, []))[1].append(one.register)
        followed.update(registers)
        for block, wanted in registers.values():
            threading.Thread(target=_follow, args=(block, wanted, news), daemon=True).start()
        return max(len(one.path) for one in chosen)

    def write(self, values: Mapping[str, object], timeout_s: float | None) -> list[Outcome]:
        """Write registers of one source as one command."""
        return self.attachment.write(values, timeout_s)

    def inject(self, *paths: str, priority: int, keep: bool, name: str) -> Shadow:
        """Start an injection for the duration of a ``with`` block, or permanently with ``keep``."""
        return self.attachment.inject(*paths, priority=priority, keep=keep, name=name)

    def declare(self, declarations: Sequence[Declaration], *, keep: bool) -> LocalCampaign:
        """Start all declared injections or none, for a ``with`` block or permanently."""
        return LocalCampaign(self.attachment, declarations, keep=keep)

    def injections(self) -> dict[str, tuple[StandingInjection, ...]]:
        """Return the present injections by source, innermost first."""
        return self.attachment.injections()

    def lift(self, source: str, number: int) -> None:
        """Remove an injection."""
        self.attachment.lift(source, number)

    def lift_all(self) -> list[tuple[str, StandingInjection]]:
        """Remove all injections, and return them with their sources."""
        return self.attachment.lift_all()

    @property
    def clock(self) -> Clock:
        """The state of the instance's clock."""
        return self.attachment.clock

    def real_sources(self) -> list[str]:
        """Return the names of the sources with a device, which steps do not affect."""
        blocks = map(self.attachment.block, self.attachment.sources)
        return [block.source for block in blocks if not block.attributes.stepped]

    def step(self, dt_s: float | None, count: int) -> None:
        """Advance the clock by ``count`` steps of ``dt_s`` each."""
        for _ in range(count):
            self.attachment.step(dt_s)

    def play(self, rate: float, dt_s: float | None) -> None:
        """Let the clock advance by itself at ``rate`` times real time."""
        self.attachment.play(rate, dt_s)

    def pause(self) -> None:
        """Stop the clock."""
        self.attachment.pause()

    def release(self) -> None:
        """Return the clock to real time."""
        self.attachment.release()

    def replay(self, wanted: ReplayRequest) -> list[Playing]:
        """Control the replayed sources if anything is requested, and return their states."""
        replay = self.attachment.replay
        return replay.status(wanted.sources) if wanted.nothing else replay.change(wanted)


class LocalCampaign:
    """A :class:`shmio.cli.cell.Campaign` whose injections start on construction."""

    def __init__(self, cell: Attachment, declarations: Sequence[Declaration], *, keep: bool) -> None:
        self._keep = keep
        self._cursors = {source: cell.block(source).events.cursor() for source in cell.sources}
        self._laid = {one.number: one for one in cell.declare(declarations, keep=keep)}

    @property
    def stands(self) -> bool:
        """Whether any injection remains."""
        return bool(self._laid)

    def news(self) -> list[CampaignEvent]:
        """Return the events since the last call."""
        return [happened for source, cursor in self._cursors.items() for happened in self._of(source, cursor)]

    def _of(self, source: str, cursor: Cursor[Event]) -> Iterator[CampaignEvent]:
        while (event := cursor.next(0)) is not None:
            if event.kind in _TOLD and event.injection in self._laid and event.offset == 0:  # of parts the first
                time_s, what = event.clock_ns / 1e9, str(EventKind(event.kind))
                yield CampaignEvent(time_s, event.cycle, source, event.injection, what, event.text)
                if event.kind == EventKind.LIFTED:
                    del self._laid[event.injection]

    def __enter__(self) -> LocalCampaign:
        return self

    def __exit__(self, *_: object) -> None:
        for one in () if self._keep else self._laid.values():
            with suppress(CommandError):  # it was over, or somebody else has lifted it
                one.lift()


def _follow(block: Block, registers: list[Register], news: queue.Queue[_Changes]) -> None:
    """Queue each register's reading, then every change; an empty list when the block ends."""
    shown: list[tuple[str, Quality, str] | None] = [None] * len(registers)
    cursor = block.cursor()
    frame: Frame | None = block.latest()
    while True:
        changes: _Changes = []
        for index, register in enumerate(registers):
            now = reading(block, register, frame)
            # A stale reason holds the age: its text changes, the fact does not.
            state = (repr(now.value), now.quality, now.reason.partition(":")[0])  # repr: a NaN equals itself
            if state != shown[index]:
                shown[index] = state
                changes.append((block, register, now))
        if changes:
            news.put(changes)
        if block.retired:
            news.put([])
            return
        if cursor.behind > WAITING_FRAMES:
            cursor = block.cursor(after=block.ring.head() - 1)
        frame = cursor.next(timeout_s=min(IDLE_S, block.stale_ns / 1e9)) or block.latest()
