"""``shmio-dump cat``: what happened, line by line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import msgspec

from shmio.cli.dumping.moments import MAX_NS, iso, local, lost, parse_time
from shmio.cli.readings import shown
from shmio.cli.run import dumps
from shmio.dump.channels import Channel
from shmio.dump.damage import Damage
from shmio.dump.encoding import EVENT, FRAME, GAP, PROCESS, STEP, Gap, ProcessChange, StepMark
from shmio.dump.reader import Message, Reader
from shmio.dump.survey import Survey, survey
from shmio.errors import PathError, RecordingError
from shmio.layout.codec import codec
from shmio.layout.glob import named
from shmio.layout.model import Layout, Register
from shmio.layout.text import json_value
from shmio.layout.topic import parse_topic
from shmio.logs import printable
from shmio.segment import Event, EventKind, Frame, Quality
from shmio.segment.scan import ChangeScan


def execute(arguments: argparse.Namespace) -> int:
    """Print a line for each frame in which a chosen value or the quality changed, and for events, gaps and steps.

    1 if something was damaged: all the rest is printed, and where something is lost is told.
    """
    complaints = Complaints(arguments.file)
    with Reader(arguments.file) as reader:
        found = survey(reader)
        start_ns = min((track.first_ns for track in found.tracks.values() if track.channel.source), default=0)
        from_ns = parse_time("--from", arguments.begin, start_ns, 0)
        to_ns = parse_time("--to", arguments.end, start_ns, MAX_NS)
        channels = [track.channel for track in found.tracks.values()]
        views = _views(reader, channels, arguments.patterns, complaints)
        sources = {view.source for view in views.values()} if arguments.patterns else {c.source for c in channels}
        printer: Printer = JsonLines() if arguments.json else Table()
        wanted = {c.number for c in channels if c.number in views or (c.encoding == EVENT and c.source in sources)}
        wanted |= {
            c.number
            for c in channels
            if c.encoding == GAP or (c.encoding in (STEP, PROCESS) and not arguments.patterns)
        }
        damaged, silent = complaints.damage, True
        for message in reader.messages(lambda channel: channel.number in wanted, from_ns, to_ns, damaged):
            for line in _lines(message, views, sources, printer):
                print(line)
                silent = False
        sys.stdout.flush()
        if silent:
            print(printable(f"{reader.file}: {_nothing(found)}"), file=sys.stderr)
        if not reader.records.closed:
            end = printable(f"{reader.file} was not closed: {reader.records.damage}")
            print(end, file=sys.stderr)
    return int(complaints.any)


def _nothing(found: Survey) -> str:
    """Why nothing was printed."""
    tracks = [track for track in found.tracks.values() if track.channel.source]
    if not tracks:
        return "nothing is recorded in it"
    first_ns, last_ns = min(track.first_ns for track in tracks), max(track.last_ns for track in tracks)
    return f"nothing of what was asked for is in it then; it goes from {local(first_ns)} to {local(last_ns)}"


class Complaints:
    """Tells on standard error what cannot be printed, where the rest of the output has come to."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self.any = False

    def damage(self, damage: Damage) -> None:
        """A part of the file is lost."""
        self.say(f"{self._file}: {lost(damage)}")

    def say(self, text: str) -> None:
        """One line; the exit status will be 1."""
        self.any = True
        sys.stdout.flush()
        print(printable(text), file=sys.stderr, flush=True)


class View:
    """The chosen registers of one block, and what was shown of them last."""

    def __init__(self, channel: Channel, layout: Layout, registers: Sequence[Register]) -> None:
        self.source = channel.source
        self.registers = registers
        self.codecs = [codec(register, layout.byte_order) for register in registers]
        self._scan = ChangeScan(registers)
        self._shown: Frame | None = None

    def news(self, frame: Frame) -> bool:
        """Whether a value or the quality differs from the frame shown before; if so, this one is shown."""
        shown = self._shown
        same = shown is not None and (shown.quality, shown.reason) == (frame.quality, frame.reason)
        if shown is not None and same and not self._scan.changed(shown.image, frame.image):
            return False
        self._shown = frame
        return True


class Printer(Protocol):
    """How things are put into lines."""

    def frame(self, time_ns: int, view: View, frame: Frame) -> Iterator[str]:
        """A frame's chosen values."""

    def event(self, time_ns: int, source: str, event: Event) -> str:
        """An event."""

    def gap(self, time_ns: int, gap: Gap) -> str:
        """What was missed."""

    def step(self, time_ns: int, mark: StepMark) -> str:
        """The end of a step."""

    def process(self, time_ns: int, change: ProcessChange) -> str:
        """What has happened to a process."""


def _views(
    reader: Reader, channels: Sequence[Channel], patterns: Sequence[str], complaints: Complaints
) -> dict[int, View]:
    """By their frames' channels the blocks of which something is to be shown. PathError: a pattern names nothing.

    Of a block whose layout is damaged nothing can be.
    """
    blocks = {}
    for channel in channels:
        if channel.encoding == FRAME:
            try:
                blocks[channel.number] = channel, reader.layout(channel)
            except RecordingError as error:
                complaints.say(str(error))
    if not patterns:
        return {number: View(*block, block[1].registers) for number, block in blocks.items()}
    sources = list(dict.fromkeys(channel.source for channel, _ in blocks.values()))
    default = sources[0] if len(sources) == 1 else None
    chosen: dict[int, dict[str, Register]] = {}
    for pattern in patterns:
        topic = parse_topic(pattern, sources, default)
        problem, some = PathError(f"{pattern}: no register of this recording has such a path"), False
        for number, (channel, layout) in blocks.items():
            if channel.source != topic.source:
                continue
            try:
                registers = {register.path: register for register in named(layout, topic)}
            except PathError as error:  # it may be in the layout that came after a change
                problem = error
            else:
                some = some or bool(registers)
                chosen[number] = chosen.get(number, {}) | registers
        if not some:
            raise problem
    return {number: View(*blocks[number], list(registers.values())) for number, registers in chosen.items()}


def _lines(message: Message, views: dict[int, View], sources: set[str], printer: Printer) -> Iterator[str]:
    channel, time_ns, item = message
    if isinstance(item, Frame):
        if views[channel.number].news(item):
            yield from printer.frame(time_ns, views[channel.number], item)
    elif isinstance(item, Event):
        yield printer.event(time_ns, channel.source, item)
    elif isinstance(item, StepMark):
        yield printer.step(time_ns, item)
    elif isinstance(item, ProcessChange):
        yield printer.process(time_ns, item)
    elif item.source in sources:
        yield printer.gap(time_ns, item)


def _kind(event: Event) -> str:
    try:
        return str(EventKind(event.kind))
    except ValueError:  # of a later version
        return f"kind {event.kind}"


class JsonLines:
    """An object a line, times in UTC."""

    def frame(self, time_ns: int, view: View, frame: Frame) -> Iterator[str]:
        """``values`` by path, null for all of them where the source never had any."""
        known = frame.source_ns != 0
        values = {
            register.path: json_value(decode.decode(frame.image), register.element) if known else None
            for register, decode in zip(view.registers, view.codecs, strict=True)
        }
        yield self._line(
            time_ns,
            view.source,
            frame=frame.number,
            cycle=frame.cycle,
            quality=str(frame.quality),
            reason=frame.reason,
            provenance=str(frame.provenance),
            values=values,
        )

    def event(self, time_ns: int, source: str, event: Event) -> str:
        """``event`` is its number; ``data`` in hexadecimal digits."""
        fields = {name: getattr(event, name) for name in ("cycle", "incarnation", "writer", "command", "item", "items")}
        fields |= {name: getattr(event, name) for name in ("offset", "mask", "size", "text")}
        return self._line(
            time_ns,
            source,
            event=event.number,
            kind=_kind(event),
            after_frame=event.frame,
            quality=str(event.quality),
            **fields,
            data=event.data.hex(),
        )

    def gap(self, time_ns: int, gap: Gap) -> str:
        """``missed`` is how many."""
        return self._line(
            time_ns, gap.source, missed=gap.count, what=gap.what, first=gap.first, last=gap.last, why=str(gap.reason)
        )

    def step(self, time_ns: int, mark: StepMark) -> str:
        """``step`` is its number, ``clock_ns`` the instance's clock after it; it is of no source."""
        return dumps({"time": iso(time_ns), "step": mark.step, "clock_ns": mark.time_ns, "dt_ns": mark.dt_ns})

    def process(self, time_ns: int, change: ProcessChange) -> str:
        """As it is in the file."""
        return dumps({"time": iso(time_ns), "process": msgspec.to_builtins(change)})

    def _line(self, time_ns: int, source: str, **fields: Any) -> str:
        return dumps({"time": iso(time_ns), "source": source, **fields})


class Table:
    """A line with columns, under headings when the block is another than before."""

    def __init__(self) -> None:
        self._view: View | None = None
        self._widths: list[int] = []

    def frame(self, time_ns: int, view: View, frame: Frame) -> Iterator[str]:
        """The values; quality is said unless it is good."""
        known = frame.source_ns != 0
        cells = [
            shown(decode.decode(frame.image) if known else None, register)
            for register, decode in zip(view.registers, view.codecs, strict=True)
        ]
        if view is not self._view:
            self._view = view
            names = [printable(register.path) for register in view.registers]
            self._widths = [max(map(len, pair)) for pair in zip(names, cells, strict=True)]
            yield f"{'time':<23}  {view.source}  frame  {self._row(names)}".rstrip()
        quality = "" if frame.quality is Quality.GOOD else f"  {frame.quality}: {printable(frame.reason)}"
        yield f"{local(time_ns)}  {view.source}  {frame.number:<5}  {self._row(cells)}{quality}".rstrip()

    def event(self, time_ns: int, source: str, event: Event) -> str:
        """Kind and reason, and of a command which bytes."""
        what = f"{_kind(event)} {event.quality}" if event.kind == EventKind.QUALITY else _kind(event)
        if event.command and event.kind != EventKind.NOTED:
            what += (
                f" command {event.command}.{event.item} of writer {event.writer}: {event.size} bytes at {event.offset}"
            )
        text = f": {printable(event.text)}" if event.text else ""
        return f"{local(time_ns)}  {source}  event {event.number} after frame {event.frame}: {what}{text}"

    def gap(self, time_ns: int, gap: Gap) -> str:
        """How many, which, why."""
        source = printable(gap.source)
        return f"{local(time_ns)}  {source}  {gap.count} {gap.what} missed, {gap.first} to {gap.last}: {gap.reason}"

    def step(self, time_ns: int, mark: StepMark) -> str:
        """Number, and the time after it."""
        return f"{local(time_ns)}  step {mark.step} of {mark.dt_ns / 1e6:g} ms is done: {mark.time_ns / 1e9:g} s"

    def process(self, time_ns: int, change: ProcessChange) -> str:
        """Name, what, why."""
        pid = f", pid {change.pid}" if change.pid else ""
        why = f": {printable(change.why)}" if change.why else ""
        return f"{local(time_ns)}  process {printable(change.name)} {change.what}{pid}{why}"

    def _row(self, cells: Sequence[str]) -> str:
        return "  ".join(cell.ljust(width) for cell, width in zip(cells, self._widths, strict=True))
