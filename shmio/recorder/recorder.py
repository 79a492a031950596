"""Records an instance to one file, or to a sequence of files that each have a limited size and duration."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Final, NamedTuple, cast

from shmio.backoff import Backoff
from shmio.config import Recorder as Settings
from shmio.config import load
from shmio.config.masking import mask
from shmio.config.read import REMEDY, read_text
from shmio.errors import ConfigError, RecordingError
from shmio.recorder.file_output import Output, create
from shmio.recorder.instance_follower import (
    TURN_S,
    InstanceEntry,
    InstanceFollower,
    StartPositions,
)
from shmio.recording.block_follower import BlockEntry, BlockFollower
from shmio.recording.format.encoding import BlockPosition, Gap, ProcessChange, Reason
from shmio.recording.writer import JSON, TEXT, TOML, Channels, Writer, layout_files
from shmio.segment import Event, Frame
from shmio.version import __version__

MAX_FILE_BYTES: Final = 16 << 20
"""Largest size in bytes of a file that is attached to a recording."""
CHUNK_S: Final = 0.8
"""Longest duration of a chunk in s: a killed recorder loses less than a second."""
CLOSE_S: Final = 3.0
CHECK_S: Final = 1.0
"""Interval in s at which to check whether the file was removed."""
CONFIG_S: Final = 5.0
"""Interval in s at which to check whether the configuration has changed."""
RENEWAL: Final = Backoff(1.0, 600.0)
"""Waits between attempts to start a new file, while fsync fails again and again."""

log = logging.getLogger("shmio.recorder")


class AttachedFile(NamedTuple):
    """A file attached to a recording."""

    name: str
    media_type: str
    data: bytes
    changed_ns: int = 0


AttachedFiles = Callable[[str | None, int], list[AttachedFile]]
"""A function that returns the files to attach for a source, given by its name and the number of its block.

If the name is None, the function returns the files to attach for the instance.
"""


def no_attachments(_source: str | None, _block: int) -> list[AttachedFile]:
    """Return an empty list, for recordings without attached files."""
    return []


class ConfigFiles:
    """Reads the files that a configuration names.

    Files that cannot be read are skipped, and the reason is logged.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._logged: set[str] = set()

    def __call__(self, source: str | None, block: int) -> list[AttachedFile]:
        """Return the files of a source's layout.

        If ``source`` is None, return the configuration file without its secrets: recordings are shown to others.
        """
        if source is None:
            return [one._replace(data=_masked(one.data)) for one in self._read("config", [self._file], TOML)]
        try:
            files = _layout_files(self._file, read_text(self._file, REMEDY))
        except ConfigError as error:
            self._log_once(f"the layout files of source {source} are not attached to the recording: {error}")
            return []
        return self._read(f"sources/{source}/{block}", files.get(source, []), TEXT)

    def _read(self, folder: str, files: list[Path], media_type: str) -> list[AttachedFile]:
        found = []
        for file in files:
            try:
                with file.open("rb") as stream:
                    data = stream.read(MAX_FILE_BYTES + 1)
                changed_ns = file.stat().st_mtime_ns
            except OSError as error:
                self._log_once(f"{file} is not attached to the recording: {error.strerror}")
                continue
            if len(data) > MAX_FILE_BYTES:
                self._log_once(f"{file} is not attached to the recording: it is larger than {MAX_FILE_BYTES} bytes")
                continue
            found.append(AttachedFile(f"{folder}/{file.name}", media_type, data, max(0, changed_ns)))
        return found

    def _log_once(self, why: str) -> None:
        """Log a message, unless it was logged before: the files are read again and again."""
        if why not in self._logged:
            self._logged.add(why)
            log.warning("%s", why)


@lru_cache(1)  # each recording of a search asks for them
def _layout_files(file: Path, text: str) -> dict[str, list[Path]]:
    """Return the files of each source's layout, by source, from the text of a configuration.

    Raises:
        ConfigError: The configuration has faults.
    """
    config = load(file, text)
    found: dict[str, list[Path]] = {}
    for section in config.source:
        layout = section.layout or []
        names = [layout] if isinstance(layout, str) else layout
        found.setdefault(section.name, []).extend(map(config.path, names))
    return found


@lru_cache(1)  # the file is read again and again
def _masked(data: bytes) -> bytes:
    """Return the text of a configuration without its secrets."""
    return mask(data.decode(errors="surrogateescape")).text.encode(errors="surrogateescape")


@dataclass(slots=True)
class _LostRange:
    """A range of frames or events that were lost because the output was full."""

    first: int
    last: int
    after_ns: int

    @property
    def count(self) -> int:
        return self.last - self.first + 1


@dataclass(slots=True)
class RecordedBlock:
    """A block in one file, with the position at which it starts, and its last recorded frame and event.

    Frames and events in a recorded gap count as recorded.
    """

    follower: BlockFollower
    begin: BlockPosition
    frame: int
    event: int
    log_ns: int
    channels: Channels | None = None
    lost: dict[str, _LostRange] = field(default_factory=dict)
    """Lost frames and events that are not yet recorded as gaps."""

    @property
    def place(self) -> BlockPosition:
        """The position after the last recorded entry."""
        return BlockPosition(self.frame, self.event, self.log_ns)

    @property
    def losses(self) -> int:
        """Number of lost frames and events that are not yet recorded as gaps."""
        return sum(lost.count for lost in self.lost.values())

    def come_to(self, what: str, number: int, log_ns: int) -> None:
        """Remember that all frames or events (``what``) up to this number were recorded."""
        self.log_ns = log_ns
        if what == "frames":
            self.frame = number
        else:
            self.event = number

    def lose(self, item: Frame | Event | Gap) -> int:
        """Count an item as lost, and return how many frames or events it has: 1 if it is not a gap."""
        if isinstance(item, Gap):
            what, first, last = item.what, item.first, item.last
        else:
            what, first, last = "frames" if isinstance(item, Frame) else "events", item.number, item.number
        lost = self.lost.setdefault(what, _LostRange(first, last, self.log_ns))
        lost.last = last
        return last - first + 1

    def found(self, before_ns: int) -> list[Gap]:
        """Return gaps for the lost frames and events, and clear :attr:`lost`.

        ``before_ns`` is the log time of the entry after the gaps; 0 if no entry follows.
        """
        block = self.follower.block
        lost, self.lost = self.lost, {}
        return [
            Gap(
                block.source, self.follower.number, what, one.first, one.last, one.count, Reason.NO_ROOM,
                one.after_ns, before_ns,
            )
            for what, one in lost.items()
        ]  # fmt: skip


@dataclass(slots=True)
class Counters:
    """The numbers of recorded frames, of recorded events, and of missed frames and events together."""

    frames: int = 0
    events: int = 0
    missed: int = 0


class Recorder:
    """Records to one file. Call :meth:`run_once` again and again, then :meth:`close`, from one thread."""

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
            places: Positions at which the previous file ended, by section of the block; None for
                the positions at which ``tap`` started.
            about: More metadata about the recording.
            counters: Counters to continue; None for new ones.
            attachments: Returns the files to attach.
        """
        self.tap = tap
        self.output = output
        self.counters = counters or Counters()
        self.places = dict(tap.start.places if places is None else places)
        """Position after the last recorded entry of each block, by section.

        :meth:`settle` updates these positions.
        """
        self.confirmed: Mapping[int, BlockPosition] = dict(self.places)
        """Position of each block, by section, up to which an fsync has confirmed the recording."""
        self._ended = False
        self.empty = True
        """True if only process changes, or nothing, were recorded so far."""
        self._attachments = attachments
        self._writer = Writer(output, {**self._about(by), **(about or {})})
        self._followed: dict[int, RecordedBlock] = {}
        self._attached: set[bytes] = set()
        self._config = attachments(None, 0)
        self._attach(self._config)
        self._unaware = True
        """True if the next entries to record must include the present state of the processes."""
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

    def run_once(self) -> bool:
        """Record new entries, and return whether further entries are unread.

        Raises:
            RecordingError: The file was removed.
        """
        entries, more = self.tap.take()
        self.put(entries)
        return more

    def put(self, entries: Iterable[BlockEntry | InstanceEntry]) -> None:
        """Record entries, and end the chunk if it has lasted long enough.

        Raises:
            RecordingError: The file was removed.
        """
        for follower in self.tap.followers:
            self._known(follower)
        full = self.output.full
        if self._unaware and not full:
            self._unaware = False
            entries = [*(entry for entry in entries if not is_process_change(entry)), *self.tap.present()]
        if full:
            for entry in entries:
                self._lose(entry)
        else:
            for source, group in groupby(entries, frame_of):
                if source is None:
                    for entry in group:
                        self._write(entry)
                else:
                    self._write_frames(source, cast("Iterable[BlockEntry]", group))
            for followed in self._followed.values():
                if followed.lost and followed.follower.done:  # no later entry will record the gap
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
            self._attach_changed_files()

    def _confirm(self) -> None:
        """Copy the stored positions to :attr:`confirmed` if an fsync has covered their data.

        Then store the present positions, which will be confirmed next.
        """
        if self._to_confirm and self.output.synced >= self._to_confirm[0]:
            self.confirmed, self._to_confirm = self._to_confirm[1], None
        if not self._to_confirm and not self.losing:
            self.settle()
            self._to_confirm = self.output.tell(), dict(self.places)

    def settle(self) -> None:
        """Update :attr:`places` to the positions after the last recorded entries."""
        self.places |= {section: followed.place for section, followed in self._followed.items()}

    @property
    def losing(self) -> bool:
        """True if entries were lost that are not yet recorded as gaps."""
        return any(followed.lost for followed in self._followed.values())

    @property
    def problem(self) -> str:
        """The present problem of the file or its disk; empty if there is none."""
        problem = self.output.problem
        lost = sum(followed.losses for followed in self._followed.values())
        return f"{problem}; {lost} frames and events lost so far" if problem and lost else problem

    def end(self) -> None:
        """End the file with its index and footer, without waiting for the disk.

        Later calls do nothing.
        """
        if self._ended:
            return
        self._ended = True
        for followed in self._followed.values():
            self._tell_lost(followed, 0)
        self.settle()
        self._writer.finish()
        self.output.end()

    def close(self, patience_s: float = CLOSE_S) -> bool:
        """Record the remaining entries, and close the file.

        Return whether the file is safely on the disk.
        """
        while self.run_once():
            pass
        self.put(self.tap.remaining())
        self.end()
        return self.output.close(patience_s)

    # ---- blocks ------------------------------------------------------------------------------------------------------

    def _known(self, follower: BlockFollower) -> RecordedBlock:
        return self._followed.get(follower.block.section) or self._follow(follower)

    def _follow(self, follower: BlockFollower) -> RecordedBlock:
        """Begin to record a block.

        Attach its layout and the files from which the layout was made.
        """
        block = follower.block
        place = self.places.get(block.section, follower.begin)
        followed = self._followed[block.section] = RecordedBlock(follower, place, *place)
        layout = follower.part.layout
        if layout.hash not in self._attached:
            self._attached.add(layout.hash)
            self._attach([AttachedFile(name, JSON, data) for name, data in layout_files(layout)])
        if not follower.over:  # otherwise the files on disk are those of a newer block
            self._attach(self._attachments(block.source, follower.number))
        return followed

    def _attach_changed_files(self) -> None:
        """Attach the configuration file again if it has changed."""
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
        if followed.lost:
            self._tell_lost(followed, log_ns)
        if isinstance(item, Gap):
            self.counters.missed += item.count
            self._writer.gap(item, log_ns)
            followed.come_to(item.what, item.last, log_ns)
        elif isinstance(item, Event):
            self.counters.events += 1
            self._writer.event(self._channels(followed), item, log_ns)
            followed.come_to("events", item.number, log_ns)

    def _write_frames(self, follower: BlockFollower, entries: Iterable[BlockEntry]) -> None:
        """Record consecutive entries of one block, which are all frames."""
        self.empty = False
        frames = cast("list[tuple[int, Frame]]", [(log_ns, item) for log_ns, _, item in entries])
        if not follower.part.whole:
            frames = [(log_ns, follower.part.keep(frame)) for log_ns, frame in frames]
        followed = self._known(follower)
        if followed.lost:
            self._tell_lost(followed, frames[0][0])
        self.counters.frames += len(frames)
        self._writer.frames(self._channels(followed), frames)
        log_ns, last = frames[-1]
        followed.come_to("frames", last.number, log_ns)

    def _channels(self, followed: RecordedBlock) -> Channels:
        """Return the channels of a block; create them for its first entry."""
        if followed.channels is None:
            follower, after = followed.follower, followed.begin
            followed.channels = self._writer.open_block(
                follower.block, follower.number, after.frame, after.event, follower.part.layout
            )
        return followed.channels

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
        """Record gaps for lost entries.

        ``before_ns`` is the log time of the entry that follows them; 0 if no entry follows.
        """
        for gap in followed.found(before_ns):
            log_ns = before_ns or self.tap.now()
            self._writer.gap(gap, log_ns)
            followed.come_to(gap.what, gap.last, log_ns)


def frame_of(entry: BlockEntry | InstanceEntry) -> BlockFollower | None:
    """Return the follower of the block if an entry is a frame, else None."""
    return entry.follower if isinstance(entry.item, Frame) else None


def is_process_change(entry: BlockEntry | InstanceEntry) -> bool:
    """Return whether an entry is a process change."""
    return isinstance(entry.item, ProcessChange)


class RotatingRecorder:
    """Records to a sequence of files.

    The recorder starts a new file when the present file is too large or too old, and when a snapshot
    has set time back. No entry is lost between two files.

    It also starts a new file after a failed fsync, because a part of the old file may be lost. The
    new file begins at the last position that an fsync has confirmed. It has the entries after this
    position that are still in the rings, and gaps for those that are not.
    """

    def __init__(
        self,
        tap: InstanceFollower,
        settings: Settings,
        by: str,
        attachments: AttachedFiles,
        *,
        places: Mapping[int, BlockPosition] | None = None,
        about: Mapping[str, str] | None = None,
        counters: Counters | None = None,
    ) -> None:
        """Start the first file.

        Args:
            tap: Follows the instance.
            settings: Settings of the recorder.
            by: Kind of recorder.
            attachments: Returns the files to attach.
            places: Positions at which the recording begins, by section of the block. If they are
                given, the caller reads from ``tap`` and calls :meth:`put`.
            about: More metadata about the recording.
            counters: Counters to continue; None for new ones.

        Raises:
            RecordingError: No file can be created.
        """
        self._settings = settings
        self._by = by
        self._attachments = attachments
        self._renewals = 0
        self._again_s = 0.0
        self._ending: list[Recorder] = []
        """Recorders of earlier files that are not completely on the disk yet."""
        self.counters = counters or Counters()
        self._takes = places is None
        self._why = dict(about or {})
        self.recorder = self._begin(tap, places, {})

    def _begin(
        self,
        tap: InstanceFollower,
        places: Mapping[int, BlockPosition] | None,
        about: Mapping[str, str],
        after: Output | None = None,
    ) -> Recorder:
        settings = self._settings
        path, fd = create(Path(settings.directory), tap.segment.instance)
        output = Output(path, fd, limit_bytes=settings.buffer_bytes, fsync_s=settings.fsync_s, after=after)
        self._begun_s = time.monotonic()
        return Recorder(
            tap, output, by=self._by, places=places, about={**self._why, **about}, counters=self.counters,
            attachments=self._attachments,
        )  # fmt: skip

    def run_once(self) -> bool:
        """Record new entries, and return whether further entries are unread.

        Raises:
            RecordingError: The file was removed.
        """
        more = self.recorder.run_once()
        if self.tap.went_back:  # times go up in a file
            self.tap.restart_time()
            if not (self.recorder.empty or self.recorder.problem or self.recorder.losing):
                self._rotate()
        return more

    def put(self, entries: Iterable[BlockEntry | InstanceEntry]) -> None:
        """Record entries.

        Raises:
            RecordingError: The file was removed.
        """
        self.recorder.put(entries)

    def end(self) -> Mapping[int, BlockPosition]:
        """End the recording without waiting for the disk.

        Return the position after the last recorded entry of each block, by section.
        """
        self.recorder.end()
        return self.recorder.places

    @property
    def ended(self) -> bool:
        """True if :meth:`end` was called, and all files are completely written."""
        return all(recorder.output.ended for recorder in (*self._ending, self.recorder))

    @property
    def tap(self) -> InstanceFollower:
        """The follower from which this recorder reads; after a failed fsync, a new one replaces it."""
        return self.recorder.tap

    @property
    def file(self) -> Path:
        """Path of the present file."""
        return self.recorder.output.path

    @property
    def written(self) -> int:
        """Number of bytes in the present file."""
        return self.recorder.output.written

    @property
    def waiting(self) -> int:
        """Number of bytes, of all files, that wait for the disk."""
        return sum(recorder.output.waiting for recorder in (*self._ending, self.recorder))

    @property
    def problem(self) -> str:
        """The present problem of a file or its disk; empty if there is none."""
        return next(filter(None, (recorder.problem for recorder in (*self._ending, self.recorder))), "")

    def tend(self) -> bool:
        """Start a new file if one is due. Return True if the new file replaces a file whose fsync failed."""
        for old in [old for old in self._ending if old.output.ended and not old.output.doubt]:
            old.output.close(0)
            self._ending.remove(old)
        doubtful = next((old for old in (*self._ending, self.recorder) if old.output.doubt), None)
        if doubtful is not None:
            return self._renew(doubtful)
        if self.recorder.output.synced:
            self._renewals = 0
        if self._due and time.monotonic() >= self._again_s:
            self._rotate()
        return False

    def present(self) -> set[Path]:
        """Return the files that are being written. Any thread may call it."""
        return {recorder.output.path for recorder in (*self._ending, self.recorder)}

    @property
    def _due(self) -> bool:
        """True if the file is too old or too large, and can be replaced now.

        A file without entries is not replaced. While the disk has a problem, a new file would not
        help.
        """
        settings, recorder = self._settings, self.recorder
        old = bool(settings.rotate_min) and time.monotonic() - self._begun_s >= settings.rotate_min * 60
        large = bool(settings.rotate_mb) and recorder.output.tell() >= settings.rotate_mb * 1e6
        return (old or large) and not (recorder.empty or self._ending or recorder.problem or recorder.losing)

    def _rotate(self) -> None:
        old = self.recorder
        old.settle()
        try:
            self.recorder = self._begin(self.tap, old.places, {}, after=old.output)
        except RecordingError as error:
            log.error("%s; the recorder continues in %s", error, old.output.path)
            self._again_s = time.monotonic() + RENEWAL.most_s
            return
        old.end()
        self._ending.append(old)
        log.info("the recorder continues in %s, where %s ends", self.recorder.output.path, old.output.path.name)

    def _renew(self, doubtful: Recorder) -> bool:
        if time.monotonic() < self._again_s:
            return False
        self._again_s = time.monotonic() + RENEWAL.wait_s(self._renewals)
        self._renewals += 1
        output = doubtful.output
        about = {"doubtful": output.path.name, "doubtful_from": str(output.synced)}
        tap, places = self.tap, None
        if self._takes:
            tap = tap.again(StartPositions(doubtful.confirmed, True, Reason.UNSURE))
        else:  # the caller reads the instance, and cannot record the doubtful entries again
            self.recorder.settle()
            places = self.recorder.places
        try:
            recorder = self._begin(tap, places, about)
        except RecordingError as error:
            log.error("%s; %s", output.problem, error)
            return False
        log.error("%s; the recorder continues in %s", output.problem, recorder.output.path)
        if self.recorder is not doubtful:
            self._ending.remove(doubtful)
            output.close(0)
        self._finish(CLOSE_S)
        self.recorder = recorder
        return True

    def _finish(self, patience_s: float) -> bool:
        if self._takes:
            return self.recorder.close(patience_s)
        self.recorder.end()
        return self.recorder.output.close(patience_s)

    def close(self, patience_s: float = CLOSE_S) -> list[str]:
        """Record all remaining entries, and close all files.

        Return a message for each file that is incomplete.
        """
        until_s = time.monotonic() + patience_s
        files = [*self._ending, self.recorder]
        closed = [old.output.close(max(0.0, until_s - time.monotonic())) for old in self._ending]
        closed.append(self._finish(max(0.1, until_s - time.monotonic())))
        return [_unclosed(recorder.output) for recorder, whole in zip(files, closed, strict=True) if not whole]


def _unclosed(output: Output) -> str:
    if output.doubt:
        return output.problem or str(output.path)
    return (
        f"{output.problem or output.path}: not all data was written, so the recording has no proper end; the next "
        "recorder closes it"
    )
