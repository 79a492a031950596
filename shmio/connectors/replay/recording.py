"""The files of one recording: what sources it has, from when to when, and where their messages are."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode

from shmio.connectors.replay.tape import Chunk, Tape
from shmio.dump.encoding import FRAME
from shmio.dump.reader import Reader
from shmio.dump.survey import Track, survey
from shmio.errors import RecordingError
from shmio.layout.model import Layout

Moment = float | str
"""Seconds from a recording's begin, or a date and time."""


class Kept(NamedTuple):
    """A block of a recording: its source, its layout, and from when to when it was recorded; log times."""

    source: str
    layout: Layout
    period_ns: int
    stale_ns: int
    first_ns: int
    last_ns: int


class Span(NamedTuple):
    """Which part of a recording is played: positions, the second behind it."""

    begin_ns: int
    end_ns: int


class Recording:
    """A recording, or several files of one, open for reading. A context manager.

    RecordingError: a file cannot be read, is none, or they are of different runs of an instance.
    """

    def __init__(self, files: Sequence[str | Path]) -> None:
        self._readers: list[Reader] = []
        self._chunks: list[Chunk] = []
        self.blocks: list[Kept] = []
        """In the order of the files."""
        try:
            for file in map(Path, files):
                self._open(file)
            self._check()
        except BaseException:
            self.close()
            raise
        about = self._readers[0].about
        self.utc_ns = int(about["started_utc_ns"])
        """UTC of position 0: when the instance started that was recorded."""
        self._chunks.sort(key=lambda chunk: chunk.first_ns)
        self.whole = Span(
            min(kept.first_ns for kept in self.blocks) - self.utc_ns,
            max(kept.last_ns + kept.period_ns for kept in self.blocks) - self.utc_ns,
        )
        """From the first frame to a period behind the last one."""

    def _open(self, file: Path) -> None:
        try:
            reader = Reader(file)
        except OSError as error:
            raise RecordingError(f"{file}: {error.strerror}") from None
        self._readers.append(reader)
        found = survey(reader)
        self.blocks += [_kept(reader, track) for track in found.tracks.values() if track.channel.encoding == FRAME]
        for record in reader.records.walk():
            if record.opcode == Opcode.CHUNK:
                self._chunks.append(Chunk(reader, record, *reader.records.chunk_times(record)))

    def _check(self) -> None:
        """RecordingError: they do not go together, or there is nothing to be played."""
        first = self._readers[0]
        for reader in self._readers:
            number = reader.about.get("started_utc_ns", "")
            if not (number.isdecimal() and len(number) < 20):
                raise RecordingError(f"{reader.file} does not say when its instance was started: it cannot be played")
            if reader.about.get("epoch") != first.about.get("epoch"):
                raise RecordingError(f"{first.file} and {reader.file} are of different runs: play one after the other")
        if not self.blocks:
            raise RecordingError(f"{first.file} holds no frames: there is nothing to play")

    @property
    def sources(self) -> list[str]:
        """Names of the sources that have frames."""
        return list(dict.fromkeys(kept.source for kept in self.blocks))

    @property
    def instance(self) -> str:
        """Name of the instance that was recorded."""
        return self._readers[0].about.get("instance", "")

    def span(self, start: Moment | None, end: Moment | None) -> Span:
        """What is played. RecordingError: there is nothing between these."""
        begin_ns = self.whole.begin_ns if start is None else self.moment("start", start)
        end_ns = self.whole.end_ns if end is None else self.moment("end", end)
        span = Span(max(begin_ns, self.whole.begin_ns), min(end_ns, self.whole.end_ns))
        if span.begin_ns >= span.end_ns:
            length_s = (self.whole.end_ns - self.whole.begin_ns) / 1e9
            raise RecordingError(
                f"start, end: there is nothing to play between them; {self._readers[0].file} has {length_s:.3f} s from "
                f"{datetime.fromtimestamp((self.utc_ns + self.whole.begin_ns) / 1e9).astimezone().isoformat()} on"
            )
        return span

    def moment(self, key: str, text: Moment) -> int:
        """The position of seconds from the begin, or of a date and time, local unless it says. RecordingError."""
        try:
            if not isinstance(text, str):
                return self.whole.begin_ns + round(text * 1e9)
            return round(datetime.fromisoformat(text).astimezone().timestamp() * 1e6) * 1000 - self.utc_ns
        except (ValueError, OverflowError):
            raise RecordingError(
                f"{key}: {text!r} is neither a time such as 2026-11-21T08:30:00 nor seconds of the recording"
            ) from None

    def tape(self, source: str, span: Span | None = None) -> Tape:
        """What there is of a source. RecordingError: nothing, or its layout changes within what is played."""
        blocks = [kept for kept in self.blocks if kept.source == source]
        if not blocks:
            raise RecordingError(f"{self._readers[0].file} has no source {source!r}; it has: {', '.join(self.sources)}")
        begin_ns, end_ns = ((span or self.whole).begin_ns + self.utc_ns, (span or self.whole).end_ns + self.utc_ns)
        played = [kept for kept in blocks if kept.first_ns < end_ns and kept.last_ns >= begin_ns] or blocks[:1]
        last = played[-1]
        if any(kept.layout.hash != last.layout.hash for kept in played):
            at_s = (last.first_ns - self.utc_ns - self.whole.begin_ns) / 1e9
            raise RecordingError(
                f"source {source}: its layout was changed within what is to be played, at {at_s:.3f} s: end before "
                "that, or start there"
            )
        return Tape(source, last.layout, last.period_ns, last.stale_ns, self._chunks, self.utc_ns)

    def close(self) -> None:
        """Close the files."""
        for reader in self._readers:
            reader.close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _kept(reader: Reader, track: Track) -> Kept:
    channel = track.channel
    period_ns = channel.period_ns or 20_000_000
    stale_ns = channel.stale_ns or 500_000_000
    return Kept(channel.source, reader.layout(channel), period_ns, stale_ns, track.first_ns, track.last_ns)
