"""Makes new recordings: a part of a recording, several files joined, or the intact entries of a damaged file."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Final

from shmio.errors import RecordingError
from shmio.layout.model import Register
from shmio.layout.overlay import needed
from shmio.recording.dump import Dump
from shmio.recording.format.encoding import Gap, ProcessChange, Reason, StepMark
from shmio.recording.reading.part import MAX_NS, DumpBlock, Entry
from shmio.recording.reading.reader import Item
from shmio.recording.selection import RecordedRegisters
from shmio.recording.times import span
from shmio.recording.writer import JSON, TEXT, TOML, Channels, Writer
from shmio.segment import Event, Frame
from shmio.version import __version__
from shmio.wording import EMPTY, EXISTS

MAX_ATTACHMENT_BYTES: Final = 16 << 20
FLUSH_BYTES: Final = 4 << 20

_TYPES: Final = {".json": JSON, ".toml": TOML}


class _Track:
    """A block in the new file, with its channels and the numbers of its last frame and event."""

    def __init__(self) -> None:
        self.number = 0
        self.channels: Channels | None = None
        self.waiting: list[Entry[Item]] = []
        """Gaps before the first frame or event of the block. They are not written yet."""
        self.last: dict[str, int] = {}
        self.last_ns = 0


class Rewriter:
    """Writes entries to a new file as a recorder does, with gaps for missing frames and events."""

    def __init__(self, stream: IO[bytes], about: Mapping[str, str], *, whole: bool) -> None:
        """Begin the file. ``about`` is the metadata about the instance; for ``whole``, see :func:`rewrite`."""
        self._whole = whole
        self._writer = Writer(stream, about)
        self._tracks: dict[DumpBlock, _Track] = {}
        self._layouts: set[bytes] = set()
        self.counts: dict[str, int] = {"frames": 0, "events": 0}
        self.damaged = 0
        """Number of frames and events that could not be read; the new file has gaps for them."""

    def attach(self, dump: Dump) -> None:
        """Copy all intact attachments of a recording except layouts, which are written with their blocks."""
        seen: set[str] = set()
        for reader in dump.readers:
            for name in reader.attachments:
                if name in seen or name.startswith("layouts/"):
                    continue
                with suppress(RecordingError):
                    data = reader.attachment(name, MAX_ATTACHMENT_BYTES)
                    self._writer.attach(name, _TYPES.get(Path(name).suffix, TEXT), data, dump.begin_ns)
                    seen.add(name)

    def add(self, entry: Entry[Item]) -> None:
        """Add an entry. Call this for all entries in their order."""
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
        """Begin a block in the new file at its first frame or event."""
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
            self._writer.attach_layout(block.layout, waiting[0].time_ns)
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
        """Write the index and the footer."""
        for block, track in self._tracks.items():
            if track.waiting:  # the block has only gaps
                self._begin(block, track)
        self._writer.finish()


@contextmanager
def new_file(path: Path) -> Iterator[IO[bytes]]:
    """Create a file that only this user may read, open during a ``with`` block; after an error, remove it.

    Raises:
        RecordingError: The file exists already.
        OSError: The file cannot be written. The error has the file's name.
    """
    try:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        raise RecordingError(f"{path}: {EXISTS}") from None
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


def rewrite(
    dump: Dump,
    path: Path,
    made: str,
    entries: Iterable[Entry[Item]],
    *,
    whole: bool = True,
    progress: Callable[[int], None] = lambda _: None,
) -> Rewriter:
    """Write entries of a recording to a new file. After an error, remove the new file.

    Args:
        dump: The recording, whose attachments and metadata are copied.
        path: The new file.
        made: Name of the command that makes the file, for its metadata.
        entries: The entries in order: from ``dump.items()``, or from :func:`part`.
        whole: True to write a gap for entries that are missing at the beginning of a block; False if
            they were left out on purpose.
        progress: Called with the time in ns, from the start of the recording, up to which it is
            done.

    Returns:
        The writer of the file, with its statistics.

    Raises:
        RecordingError: The file exists already.
        OSError: The file cannot be written.
    """
    with new_file(path) as stream:
        work = Rewriter(stream, {**dump.about, "made_by": made, "made_version": __version__}, whole=whole)
        work.attach(dump)
        for entry in entries:
            work.add(entry)
            progress(entry.time_ns - dump.begin_ns)
        work.finish()
    return work


def part(
    dump: Dump,
    from_ns: int = 0,
    to_ns: int = MAX_NS,
    sources: Collection[str] | None = None,
    registers: Sequence[str] = (),
) -> Iterator[Entry[Item]]:
    """Return the entries of a part of a recording.

    Write them with :func:`rewrite` and ``whole=False``.

    Args:
        dump: The recording.
        from_ns: Start of the range, log time in ns.
        to_ns: End of the range, log time in ns.
        sources: Names of the sources; None for all.
        registers: Paths of the registers; empty for all. The path of an element selects its whole
            array. The bytes of all other registers become zero.

    Returns:
        The entries in order.

    Raises:
        PathError: There is no such source or register.
        RecordingError: Nothing was recorded in that time.
    """
    return _part(dump, from_ns, to_ns, sources, _Parts(dump, registers) if registers else None)


def _part(
    dump: Dump, from_ns: int, to_ns: int, sources: Collection[str] | None, parts: _Parts | None
) -> Iterator[Entry[Item]]:
    if parts is not None:
        sources = parts.sources if sources is None else [source for source in parts.sources if source in sources]
    anything = False
    for entry in dump.items(sources, from_ns, to_ns):
        anything = True
        if parts is None:
            yield entry
        elif (kept := parts.of(entry)) is not None:
            yield kept
    if not anything and not dump.begin_ns:
        raise RecordingError(f"{dump.files[0]}: {EMPTY}")
    if not anything:
        raise RecordingError(f"{dump.files[0]} has nothing in that time; it goes {span(dump.begin_ns, dump.end_ns)}")


class _Parts:
    """Reduces the entries of a recording to some registers. All other bytes become zero."""

    def __init__(self, dump: Dump, paths: Sequence[str]) -> None:
        """Find the registers. An element selects its whole array.

        Raises:
            PathError: There is no such register.
        """
        self._parts = {block: _reduced(block, registers) for block, registers in dump.select(paths).items()}

    @property
    def sources(self) -> list[str]:
        """The names of the sources of these registers."""
        return list(dict.fromkeys(block.source for block in self._parts))

    def of(self, entry: Entry[Item]) -> Entry[Item] | None:
        """Return an entry, reduced to these registers; None if its block has none of them."""
        if entry.block is None:
            return entry
        if entry.block not in self._parts:
            return None
        block, kept = self._parts[entry.block]
        item = entry.item
        return Entry(entry.time_ns, block, kept.keep(item) if isinstance(item, Frame) else item)


def _reduced(block: DumpBlock, registers: Sequence[Register]) -> tuple[DumpBlock, RecordedRegisters]:
    """Return a block, reduced to these registers, and an object that reduces its frames."""
    paths = {path for register in registers for path in needed(block.layout, register)}
    whole = tuple(register for register in block.layout.registers if register.path in paths)
    part = RecordedRegisters(block.layout, whole)
    layout = part.layout
    digest = layout.hash.hex()
    of = "" if digest == block.layout_hash else block.of or block.layout_hash
    return replace(block, layout=layout, layout_hash=digest, of=of), part
