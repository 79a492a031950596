"""``shmio fabric top``: prints rate, size, lag and quality of each source, again and again."""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec

from shmio.cli.common import draw, dumps
from shmio.cli.fabric.access import with_client
from shmio.cli.instance.status import columns
from shmio.errors import RemoteError
from shmio.fabric.connection import is_stored
from shmio.fabric.fleet import Member, members
from shmio.fabric.live import live_source
from shmio.fabric.messages import decode_entries, decode_header
from shmio.fabric.names import ROOT
from shmio.fabric.registry import Registry
from shmio.segment import Frame
from shmio.wording import printable

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg

_HEADINGS = ("SOURCE", "FRAMES/S", "KB/S", "LAG", "LATE/S", "LOST", "QUALITY")


class Line(msgspec.Struct):
    """What a source sent during an interval.

    Attributes:
        source: Names of the cell and the source, as ``CELL/SOURCE``.
        frames_per_s: Frames of live messages, per second.
        kb_per_s: Size of live and late messages, in kB per second.
        lag_ms: Time from the making of a message to its receipt, by the clocks of both hosts: the
            longest of the interval. None: no live message came.
        late_per_s: Messages that the uplink sent again, per second.
        lost: Number of live messages that are missing between those that came.
        quality: Quality of the newest frame; without one, what the registry says.
        reason: Why the quality is not good.

    """

    source: str
    frames_per_s: float = 0.0
    kb_per_s: float = 0.0
    lag_ms: float | None = None
    late_per_s: float = 0.0
    lost: int = 0
    quality: str = ""
    reason: str = ""


class Counts:
    """Counts the messages of one source since the last interval."""

    def __init__(self) -> None:
        self._last = (0, 0)  # stream and number
        self.quality = self.reason = ""
        self.reset()

    def reset(self) -> None:
        """Begin a new interval."""
        self.frames = self.size = self.late = self.lost = 0
        self.lag_ns: int | None = None

    def add(self, data: bytes, now_ns: int, *, live: bool) -> None:
        """Count a message that was received at a UTC time.

        Raises:
            ValueError: The message is malformed.

        """
        header = decode_header(data)
        self.size += len(data)
        if not live:
            self.late += 1
            return
        stream, number = self._last
        if stream == header.stream and header.number > number + 1:
            self.lost += header.number - number - 1
        self._last = header.stream, header.number
        lag_ns = now_ns - header.made_ns
        self.lag_ns = lag_ns if self.lag_ns is None else max(self.lag_ns, lag_ns)
        for entry in decode_entries(data):
            if isinstance(entry, Frame):
                self.frames += 1
                self.quality, self.reason = str(entry.quality), entry.reason


def execute(options: argparse.Namespace) -> int:
    """Print a table for each interval until Ctrl-C, the end of the connection, or the given number of intervals."""
    with_client(options, lambda client: _top(client, options))
    return 0


async def _top(client: Client, options: argparse.Namespace) -> None:
    registry = await Registry.open(client)
    counts: dict[str, Counts] = {}

    async def take(message: Msg) -> None:
        if is_stored(message):
            return
        name = "/".join(live_source(message.subject))
        try:
            counts.setdefault(name, Counts()).add(message.data, time.time_ns(), live=message.subject.endswith(".live"))
        except ValueError as error:
            counts[name].quality, counts[name].reason = "bad", f"malformed message: {error}"

    for kind in ("live", "late"):
        await client.subscribe(f"{ROOT}.*.*.*.*.{kind}", cb=take)
    done = drawn = 0
    began_s = time.monotonic()
    while done != options.count:
        await asyncio.sleep(options.every_s)
        if client.is_closed:
            raise RemoteError("the connection to the fabric is lost")
        found = await members(registry)
        now_s = time.monotonic()
        lines = _lines(counts, found, now_s - began_s)
        began_s = now_s
        if options.json:
            for line in lines:
                print(dumps(msgspec.to_builtins(line)), flush=True)
        else:
            text = list(map(printable, [_summary(found, lines), *_table(lines)]))
            if sys.stdout.isatty():
                drawn = draw(text, drawn)
            else:
                print("\n".join([*text, ""]), flush=True)
        done += 1


def _lines(counts: dict[str, Counts], found: Sequence[Member], interval_s: float) -> list[Line]:
    """Return a line for each source, and begin a new interval."""
    lines: dict[str, Line] = {}
    for one in found:
        for source in one.sources:
            name = f"{one.cell}/{source.name}"
            quality, reason = (source.quality, source.reason) if one.alive else ("bad", f"the cell is {one.state}")
            lines[name] = Line(name, quality=quality, reason=reason)
    for name, count in counts.items():
        line = lines.setdefault(name, Line(name))
        line.frames_per_s = round(count.frames / interval_s, 1)
        line.kb_per_s = round(count.size / interval_s / 1000, 1)
        line.late_per_s = round(count.late / interval_s, 1)
        line.lost = count.lost
        line.lag_ms = None if count.lag_ns is None else round(count.lag_ns / 1e6, 2)
        if count.frames:
            line.quality, line.reason = count.quality, count.reason
        count.reset()
    return [lines[name] for name in sorted(lines)]


def _summary(found: Sequence[Member], lines: Sequence[Line]) -> str:
    states: dict[str, int] = {}
    for one in found:
        states[one.state] = states.get(one.state, 0) + 1
    cells = ", ".join(f"{count} {state}" for state, count in sorted(states.items())) or "none"
    frames, size = sum(line.frames_per_s for line in lines), sum(line.kb_per_s for line in lines)
    return f"cells: {cells}; {frames:.0f} frames/s, {size:.0f} kB/s"


def _table(lines: Sequence[Line]) -> list[str]:
    rows = [_HEADINGS]
    for line in lines:
        lag = "-" if line.lag_ms is None else f"{line.lag_ms:.1f} ms"
        quality = f"{line.quality}: {line.reason}" if line.reason else line.quality
        rows.append(
            (line.source, f"{line.frames_per_s:.1f}", f"{line.kb_per_s:.1f}", lag, f"{line.late_per_s:.1f}",
             str(line.lost), quality)
        )  # fmt: skip
    return columns(rows)
