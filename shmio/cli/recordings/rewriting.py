"""New recordings out of what others hold."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Final

from shmio import __version__
from shmio.cli.recordings.progress import Progress
from shmio.cli.recordings.verify import lines, verify
from shmio.errors import RecordingError
from shmio.recorder.writer import JSON, TEXT, TOML, Channels, Writer
from shmio.recording.dump import Dump
from shmio.recording.format.blocks import DumpBlock
from shmio.recording.format.encoding import Gap, ProcessChange, Reason, StepMark
from shmio.recording.format.entries import Entry
from shmio.recording.reading.reader import Item
from shmio.segment import Event, Frame

MAX_ATTACHMENT_BYTES: Final = 16 << 20
FLUSH_BYTES: Final = 4 << 20

_TYPES: Final = {".json": JSON, ".toml": TOML}


class _Track:
    """A block in the new file: its channels, once it is known where it begins, and its last frame and event."""

    def __init__(self) -> None:
        self.number = 0
        self.channels: Channels | None = None
        self.waiting: list[Entry[Item]] = []
        """Gaps before the first frame or event."""
        self.last: dict[str, int] = {}
        self.last_ns = 0


class Rewriter:
    """Writes what is added to a new file, as a recorder would have: each number of a block is there, or in a gap."""

    def __init__(self, stream: IO[bytes], dump: Dump, made: str, *, whole: bool) -> None:
        """``made`` says by what; ``whole`` as of :func:`rewrite`."""
        self._whole = whole
        about = {**dump.about, "made_by": made, "made_version": __version__}
        self._writer = Writer(stream, about)
        self._dump = dump
        self._tracks: dict[DumpBlock, _Track] = {}
        self._layouts: set[bytes] = set()
        self.counts: dict[str, int] = {"frames": 0, "events": 0}
        self.damaged = 0
        """Frames and events that could not be read, as gaps of the new file tell."""

    def attach(self) -> None:
        """Copy the attachments that are whole but for layouts, which come with their blocks."""
        seen: set[str] = set()
        for reader in self._dump.readers:
            for name in reader.attachments:
                if name in seen or name.startswith("layouts/"):
                    continue
                with suppress(RecordingError):
                    data = reader.attachment(name, MAX_ATTACHMENT_BYTES)
                    self._writer.attach(name, _TYPES.get(Path(name).suffix, TEXT), data, self._dump.begin_ns)
                    seen.add(name)

    def add(self, entry: Entry[Item]) -> None:
        """The next item, in order."""
        if isinstance(entry.item, StepMark):
            self._writer.step(entry.item, entry.time_ns)
        elif isinstance(entry.item, ProcessChange):
            self._writer.process(entry.item, entry.time_ns)
        elif entry.block is not None:
            self._of_block(entry.block, entry)

    def _of_block(self, block: DumpBlock, entry: Entry[Item]) -> None:
        track = self._tracks.setdefault(block, _Track())
        item = entry.item
        if track.channels is None:
            track.waiting.append(entry)
            if not isinstance(item, Gap):
                self._begin(block, track)
            return
        if isinstance(item, Frame):
            self._follow(block, track, "frames", item.number, item.number, entry.time_ns)
            self._writer.frame(track.channels, item, entry.time_ns)
            self.counts["frames"] += 1
        elif isinstance(item, Event):
            self._follow(block, track, "events", item.number, item.number, entry.time_ns)
            self._writer.event(track.channels, item, entry.time_ns)
            self.counts["events"] += 1
        elif isinstance(item, Gap):
            self._follow(block, track, item.what, item.first, item.last, entry.time_ns)
            self._gap(track, item, entry.time_ns)
        track.last_ns = entry.time_ns

    def _begin(self, block: DumpBlock, track: _Track) -> None:
        """A frame says which event was before it, and the other way round: so it is known where both begin."""
        waiting, track.waiting = track.waiting, []
        first = waiting[-1].item
        after = {what: block.after.get(what, 0) for what in ("frames", "events")}
        if isinstance(first, Frame):
            after = {"frames": first.number - 1, "events": first.event}
        elif isinstance(first, Event):
            after = {"frames": first.frame, "events": first.number - 1}
        for entry in reversed(waiting):
            if isinstance(entry.item, Gap):
                after[entry.item.what] = entry.item.first - 1
        track.last = dict(after)
        if self._whole:
            track.last = {what: min(number, block.after.get(what, number)) for what, number in after.items()}
        if block.layout.hash not in self._layouts:
            self._layouts.add(block.layout.hash)
            name = f"layouts/{block.layout.hash.hex()}.json"
            self._writer.attach(name, JSON, block.layout.to_json(), waiting[0].time_ns)
        track.number = len([one for one in self._tracks.values() if one.channels]) + 1
        track.channels = self._writer.open_block(
            block, track.number, track.last["frames"], track.last["events"], of=block.of
        )
        for entry in waiting:
            self._of_block(block, entry)

    def _follow(self, block: DumpBlock, track: _Track, what: str, first: int, last: int, time_ns: int) -> None:
        missing = first - track.last[what] - 1
        if missing > 0:
            place = block.source, track.number, what
            gap = Gap(*place, track.last[what] + 1, first - 1, missing, Reason.DAMAGED, track.last_ns, time_ns)
            self.damaged += missing
            self._writer.gap(gap, time_ns)
        track.last[what] = last

    def _gap(self, track: _Track, gap: Gap, time_ns: int) -> None:
        gap = Gap(gap.source, track.number, gap.what, gap.first, gap.last, gap.count, gap.reason, gap.after_ns, time_ns)
        self._writer.gap(gap, time_ns)

    def finish(self) -> None:
        """Write index and footer."""
        for block, track in self._tracks.items():
            if track.waiting:  # nothing but gaps
                self._begin(block, track)
        self._writer.finish()


@contextmanager
def new_file(path: Path) -> Iterator[IO[bytes]]:
    """A file of this user alone that was not there before; removed again unless all goes well.

    RecordingError: it is there. OSError, with the file's name: as by a full disk.
    """
    try:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        raise RecordingError(f"{path} is there already: nothing is ever overwritten") from None
    try:
        with os.fdopen(fd, "wb", buffering=FLUSH_BYTES) as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
    except BaseException as error:
        with suppress(OSError):
            path.unlink()
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)
        raise


def rewrite(dump: Dump, path: Path, made: str, entries: Iterable[Entry[Item]], *, whole: bool = True) -> Rewriter:
    """Write entries of a dump to a new file. OSError, RecordingError: nothing is left then.

    ``whole``: what is missing at the beginning of a block was damaged; else it is not asked for.
    """
    with Progress(f"writing {path}") as progress, new_file(path) as stream:
        progress.total = dump.end_ns - dump.begin_ns
        work = Rewriter(stream, dump, made, whole=whole)
        work.attach()
        for entry in entries:
            work.add(entry)
            progress.at(entry.time_ns - dump.begin_ns)
        work.finish()
    return work


def verified(path: Path) -> list[str]:
    """Lines about a new file that was read once more; RecordingError: it is damaged."""
    found = verify(path)
    if found["damage"]:
        raise RecordingError(f"{path}: {found['damage'][0]}")
    return lines(found)
