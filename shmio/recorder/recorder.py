"""Record to one file what an instance publishes."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from shmio.recorder.attached_files import AttachedFile, AttachedFiles, no_attachments
from shmio.recorder.block_follower import BlockEntry, BlockFollower, InstanceEntry
from shmio.recorder.instance_follower import TURN_S, InstanceFollower
from shmio.recorder.output import Output
from shmio.recording.format.encoding import BlockPosition, Gap, ProcessChange, Reason
from shmio.recording.writer import JSON, Channels, Writer
from shmio.segment import Event, Frame
from shmio.version import __version__


@dataclass(slots=True)
class _LostRange:
    """Numbers of frames or events that were lost for want of room."""

    first: int
    last: int
    after_ns: int

    @property
    def count(self) -> int:
        return self.last - self.first + 1


@dataclass(slots=True)
class RecordedBlock:
    """A block in one file: where it begins there, and the last frame and event written, or in a gap."""

    follower: BlockFollower
    begin: BlockPosition
    frame: int
    event: int
    log_ns: int
    channels: Channels | None = None
    lost: dict[str, _LostRange] = field(default_factory=dict)
    """Lost frames and events, not yet recorded as gaps."""

    @property
    def place(self) -> BlockPosition:
        """The position behind the last written entry."""
        return BlockPosition(self.frame, self.event, self.log_ns)

    @property
    def losses(self) -> int:
        """Number of lost frames and events that are not yet recorded as gaps."""
        return sum(lost.count for lost in self.lost.values())

    def come_to(self, what: str, number: int, log_ns: int) -> None:
        """Note that frames or events up to this number were written, or are in a written gap."""
        self.log_ns = log_ns
        if what == "frames":
            self.frame = number
        else:
            self.event = number

    def lose(self, item: Frame | Event | Gap) -> int:
        """Note that there is no room for an item; returns how many frames or events are lost."""
        if isinstance(item, Gap):
            what, first, last = item.what, item.first, item.last
        else:
            what, first, last = "frames" if isinstance(item, Frame) else "events", item.number, item.number
        lost = self.lost.setdefault(what, _LostRange(first, last, self.log_ns))
        lost.last = last
        return last - first + 1

    def found(self, before_ns: int) -> list[Gap]:
        """Return the lost entries as gaps, and forget them."""
        block = self.follower.block
        lost, self.lost = self.lost, {}
        return [
            Gap(
                block.source, self.follower.number, what, one.first, one.last, one.count, Reason.NO_ROOM,
                one.after_ns, before_ns,
            )
            for what, one in lost.items()
        ]  # fmt: skip


CHUNK_S: Final = 0.8
"""Maximum duration of a chunk. With a turn and the time to write it, a kill costs less than a second."""
CLOSE_S: Final = 3.0
CHECK_S: Final = 1.0
CONFIG_S: Final = 5.0
"""How often to check whether the configuration has changed."""


@dataclass(slots=True)
class Counters:
    """Numbers of recorded frames and events, and of missed ones."""

    frames: int = 0
    events: int = 0
    missed: int = 0


class Recorder:
    """Records to one file. From one thread, call :meth:`turn` repeatedly, then :meth:`close`."""

    def __init__(
        self,
        tap: InstanceFollower,
        output: Output,
        *,
        by: str,
        places: Mapping[int, BlockPosition] | None = None,
        about: Mapping[str, str] | None = None,
        counters: Counters | None = None,
        attachments: AttachedFiles = no_attachments,
    ) -> None:
        """Start a file.

        Args:
            tap: Follows the instance.
            output: The file.
            by: Kind of recorder.
            places: Positions by section where the previous file ended; None: where ``tap`` started.
            about: Further metadata about the recording.
            counters: Counters to continue; None: new ones.
            attachments: Returns the files to attach.
        """
        self.tap = tap
        self.output = output
        self.counters = counters or Counters()
        self.places = dict(tap.start.places if places is None else places)
        """Positions of the recording by section, as of the last :meth:`settle`."""
        self.confirmed: Mapping[int, BlockPosition] = dict(self.places)
        """Positions of the recording by section up to which it is certainly on the disk."""
        self._ended = False
        self.empty = True
        """Whether nothing was recorded yet except changes of processes."""
        self._attachments = attachments
        self._writer = Writer(output, {**self._about(by), **(about or {})})
        self._followed: dict[int, RecordedBlock] = {}
        self._attached: set[bytes] = set()
        self._config = attachments(None, 0)
        self._attach(self._config)
        self._unaware = True
        """Whether the file does not have the state of the processes yet."""
        self._to_confirm: tuple[int, dict[int, BlockPosition]] | None = None
        self._writer.places(self.places)
        for follower in tap.followers:
            self._known(follower)
        self._flushed_s = self._checked_s = self._looked_s = time.monotonic()

    def _about(self, by: str) -> dict[str, str]:
        segment = self.tap.segment
        head = segment.header
        return {
            "instance": segment.instance,
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
            "recording_ns": str(self.tap.log_time(time.monotonic_ns())),
        }

    def turn(self) -> bool:
        """Record what has been published; returns whether there is more. RecordingError: the file was removed."""
        entries, more = self.tap.take()
        self.put(entries)
        return more

    def put(self, entries: Iterable[BlockEntry | InstanceEntry]) -> None:
        """Record entries, and end the chunk if it is due. RecordingError: the file was removed."""
        for follower in self.tap.followers:
            self._known(follower)
        full = self.output.full
        if self._unaware and not full:
            self._unaware = False
            entries = [*(entry for entry in entries if not is_process_change(entry)), *self.tap.standing()]
        for entry in entries:
            if full:
                self._lose(entry)
            else:
                self._write(entry)
        if not full:
            for followed in self._followed.values():
                if followed.lost and followed.follower.done:  # no later entry would trigger the gap
                    self._tell_lost(followed, 0)
        now_s = time.monotonic()
        if now_s - self._flushed_s >= CHUNK_S - TURN_S / 2:
            self._flushed_s = now_s
            self._writer.flush()
            self._confirm()
        if now_s - self._checked_s >= CHECK_S:
            self._checked_s = now_s
            self.output.check()
        if now_s - self._looked_s >= CONFIG_S:
            self._looked_s = now_s
            self._look()

    def _confirm(self) -> None:
        """Update :attr:`confirmed` from the synced bytes, and note the present position as the next one."""
        if self._to_confirm and self.output.synced >= self._to_confirm[0]:
            self.confirmed, self._to_confirm = self._to_confirm[1], None
        if not self._to_confirm and not self.losing:
            self.settle()
            self._to_confirm = self.output.tell(), dict(self.places)

    def settle(self) -> None:
        """Bring :attr:`places` up to date."""
        self.places |= {section: followed.place for section, followed in self._followed.items()}

    @property
    def losing(self) -> bool:
        """Whether entries were lost for want of room, and are not yet recorded as gaps."""
        return any(followed.lost for followed in self._followed.values())

    @property
    def problem(self) -> str:
        """Description of the present problem; empty: none."""
        problem = self.output.problem
        lost = sum(followed.losses for followed in self._followed.values())
        return f"{problem}; {lost} frames and events lost so far" if problem and lost else problem

    def end(self) -> None:
        """Write index and footer, without waiting for the disk. Further calls do nothing."""
        if self._ended:
            return
        self._ended = True
        for followed in self._followed.values():
            self._tell_lost(followed, 0)
        self.settle()
        self._writer.finish()
        self.output.end()

    def close(self, patience_s: float = CLOSE_S) -> bool:
        """Record what is there, and close the file; returns False if the disk was too slow."""
        while self.turn():
            pass
        self.put(self.tap.rest())
        self.end()
        return self.output.close(patience_s)

    # ---- blocks ------------------------------------------------------------------------------------------------------

    def _known(self, follower: BlockFollower) -> RecordedBlock:
        return self._followed.get(follower.block.section) or self._follow(follower)

    def _follow(self, follower: BlockFollower) -> RecordedBlock:
        """Start with a block: attach the files that are needed to read it."""
        block = follower.block
        place = self.places.get(block.section, follower.begin)
        followed = self._followed[block.section] = RecordedBlock(follower, place, *place)
        layout = follower.part.layout
        if layout.hash not in self._attached:
            self._attached.add(layout.hash)
            self._attach([AttachedFile(f"layouts/{layout.hash.hex()}.json", JSON, layout.to_json())])
        if not follower.over:  # the files on disk belong to the block's successor
            self._attach(self._attachments(block.source, follower.number))
        return followed

    def _look(self) -> None:
        """Attach the configuration again if it has changed."""
        now = self._attachments(None, 0)
        if now and [(one.name, one.data) for one in now] != [(one.name, one.data) for one in self._config]:
            self._config = now
            self._attach(now)

    def _attach(self, attachments: list[AttachedFile]) -> None:
        for name, media_type, data, changed_ns in attachments:
            self._writer.attach(name, media_type, data, self.tap.now(), changed_ns)

    # ---- entries -----------------------------------------------------------------------------------------------------

    def _write(self, entry: BlockEntry | InstanceEntry) -> None:
        self.empty = self.empty and is_process_change(entry)
        if isinstance(entry, InstanceEntry):
            self._aside(entry)
            return
        log_ns, follower, item = entry
        followed = self._known(follower)
        self._tell_lost(followed, log_ns)
        if isinstance(item, Gap):
            self.counters.missed += item.count
            self._writer.gap(item, log_ns)
            followed.come_to(item.what, item.last, log_ns)
            return
        if followed.channels is None:
            after = followed.begin
            followed.channels = self._writer.open_block(
                follower.block, follower.number, after.frame, after.event, follower.part.layout
            )
        if isinstance(item, Frame):
            self.counters.frames += 1
            self._writer.frame(followed.channels, follower.part.keep(item), log_ns)
            followed.come_to("frames", item.number, log_ns)
        else:
            self.counters.events += 1
            self._writer.event(followed.channels, item, log_ns)
            followed.come_to("events", item.number, log_ns)

    def _aside(self, aside: InstanceEntry) -> None:
        if isinstance(aside.item, ProcessChange):
            self._writer.process(aside.item, aside.log_ns)
        else:
            self._writer.step(aside.item, aside.log_ns)

    def _lose(self, entry: BlockEntry | InstanceEntry) -> None:
        if isinstance(entry, InstanceEntry):
            self._unaware |= is_process_change(entry)
        else:
            self.counters.missed += self._known(entry.follower).lose(entry.item)

    def _tell_lost(self, followed: RecordedBlock, before_ns: int) -> None:
        """Record lost entries as gaps, before the entry that follows them."""
        for gap in followed.found(before_ns):
            log_ns = before_ns or self.tap.now()
            self._writer.gap(gap, log_ns)
            followed.come_to(gap.what, gap.last, log_ns)


def is_process_change(entry: BlockEntry | InstanceEntry) -> bool:
    """Whether an entry is a change of a process."""
    return isinstance(entry.item, ProcessChange)
