"""``shmio-dump diff``: compares two recordings."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from shmio.cli.common import dumps
from shmio.cli.recordings.common import Progress
from shmio.errors import RecordingError
from shmio.layout.values.codec import Value
from shmio.recording.compare import Comparison, Difference, Side, SourceDifference, compare
from shmio.recording.dump import open_dump
from shmio.recording.times import iso, local
from shmio.wording import printable

MAX_SHOWN = 50
"""Maximum number of registers, and of details, that the text output shows; ``--json`` prints all."""


def diff(arguments: argparse.Namespace) -> int:
    """Compare the recordings source by source; return 1 if anything differs."""
    first, second = arguments.files
    ignore = [word for words in arguments.ignore for word in words.split(",")]
    how = Comparison(ignore, arguments.only or (), arguments.tolerance, arguments.relative)
    with open_dump(first) as one, open_dump(second) as other, Progress(f"comparing {first}") as progress:
        progress.total = one.end_ns - one.begin_ns
        found = list(compare(one, other, how, arguments.sources, lambda time_ns: progress.at(time_ns - one.begin_ns)))
    if not found:
        raise RecordingError(f"{first} and {second}: they have nothing to compare")
    same = all(source.same for source in found)
    if arguments.json:
        print(dumps({"same": same, "files": [str(first), str(second)], "sources": list(map(_object, found))}, indent=2))
    else:
        for source in found:
            print("\n".join(map(printable, _lines(source))))
        print("the same" if same else "they differ")
    return 0 if same else 1


def _lines(found: SourceDifference) -> Iterator[str]:
    yield f"{found.source}: {_side(found.frames, 'frames')}; {_side(found.events, 'events')}"
    if found.timing.max_ns:
        median, p99 = found.timing.percentile_ns(50) / 1e6, found.timing.percentile_ns(99) / 1e6
        largest = f"{found.timing.max_ns / 1e6:.3g} ms (most)"
        yield f"  times since the first frame differ by {median:.3g} ms (median), {p99:.3g} ms (99 %), {largest}"
    for side, name in ((found.frames, "frame"), (found.events, "event")):
        if side.first is not None:
            yield f"  first difference: {name} {_where(side.first)}"
            yield from (f"    {text}" for text in side.first.what[:MAX_SHOWN])
            if len(side.first.what) > MAX_SHOWN:
                yield f"    and {len(side.first.what) - MAX_SHOWN} more"
    for name, count in found.fields.items():
        yield f"  {name} differs in {count} frames"
    for path, register in list(found.registers.items())[:MAX_SHOWN]:
        most = f", by at most {register.largest:.6g}" if register.largest else ""
        values = f"{register.values[0]} -> {register.values[1]}"
        yield f"  {path} differs in {register.count} frames{most}, first at {local(register.first[0])}: {values}"
    if len(found.registers) > MAX_SHOWN:
        yield f"  and {len(found.registers) - MAX_SHOWN} more"
    if found.missing:
        yield f"  only in one recording, or of different types: {', '.join(found.missing[:MAX_SHOWN])}"


def _side(side: Side, name: str) -> str:
    if side.same:
        return f"{side.compared} {name} are the same"
    alone = f", {side.only_first} only in the first, {side.only_second} only in the second"
    return f"{side.differing} of {side.compared} {name} differ{alone if side.only_first or side.only_second else ''}"


def _where(first: Difference) -> str:
    places = [
        f"{number} at {local(time_ns)}" if time_ns is not None else "none"
        for number, time_ns in zip(first.numbers, first.times_ns, strict=True)
    ]
    return " and ".join(places)


def _object(found: SourceDifference) -> dict[str, Any]:
    timing = found.timing
    return {
        "source": found.source,
        "same": found.same,
        "frames": _side_object(found.frames),
        "events": _side_object(found.events),
        "fields": found.fields,
        "registers": {
            path: {
                "count": register.count,
                "first": [iso(time_ns) for time_ns in register.first],
                "values": [_plain(value) for value in register.values],
                "largest": _plain(register.largest),
            }
            for path, register in found.registers.items()
        },
        "missing": found.missing,
        "timing_ms": {
            "median": timing.percentile_ns(50) / 1e6,
            "p99": timing.percentile_ns(99) / 1e6,
            "max": timing.max_ns / 1e6,
        },
    }


def _side_object(side: Side) -> dict[str, Any]:
    first = side.first
    return {
        "compared": side.compared,
        "differing": side.differing,
        "only_first": side.only_first,
        "only_second": side.only_second,
        "first": first
        and {
            "times": [time_ns and iso(time_ns) for time_ns in first.times_ns],
            "numbers": list(first.numbers),
            "what": first.what,
        },
    }


def _plain(value: Value) -> Any:
    """Return a value for JSON, in which NaN and infinities are text."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, float) and value - value != 0 else value
