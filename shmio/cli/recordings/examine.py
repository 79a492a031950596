"""``shmio-dump info`` and ``verify``: examine recordings, file by file."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec

from shmio.cli.recordings.common import Progress, not_closed
from shmio.cli.run import dumps
from shmio.errors import RecordingError
from shmio.logs import printable
from shmio.recording.check import check
from shmio.recording.format.encoding import EVENT, FRAME, SUPERVISED
from shmio.recording.reading.reader import Reader
from shmio.recording.reading.survey import Survey, Track, survey
from shmio.recording.times import iso, local, lost


def info(arguments: argparse.Namespace) -> int:
    """Describe each file; return 1 if one is damaged or not a recording."""
    return _each(arguments, _look, lambda found: _folded(_lines(found)))


def _look(file: Path) -> dict[str, Any]:
    with Reader(file) as reader:
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


def _lines(found: dict[str, Any]) -> list[str]:
    size = f"{found['size'] / 1e6:.2f} MB"
    rate = f", {found['bytes_per_minute'] / 1e6:.2f} MB/min" if found["bytes_per_minute"] else ""
    recorder = "the instance's own recorder" if found["recorder"] == SUPERVISED else found["recorder"]
    by = f"recorded by {recorder}, shmio {found['version']}, on {found['host']}"
    if found["made_by"]:
        by += f"; converted by {found['made_by']}"
    lines = [
        f"{found['file']}: {size}, {_ended(found)}",
        f"  instance {found['instance']}, mode {found['mode']}, started {found['started']}; {by}",
        f"  {found['from']} to {found['to']}, {found['duration_s']:.1f} s{rate}"
        if found["from"]
        else "  no frames in it",
    ]
    if found["trigger"]:
        lines.append(f"  triggered {found['triggered']} by {found['trigger']}")
    if found["doubtful"]:
        where = f"after byte {found['doubtful_from']} of {found['doubtful']}"
        lines.append(f"  what is {where} may be lost: the disk failed at its fsync")
    for block in found["blocks"]:
        hertz = f" at {block['rate_hz']:.1f} Hz" if block["rate_hz"] else ""
        lines.append(
            f"  {block['source']}: {block['layout']}, {block['registers']} registers, {block['size']} bytes, "
            f"layout {block['layout_hash'][:12]}: {block['frames']} frames{hertz}, {block['events']} events"
        )
    missed = f"{found['missed_frames']} frames and {found['missed_events']} events missed"
    lines.append(f"  {missed} in {found['gap_count']} gaps" if found["gap_count"] else "  nothing missed")
    lines += [f"    {_gap(gap)}" for gap in found["gaps"][:10]]
    return lines + [f"  damage: {text}" for text in found["damage"]]


def _folded(lines: list[str]) -> Iterator[str]:
    """Yield the lines; replace equal consecutive lines by one line with their number."""
    for line, alike in groupby(lines):
        count = sum(1 for _ in alike)
        yield line if count == 1 else f"{line} ({count} of these)"


def _gap(gap: dict[str, Any]) -> str:
    when = local(gap["before_ns"] or gap["after_ns"]) if gap["before_ns"] or gap["after_ns"] else "-"
    return f"{when}  {gap['source']}: {gap['count']} {gap['what']}, {gap['first']} to {gap['last']}: {gap['reason']}"


def verify(arguments: argparse.Namespace) -> int:
    """Read each file completely; return 1 if one is damaged or not a recording."""
    return _each(arguments, checked, checked_lines)


def checked(file: Path) -> dict[str, Any]:
    """Read a file completely and return the result.

    Raises:
        OSError: The file cannot be read.
        RecordingError: The file is not a recording.
    """
    with Progress(f"verifying {file}") as progress, Reader(file) as reader:
        progress.total = reader.records.size
        found = check(reader, progress.at)
        texts = [lost(damage) for damage in found.damage] + found.problems
        if found.count > len(texts):
            texts.append(f"and {found.count - len(texts)} more such places")
        return {
            "file": str(file),
            "size": reader.records.size,
            "closed": reader.records.closed,
            "end": reader.records.damage,
            "chunks": found.chunks,
            "messages": found.messages,
            "damage": texts,
        }


def checked_lines(found: dict[str, Any]) -> list[str]:
    """Return the result as lines of text."""
    whole = f"{found['chunks']} chunks and {found['messages']} messages are whole"
    if not found["chunks"]:
        whole = "nothing is recorded in it"
    return [f"{found['file']}: {_ended(found)}; {whole}{'' if found['damage'] else ', no damage'}"] + [
        f"  damage: {text}" for text in found["damage"]
    ]


def _each(
    arguments: argparse.Namespace,
    look: Callable[[Path], dict[str, Any]],
    lines: Callable[[dict[str, Any]], Iterable[str]],
) -> int:
    """Print what ``look`` finds in each file, as text made by ``lines`` or as JSON.

    ``look`` raises OSError or RecordingError for a file that is not a recording. In JSON, the error
    replaces the result. Return 1 if a file is damaged or not a recording.
    """
    found: list[dict[str, Any]] = []
    failed = False
    for file in arguments.files:
        try:
            described = look(file)
        except (RecordingError, OSError) as error:
            text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
            print(printable(text), file=sys.stderr)
            found.append({"error": text})
            failed = True
            continue
        failed = failed or bool(described["damage"])
        found.append(described)
        if not arguments.json:
            print("\n".join(map(printable, lines(described))), flush=True)
    if arguments.json:
        print(dumps(found[0] if len(arguments.files) == 1 else found, indent=2))
    return int(failed)


def _ended(found: dict[str, Any]) -> str:
    """Return as text how a file ends, from the keys ``closed`` and ``end``."""
    return "closed" if found["closed"] else not_closed(found["end"])
