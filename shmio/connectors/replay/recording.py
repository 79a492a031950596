"""Opens a recording for replay, and reads the frames and events of one source by time."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Final, NamedTuple

from shmio.errors import RecordingError
from shmio.local.replays import date_ns
from shmio.recording.dump import Dump, open_dump
from shmio.recording.format.encoding import Gap
from shmio.recording.format.records import Damage
from shmio.recording.reading.part import DumpBlock
from shmio.segment import Event, Frame
from shmio.segment.header import MAX_PROCESSES
from shmio.wording import counted

Moment = float | str
"""A time in a recording: seconds from its beginning, or a date and time."""

MAX_NS: Final = 1 << 61
"""The largest valid time in ns, about 70 years."""

MIN_PERIOD_NS: Final = 100_000
MAX_PERIOD_NS: Final = 3_600_000_000_000
"""The longest valid period of a source in ns; the configuration has the same limit."""

log = logging.getLogger("shmio.source")


class MissingFrames(NamedTuple):
    """Frames that the recording lacks, and the reason."""

    reason: str


_DAMAGED: Final = MissingFrames("not in the recording: it is damaged here")


class Entry(NamedTuple):
    """A frame, an event or a gap in a recording, with its position."""

    position_ns: int
    item: Frame | Event | MissingFrames


class RecordedSource:
    """Reads the entries of one source of a recording by position.

    A position is a time in ns since the start of the recorded instance. Several iterators may be
    open at once. Use them in one thread only.
    """

    def __init__(self, dump: Dump, damage: list[Damage], block: DumpBlock, utc_ns: int) -> None:
        """Create the reader.

        Args:
            dump: The recording.
            damage: The list to which ``dump`` appends each damaged part that it finds.
            block: A block of the source. Only the source's blocks with the same layout are played.
            utc_ns: The UTC time of position 0, in ns since 1970.

        """
        self._dump = dump
        self._damage = damage
        self.block = block
        self._utc_ns = utc_ns
        self._holes = [gap for gap in dump.gaps if gap.source == block.source and gap.what == "frames"]

    def entries(self, from_ns: int | None) -> Iterator[Entry]:
        """Yield the entries from a position on (None: from the first entry), in recorded order.

        At a gap or damaged part, the item of the entry is a MissingFrames.
        """
        at_ns = from_ns
        begin_ns = 0 if from_ns is None else max(0, from_ns + self._utc_ns)
        for time_ns, block, item in self._dump.items(self.block.source, begin_ns):
            position_ns = time_ns - self._utc_ns
            if self._damage:
                self._damage.clear()
                yield Entry(position_ns if at_ns is None else min(at_ns + self.block.period_ns, position_ns), _DAMAGED)
            if isinstance(item, Gap):
                if item.what == "frames":
                    yield self._hole(item, position_ns)
            elif isinstance(item, Frame | Event) and self._is_played(block):
                yield Entry(position_ns, item)
            else:
                continue
            at_ns = position_ns

    def newest(self, position_ns: int) -> Entry | None:
        """Return the last frame or gap at or before a position; None if there is none."""
        found = self._dump.latest(self.block.source, position_ns + self._utc_ns)
        self._damage.clear()
        last = None
        if found is not None and self._is_played(found.block):
            last = Entry(found.time_ns - self._utc_ns, found.item)
        holes = (self._hole(gap, position_ns) for gap in self._holes)
        return max(
            (entry for entry in (last, *holes) if entry is not None and entry.position_ns <= position_ns),
            key=lambda entry: (entry.position_ns, isinstance(entry.item, Frame)),
            default=None,
        )

    def _is_played(self, block: DumpBlock | None) -> bool:
        return block is not None and block.layout_hash == self.block.layout_hash

    def _hole(self, gap: Gap, at_ns: int) -> Entry:
        """Return the entry of a gap.

        Its position is one period after the frame before the gap, but not later than the frame
        after it.
        """
        position_ns = gap.after_ns - self._utc_ns + self.block.period_ns if gap.after_ns else at_ns
        if gap.before_ns:
            position_ns = min(position_ns, gap.before_ns - self._utc_ns)
        count = counted(gap.count, "frame")
        return Entry(position_ns, MissingFrames(f"not in the recording: {count} ({gap.reason})"))


class Span(NamedTuple):
    """A part of a recording, from one position up to but not including another."""

    begin_ns: int
    end_ns: int


class Recording:
    """A recording in one or several files, open for reading. Use it as a context manager.

    Raises:
        RecordingError: A file cannot be read or is not a recording, there are no frames, or the
            files are from different runs.

    """

    def __init__(self, files: Sequence[str | Path]) -> None:
        self._damage: list[Damage] = []
        try:
            self._dump = open_dump(files, self._damaged)
        except OSError as error:
            raise RecordingError(f"{error.filename}: {error.strerror}") from None
        self._file = self._dump.files[0]
        for reader in self._dump.readers:
            reader.records.lock()
        try:
            self._measure()
        except BaseException:
            self._dump.close()
            raise

    def _measure(self) -> None:
        started = self._dump.about.get("started_utc_ns", "")
        if not (started.isdecimal() and len(started) < 20):
            raise RecordingError(f"{self._file} does not say when its instance was started, so it cannot be played")
        self.utc_ns = int(started)
        """The UTC time of position 0, the start of the recorded instance, in ns since 1970."""
        names = self._dump.sources
        if len(names) > MAX_PROCESSES:
            raise RecordingError(
                f"{self._file} has {len(names)} sources, but an instance has at most {MAX_PROCESSES}; copy some of "
                "them to another file with shmio-dump cut --source"
            )
        spans = {name: span for name in names if (span := self._measured(name))}
        if not spans:
            raise RecordingError(f"{self._file} has no frames, so it cannot be played")
        self.sources = list(spans)
        """The names of the sources that have frames."""
        self.whole = Span(
            min(span.begin_ns for span in spans.values()) - self.utc_ns,
            max(span.end_ns for span in spans.values()) - self.utc_ns,
        )
        """The whole recording, from the first frame to one period after the last one."""
        even = all(
            MIN_PERIOD_NS <= block.period_ns <= MAX_PERIOD_NS and block.period_ns <= block.stale_ns <= MAX_NS
            for block in self._dump.blocks
        )
        if not even or max(self.utc_ns, *map(abs, self.whole)) > MAX_NS:
            raise RecordingError(f"{self._file} has invalid times, so it cannot be played")

    def _measured(self, name: str) -> Span | None:
        """Return the span of a source's frames in UTC, up to one period after the last frame.

        None if the source has no frames.
        """
        if self._dump.damage:  # then the index may be incomplete
            first, last = next(self._dump.frames(name), None), self._dump.latest(name)
            return Span(first.time_ns, last.time_ns + last.block.period_ns) if first and last and last.block else None
        blocks = [block for block in self._dump.blocks if block.source == name and block.frames]
        if not blocks:
            return None
        last_block = max(blocks, key=lambda block: block.last_ns)
        return Span(min(block.first_ns for block in blocks), last_block.last_ns + last_block.period_ns)

    def _damaged(self, file: Path, damage: Damage) -> None:
        log.warning("%s: bytes %d to %d are lost: %s", file, damage.first, damage.last, damage.why)
        self._damage.append(damage)

    def span(self, start: Moment | None, end: Moment | None) -> Span:
        """Return the part of the recording between two times.

        A ``start`` of None is the beginning of the recording, and an ``end`` of None is its end.

        Raises:
            RecordingError: A time is invalid, or no part of the recording lies between the times.
                The message begins with the configuration key.

        """
        begin_ns = self.whole.begin_ns if start is None else self.moment("start", start)
        end_ns = self.whole.end_ns if end is None else self.moment("end", end)
        span = Span(max(begin_ns, self.whole.begin_ns), min(end_ns, self.whole.end_ns))
        if span.begin_ns >= span.end_ns:
            length_s = (self.whole.end_ns - self.whole.begin_ns) / 1e9
            begin = datetime.fromtimestamp((self.utc_ns + self.whole.begin_ns) / 1e9).astimezone().isoformat()
            raise RecordingError(
                f"start, end: there is nothing to play between these times; {self._file} has {length_s:.3f} s from "
                f"{begin} on"
            )
        return span

    def moment(self, key: str, text: Moment) -> int:
        """Convert a time, given as seconds from the beginning or as a date and time, to a position in ns.

        A date and time without a zone is local. ``key`` is the configuration key, for error
        messages.

        Raises:
            RecordingError: The text is not a valid time.

        """
        try:
            if not isinstance(text, str):
                return self.whole.begin_ns + round(text * 1e9)
            return date_ns(text) - self.utc_ns
        except (ValueError, OverflowError):
            raise RecordingError(
                f"{key}: {text!r} is neither a time such as 2026-11-21T08:30:00 nor seconds of the recording"
            ) from None

    def recorded(self, source: str, span: Span) -> RecordedSource:
        """Return a reader of one source of the recording.

        Raises:
            RecordingError: The source has no frames, or its layout changes within ``span``.

        """
        if source not in self.sources:
            raise RecordingError(
                f"{self._file} has no frames of a source {source!r}; its sources are: {', '.join(self.sources)}"
            )
        blocks = [block for block in self._dump.blocks if block.source == source and block.frames]
        begin_ns, end_ns = (position_ns + self.utc_ns for position_ns in span)
        played = [block for block in blocks if block.begin_ns < end_ns and block.end_ns >= begin_ns] or blocks[:1]
        last = played[-1]
        if any(block.layout_hash != last.layout_hash for block in played):
            at_s = (last.begin_ns - self.utc_ns - self.whole.begin_ns) / 1e9
            raise RecordingError(
                f"the layout of source {source} changes within the part to play, at {at_s:.3f} s; end before "
                "that time, or start there"
            )
        return RecordedSource(self._dump, self._damage, last, self.utc_ns)

    def close(self) -> None:
        """Close the files."""
        self._dump.close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
