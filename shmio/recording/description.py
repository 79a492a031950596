"""Describes what is in a recording file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from shmio.errors import RecordingError
from shmio.recording.format.encoding import EVENT, FRAME
from shmio.recording.reading.reader import Reader
from shmio.recording.reading.survey import Survey, Track, survey
from shmio.recording.times import iso


def describe(file: Path, **options: Any) -> dict[str, Any]:
    """Return what ``shmio-dump info --json`` prints about a file, without reading all of the file.

    Args:
        file: The path.
        options: Keyword arguments for :class:`Reader`.

    Raises:
        OSError: The file cannot be read.
        RecordingError: The file is not a recording.
    """
    with Reader(file, **options) as reader:
        return _describe(reader, survey(reader))


def _describe(reader: Reader, found: Survey) -> dict[str, Any]:
    duration_s = (found.end_ns - found.begin_ns) / 1e9
    size = reader.records.size
    about = reader.about
    return {
        "file": str(reader.file),
        "size": size,
        "closed": reader.records.closed,
        "end": reader.records.damage,
        "damage": found.damage,
        "instance": about.get("instance", ""),
        "epoch": about.get("epoch", ""),
        "mode": about.get("mode", ""),
        "host": about.get("host", ""),
        "version": about.get("version", ""),
        "recorder": about.get("recorder", ""),
        "made_by": about.get("made_by"),
        "trigger": about.get("trigger"),
        "triggered": _moment(about.get("triggered_ns", "")),
        "started": _moment(about.get("started_utc_ns", "")),
        "from": iso(found.begin_ns) if found.begin_ns else None,
        "to": iso(found.end_ns) if found.end_ns else None,
        "duration_s": round(duration_s, 3),
        "bytes_per_minute": round(size / duration_s * 60) if duration_s > 0 else None,
        "blocks": _blocks(reader, found),
        "missed_frames": _missed(found, "frames"),
        "missed_events": _missed(found, "events"),
        "doubtful": about.get("doubtful"),
        "doubtful_from": about.get("doubtful_from"),
        "gap_count": found.gap_count,
        "gaps": [msgspec.to_builtins(gap) for gap in found.gaps],
        "attachments": {name: entry.size for name, entry in reader.attachments.items()},
    }


def _moment(text: str) -> str | None:
    return iso(int(text)) if text.isdecimal() and len(text) < 20 else None


def _missed(found: Survey, what: str) -> int:
    return sum(count for (_, _, kind), count in found.missed.items() if kind == what)


def _blocks(reader: Reader, found: Survey) -> list[dict[str, Any]]:
    blocks: dict[int, dict[str, Track]] = {}
    for track in found.tracks.values():
        if track.channel.encoding in (FRAME, EVENT):
            blocks.setdefault(track.channel.block, {})[track.channel.encoding] = track
    return [_block(reader, found, tracks) for _, tracks in sorted(blocks.items())]


def _block(reader: Reader, found: Survey, tracks: dict[str, Track]) -> dict[str, Any]:
    frames, events = tracks.get(FRAME), tracks.get(EVENT)
    channel = next(iter(tracks.values())).channel
    described: dict[str, Any] = {
        "source": channel.source,
        "block": channel.block,
        "layout": None,
        "layout_hash": channel.layout,
        "size": None,
        "registers": None,
        "frames": frames.count if frames else 0,
        "first_frame": None,
        "last_frame": None,
        "from": iso(frames.first_ns) if frames else None,
        "to": iso(frames.last_ns) if frames else None,
        "rate_hz": None,
        "events": events.count if events else 0,
        "missed_frames": found.missed.get((channel.source, channel.block, "frames"), 0),
        "missed_events": found.missed.get((channel.source, channel.block, "events"), 0),
    }
    if frames and frames.last_ns > frames.first_ns:
        described["rate_hz"] = round((frames.count - 1) / (frames.last_ns - frames.first_ns) * 1e9, 3)
    try:
        layout = reader.layout(channel)
        described |= {"layout": layout.name, "size": layout.size, "registers": len(layout.registers)}
        if frames:
            described["first_frame"], described["last_frame"] = frames.numbers(reader)
    except RecordingError as error:
        found.damage.append(str(error))
    return described
