"""Copies what the sources of an instance publish into one recording."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Final, NamedTuple

from shmio import __version__
from shmio.dump.encoding import Gap, Place, Reason, StepMark
from shmio.recording.attach import Attachment, Attachments, no_attachments
from shmio.recording.follower import Entry, Follower
from shmio.recording.output import Output
from shmio.recording.writer import JSON, Channels, Writer
from shmio.segment import Frame, Segment
from shmio.segment.clock import ClockState
from shmio.segment.events import EVENT_SIZE

TURN_S: Final = 0.1
LIVELY: Final = 256
"""Entries of one block in one turn from which on the next turn comes sooner: many commands turn an event ring fast."""
CHUNK_S: Final = 0.8
"""A chunk is no longer than this: with a turn, and the time to write it, less than the second that a kill may cost."""
BATCH_BYTES: Final = 2 << 20
"""About as much of one block in one turn; what is left comes in the next, at once."""
CLOSE_S: Final = 3.0
CHECK_S: Final = 1.0


@dataclass(slots=True)
class Counters:
    """What came of it so far. ``missed``: frames and events."""

    frames: int = 0
    events: int = 0
    missed: int = 0


class Start(NamedTuple):
    """Where to begin: behind these places, by section; blocks without one at their first frame, or at the present."""

    places: Mapping[int, Place] = {}
    first: bool = True
    reason: Reason = Reason.NOT_RUNNING
    """Why something may be missing at the beginning."""
    about: Mapping[str, str] = {}
    """What else is to be told of this recording."""
    counters: Counters | None = None
    """What came of the recordings before, if it goes on from there."""


@dataclass(slots=True)
class _Lost:
    """What could not be taken because there was no room: numbers from, to."""

    first: int
    last: int
    after_ns: int


@dataclass(slots=True)
class _Followed:
    follower: Follower
    channels: Channels | None = None
    lost: dict[str, _Lost] = field(default_factory=dict)
    log_ns: int = 0

    @property
    def batch(self) -> int:
        """Entries to take in one turn."""
        return max(16, BATCH_BYTES // (self.follower.block.layout.size + EVENT_SIZE))


class Recorder:
    """One recording of the blocks of a segment. Use from one thread: :meth:`turn` again and again, then :meth:`close`.

    Blocks that a reload adds or puts in the place of others are followed too.
    """

    def __init__(
        self,
        segment: Segment,
        output: Output,
        *,
        by: str,
        start: Start | None = None,
        sources: Collection[str] | None = None,
        attachments: Attachments = no_attachments,
    ) -> None:
        """``by``: who records. ``start``: default from the first frame. ``sources``: only these."""
        self.output = output
        start = start or Start()
        self.counters = start.counters or Counters()
        self.confirmed: Mapping[int, Place] = start.places
        """Where the recording had come to, by section, when what was written last that is on the disk for certain."""
        self._segment = segment
        self._sources = sources
        self._attachments = attachments
        self._writer = Writer(output, {**self._about(by), **start.about})
        self._followed: list[_Followed] = []
        self._blocks = 0
        self._seen: set[int] = set()
        """Sections whose blocks are followed, were, or need not be."""
        self._attached: set[bytes] = set()
        self._attach(attachments(None, 0))
        self._places = dict(start.places)
        self._to_confirm: tuple[int, dict[int, Place]] | None = None
        self._writer.places(start.places)
        self._follow(start)
        self.done = 0
        """The last step of virtual time of which all is recorded, or lost for want of room."""
        self._lively = False
        self._flushed_s = self._checked_s = time.monotonic()

    def _about(self, by: str) -> dict[str, str]:
        head = self._segment.header
        return {
            "instance": self._segment.instance,
            "epoch": f"{head.epoch:016x}",
            "mode": head.mode,
            "started_utc_ns": str(head.started_utc_ns),
            "started_ns": str(head.started_ns),
            "instance_version": head.version,
            "version": __version__,
            "host": socket.gethostname(),
            "recorder": by,
            "recorder_pid": str(os.getpid()),
            "recording_utc_ns": str(time.time_ns()),
            "recording_ns": str(self.log_time(time.monotonic_ns())),
        }

    def log_time(self, monotonic_ns: int) -> int:
        """Time in the recording, UTC by the instance's start: it goes on evenly whatever is done to the wall clock."""
        head = self._segment.header
        return max(0, head.started_utc_ns + monotonic_ns - head.started_ns)

    def turn(self) -> bool:
        """Take what has been published; whether there is more at once. RecordingError: the file was removed."""
        state = self._segment.clock.read()  # before looking: what was published for the step that is done is there
        self._segment.refresh()
        if self._segment.blocks is not self._known:
            self._follow(Start())
        taken = [list(followed.follower.take(followed.batch)) for followed in self._followed]
        more = any(len(some) >= followed.batch for some, followed in zip(taken, self._followed, strict=True))
        self._lively = any(len(some) > LIVELY for some in taken)
        entries = list(chain.from_iterable(taken))
        entries.sort(key=lambda entry: entry.log_ns)  # stable: a block's own order stays
        full = self.output.full
        by_follower = {id(followed.follower): followed for followed in self._followed}
        for entry in entries:
            followed = by_follower[id(entry.follower)]
            if full:
                self._lose(followed, entry)
            else:
                self._write(followed, entry)
        for followed in [followed for followed in self._followed if self._ended(followed)]:
            self._places[followed.follower.block.section] = followed.follower.place
            self._followed.remove(followed)
        if state.virtual and state.done > self.done and not more:
            self._end_step(state, full=full)
        now_s = time.monotonic()
        if now_s - self._flushed_s >= CHUNK_S - TURN_S / 2:
            self._flushed_s = now_s
            self._writer.flush()
            self._confirm()
        if now_s - self._checked_s >= CHECK_S:
            self._checked_s = now_s
            self.output.check()
        return more

    def _end_step(self, state: ClockState, *, full: bool) -> None:
        """All of this step, and of those before it, has been taken."""
        self.done = state.done
        if state.done == state.step and state.dt_ns and not full:  # or else nobody tells how far that one went
            mark = StepMark(state.step, state.time_ns, state.dt_ns)
            self._writer.step(mark, self.log_time(self._segment.clock.monotonic_ns(state.time_ns)))

    def _confirm(self) -> None:
        """See what the disk has for certain; what was written by now is the next that it is to have."""
        if self._to_confirm and self.output.synced >= self._to_confirm[0]:
            self.confirmed, self._to_confirm = self._to_confirm[1], None
        if not self._to_confirm and not any(followed.lost for followed in self._followed):
            self._places |= {followed.follower.block.section: followed.follower.place for followed in self._followed}
            self._to_confirm = self.output.tell(), dict(self._places)

    @property
    def pause_s(self) -> float:
        """How long to wait between two turns: far less than any ring holds."""
        rings = [followed.follower.block.ring for followed in self._followed]
        return min(
            [TURN_S / 10 if self._lively else TURN_S, *(ring.slot_count * ring.period_ns / 8e9 for ring in rings)]
        )

    @property
    def problem(self) -> str:
        """What is wrong at present, in words; empty: nothing."""
        problem = self.output.problem
        lost = sum(lost.last - lost.first + 1 for followed in self._followed for lost in followed.lost.values())
        return f"{problem}; {lost} frames and events lost so far" if problem and lost else problem

    def close(self, patience_s: float = CLOSE_S) -> bool:
        """Take what is there, write it, close the file; False if the disk did not take all of it in this time."""
        while self.turn():
            pass
        for followed in self._followed:
            self._write_rest(followed)
        self._writer.finish()
        return self.output.close(patience_s)

    # ---- blocks ------------------------------------------------------------------------------------------------------

    def _follow(self, start: Start) -> None:
        """Follow what is not followed yet: blocks that a reload has ended, too, unless all they have is recorded."""
        self._known = self._segment.blocks
        ended = self._segment.ended
        for block in (*ended, *self._known.values()):
            if block.section in self._seen or (self._sources is not None and block.source not in self._sources):
                continue
            self._seen.add(block.section)
            place = start.places.get(block.section)
            reason = start.reason if place or start.first else Reason.OVERTAKEN
            if place is None:
                place = Place() if start.first else Place(block.ring.head(), block.events.head())
            over = block in ended
            if over and (place.frame, place.event) == (block.ring.head(), block.events.head()):
                continue
            self._blocks += 1
            follower = Follower(block, self._blocks, place, reason, self.log_time)
            self._followed.append(_Followed(follower, log_ns=place.log_ns))
            if block.layout.hash not in self._attached:
                self._attached.add(block.layout.hash)
                name = f"layouts/{block.layout.hash.hex()}.json"
                self._attach([Attachment(name, JSON, block.layout.to_json())])
            if not over:  # the files on the disk are of its successor
                self._attach(self._attachments(block.source, self._blocks))

    def _attach(self, attachments: list[Attachment]) -> None:
        now_ns = self.log_time(time.monotonic_ns())
        for name, media_type, data, changed_ns in attachments:
            self._writer.attach(name, media_type, data, now_ns, changed_ns)

    def _ended(self, followed: _Followed) -> bool:
        if not followed.follower.done:
            return False
        if not self.output.full:
            self._write_rest(followed)
        return not followed.lost

    # ---- entries -----------------------------------------------------------------------------------------------------

    def _write(self, followed: _Followed, entry: Entry) -> None:
        log_ns, follower, item = entry
        self._tell_lost(followed, log_ns)
        followed.log_ns = log_ns
        if isinstance(item, Gap):
            self.counters.missed += item.count
            self._writer.gap(item, log_ns)
            return
        if followed.channels is None:
            after_frame, after_event, _ = follower.begin
            followed.channels = self._writer.open_block(follower.block, follower.number, after_frame, after_event)
        if isinstance(item, Frame):
            self.counters.frames += 1
            self._writer.frame(followed.channels, item, log_ns)
        else:
            self.counters.events += 1
            self._writer.event(followed.channels, item, log_ns)

    def _lose(self, followed: _Followed, entry: Entry) -> None:
        item = entry.item
        if isinstance(item, Gap):
            what, first, last = item.what, item.first, item.last
        else:
            what, first, last = "frames" if isinstance(item, Frame) else "events", item.number, item.number
        self.counters.missed += last - first + 1
        lost = followed.lost.setdefault(what, _Lost(first, last, followed.log_ns))
        lost.last = last

    def _tell_lost(self, followed: _Followed, before_ns: int) -> None:
        """Put down what there was no room for, before what follows it."""
        follower = followed.follower
        for what, lost in followed.lost.items():
            count = lost.last - lost.first + 1
            gap = Gap(
                follower.block.source, follower.number, what, lost.first, lost.last, count, Reason.NO_ROOM,
                lost.after_ns, before_ns,
            )  # fmt: skip
            self._writer.gap(gap, before_ns or self.log_time(time.monotonic_ns()))
        followed.lost.clear()

    def _write_rest(self, followed: _Followed) -> None:
        """What was missed at the very end."""
        self._tell_lost(followed, 0)
        for entry in followed.follower.rest():
            self._write(followed, entry)
