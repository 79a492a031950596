"""``shmio-dump cat``: prints a recording line by line, as text, JSON or CSV."""

from __future__ import annotations

import argparse
import csv
import io
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final, Protocol

import msgspec

from shmio.cli.common import dumps, room
from shmio.cli.read import shown
from shmio.cli.recordings.common import DamageReport, Progress, not_closed, time_range
from shmio.errors import PathError, RecordingError
from shmio.layout.glob import named
from shmio.layout.model import Layout, Register
from shmio.layout.topic import parse_topic
from shmio.layout.values.codec import codec
from shmio.layout.values.text import json_value, to_text
from shmio.model.statuses import status_registers
from shmio.recording.columns import heading
from shmio.recording.format.encoding import EVENT, FRAME, GAP, PROCESS, STEP, Channel, Gap, ProcessChange, StepMark
from shmio.recording.reading.reader import Message, Reader
from shmio.recording.reading.survey import Survey, survey
from shmio.recording.times import iso, local, span
from shmio.segment import Event, EventKind, Frame, Quality
from shmio.segment.changed_registers import ChangeScan
from shmio.segment.explain import ABOUT, Explained, Explainer, cells_of, kind_of, object_of
from shmio.wording import EMPTY, printable

MAX_PLACES: Final = 4
"""Maximum number of an event's registers that the text output shows."""


def cat(arguments: argparse.Namespace) -> int:
    """Print a line for each frame in which a chosen value or the quality has changed.

    Events, gaps and steps have lines of their own. If parts of the recording are damaged, report
    each in its place, print the rest, and return 1.
    """
    report = DamageReport()
    with (
        Reader(arguments.file) as reader,
        Progress(f"reading {arguments.file}", silent=sys.stdout.isatty()) as progress,
    ):
        found = survey(reader)
        from_ns, to_ns = time_range(arguments, found.begin_ns)
        channels = [track.channel for track in found.tracks.values()]
        try:
            views = _views(reader, channels, arguments.patterns, report)
        except PathError:
            _one_file(arguments.patterns)
            raise
        sources = {view.source for view in views.values()} if arguments.patterns else {c.source for c in channels}
        printer = _printer(arguments, list(views.values()))
        wanted = {c.number for c in channels if c.number in views or (c.encoding == EVENT and c.source in sources)}
        wanted |= {
            c.number
            for c in channels
            if c.encoding == GAP or (c.encoding in (STEP, PROCESS) and not arguments.patterns)
        }
        explainers = {c.number: Explainer(c.source, _layout(reader, c)) for c in channels if c.encoding == EVENT}
        silent = True
        begin_ns = max(from_ns, found.begin_ns)
        progress.total = max(1, min(to_ns, found.end_ns) - begin_ns)
        for message in reader.messages(
            lambda channel: channel.number in wanted, from_ns, to_ns, partial(report.damage, arguments.file)
        ):
            progress.at(message.log_ns - begin_ns)
            for line in _lines(message, views, sources, printer, explainers):
                print(line)
                silent = False
        sys.stdout.flush()
        if silent:
            print(printable(f"{reader.file}: {_nothing(found)}"), file=sys.stderr)
        if not reader.records.closed:
            print(printable(f"{reader.file}: {not_closed(reader.records.damage)}"), file=sys.stderr)
    return int(report.any)


def _printer(arguments: argparse.Namespace, views: Sequence[View]) -> Printer:
    if arguments.csv:
        return Csv(views)
    return JsonLines() if arguments.json else Table(room(arguments))


def _nothing(found: Survey) -> str:
    """Return why nothing was printed."""
    if not found.begin_ns:
        return EMPTY
    return (
        f"nothing that you selected was recorded in that time; the recording goes {span(found.begin_ns, found.end_ns)}"
    )


def _views(
    reader: Reader, channels: Sequence[Channel], patterns: Sequence[str], report: DamageReport
) -> dict[int, View]:
    """Return the blocks to show, by the channel of their frames.

    Blocks with damaged layouts are missing.

    Raises:
        PathError: A pattern matches nothing.

    """
    blocks = {}
    for channel in channels:
        if channel.encoding == FRAME:
            try:
                blocks[channel.number] = channel, reader.layout(channel)
            except RecordingError as error:
                report.say(str(error))
    if not patterns:
        return {number: View(*block, block[1].registers) for number, block in blocks.items()}
    sources = list(dict.fromkeys(channel.source for channel, _ in blocks.values()))
    default = sources[0] if len(sources) == 1 else None
    chosen: dict[int, dict[str, Register]] = {}
    for pattern in patterns:
        topic = parse_topic(pattern, sources, default)
        problem, some = PathError(f"{pattern}: this recording has no such register"), False
        for number, (channel, layout) in blocks.items():
            if channel.source != topic.source:
                continue
            try:
                registers = {register.path: register for register in named(layout, topic)}
            except PathError as error:  # the pattern may fit a later layout of the source
                problem = error
            else:
                some = some or bool(registers)
                chosen[number] = chosen.get(number, {}) | registers
        if not some:
            raise problem
    return {number: View(*blocks[number], list(registers.values())) for number, registers in chosen.items()}


def _one_file(patterns: Sequence[str]) -> None:
    """Refuse a pattern that is a file. A shell makes such patterns when it expands ``*.mem``.

    Raises:
        PathError: A pattern is a file; the message has the remedy.

    """
    for pattern in patterns:
        if Path(pattern).is_file():
            raise PathError(
                f"{pattern} is a file, but cat prints only one; join the files with shmio-dump merge FILE… -o NEW"
            )


def _layout(reader: Reader, channel: Channel) -> Layout | None:
    """Return the layout of a channel; None if it is damaged.

    Reading the frames reports this damage.
    """
    try:
        return reader.layout(channel)
    except RecordingError:
        return None


def _lines(
    message: Message, views: dict[int, View], sources: set[str], printer: Printer, explainers: dict[int, Explainer]
) -> Iterator[str]:
    channel, time_ns, item = message
    if isinstance(item, Frame):
        if views[channel.number].take(item):
            yield from printer.frame(time_ns, views[channel.number], item)
    elif isinstance(item, Event):
        yield printer.event(time_ns, channel.source, item, explainers[channel.number].explain(item))
    elif isinstance(item, StepMark):
        yield printer.step(time_ns, item)
    elif isinstance(item, ProcessChange):
        yield printer.process(time_ns, item)
    elif item.source in sources:
        yield printer.gap(time_ns, item)


class View:
    """The chosen registers of one block, and the last frame that was printed."""

    def __init__(self, channel: Channel, layout: Layout, registers: Sequence[Register]) -> None:
        self.source = channel.source
        self.registers = (*registers, *status_registers(layout, registers, times=False))
        self.codecs = [codec(register, layout.byte_order) for register in self.registers]
        self._scan = ChangeScan(self.registers)
        self._shown: Frame | None = None

    def take(self, frame: Frame) -> bool:
        """Return whether a value or the quality differs from the last frame that was printed.

        If so, ``frame`` counts as printed.
        """
        shown = self._shown
        same = shown is not None and (shown.quality, shown.reason) == (frame.quality, frame.reason)
        if shown is not None and same and not self._scan.changed(shown.image, frame.image):
            return False
        self._shown = frame
        return True


class Printer(Protocol):
    """Formats entries of a recording as lines."""

    def frame(self, time_ns: int, view: View, frame: Frame) -> Iterator[str]:
        """Format the chosen values of a frame."""

    def event(self, time_ns: int, source: str, event: Event, explained: Explained) -> str:
        """Format an event, with its registers and their values."""

    def gap(self, time_ns: int, gap: Gap) -> str:
        """Format a gap."""

    def step(self, time_ns: int, mark: StepMark) -> str:
        """Format a step of virtual time."""

    def process(self, time_ns: int, change: ProcessChange) -> str:
        """Format a change of a process."""


def _where(event: Event, explained: Explained, room: int | None) -> str:
    """Return an event's registers as text with direction and values, or else its range of bytes."""
    if not explained.places:
        return f"{event.size} bytes at {event.offset}" if event.size and not event.data.startswith(b"{") else ""
    way = f"/{explained.direction}" if explained.direction else ""
    texts = [
        f"{printable(place.path)}{way}{f' = {shown(place.value, place.register, room)}' if place.valued else ''}"
        for place in explained.places[:MAX_PLACES]
    ]
    more = len(explained.places) - MAX_PLACES
    return ", ".join(texts) + (f" and {more} more" if more > 0 else "")


def _definition(definition: dict[str, Any]) -> str:
    """Return an injection's definition as text, without keys that the event's line already has."""
    return ", ".join(f"{key} = {dumps(value)}" for key, value in definition.items() if key not in ("name", "direction"))


class JsonLines:
    """Formats each entry as a line with one JSON object, with times in UTC."""

    def frame(self, time_ns: int, view: View, frame: Frame) -> Iterator[str]:
        """Format a frame, with its ``values`` by path.

        All values are null until the source has its first value.
        """
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

    def event(self, time_ns: int, source: str, event: Event, explained: Explained) -> str:
        """Format an event; the key ``event`` is its number."""
        fields = {name: getattr(event, name) for name in ("cycle", "incarnation", "writer")}
        return self._line(
            time_ns,
            source,
            event=event.number,
            kind=kind_of(event),
            after_frame=event.frame,
            quality=str(event.quality),
            **fields,
            **object_of(event, explained),
        )

    def gap(self, time_ns: int, gap: Gap) -> str:
        """Format a gap; the key ``missed`` is the number of missing frames or events."""
        return self._line(
            time_ns, gap.source, missed=gap.count, what=gap.what, first=gap.first, last=gap.last, why=str(gap.reason)
        )

    def step(self, time_ns: int, mark: StepMark) -> str:
        """Format a step, which belongs to no source.

        ``step`` is its number, ``clock_ns`` the time after it.
        """
        return dumps({"time": iso(time_ns), "step": mark.step, "clock_ns": mark.time_ns, "dt_ns": mark.dt_ns})

    def process(self, time_ns: int, change: ProcessChange) -> str:
        """Format a change of a process, with the keys that the change has in the recording."""
        return dumps({"time": iso(time_ns), "process": msgspec.to_builtins(change)})

    def _line(self, time_ns: int, source: str, **fields: Any) -> str:
        return dumps({"time": iso(time_ns), "source": source, **fields})


class Table:
    """Formats each entry as a line with columns. It prints headings whenever the block changes."""

    def __init__(self, room: int | None) -> None:
        """Create the formatter. ``room`` is the maximum number of characters of a value; None for no limit."""
        self._room = room
        self._view: View | None = None
        self._widths: list[int] = []

    def frame(self, time_ns: int, view: View, frame: Frame) -> Iterator[str]:
        """Format a frame's values, and its quality if that is not good."""
        known = frame.source_ns != 0
        cells = [
            shown(decode.decode(frame.image) if known else None, register, self._room)
            for register, decode in zip(view.registers, view.codecs, strict=True)
        ]
        if view is not self._view:
            self._view = view
            names = [printable(register.path) for register in view.registers]
            self._widths = [max(map(len, pair)) for pair in zip(names, cells, strict=True)]
            yield f"{'time':<23}  {view.source}  frame  {self._row(names)}".rstrip()
        quality = "" if frame.quality is Quality.GOOD else f"  {frame.quality}: {printable(frame.reason)}"
        yield f"{local(time_ns)}  {view.source}  {frame.number:<5}  {self._row(cells)}{quality}".rstrip()

    def event(self, time_ns: int, source: str, event: Event, explained: Explained) -> str:
        """Format an event: kind, reason, and the details of a command or an injection."""
        what = f"{kind_of(event)} {event.quality}" if event.kind == EventKind.QUALITY else kind_of(event)
        if where := _where(event, explained, self._room):
            what += f" {where}"
        if explained.by:
            what += f" by {printable(explained.by)}"
        if event.command and event.kind != EventKind.NOTED:
            what += f", command {event.command}.{event.item}"
        text = f": {printable(event.text)}" if event.text else ""
        definition = f" {printable(_definition(explained.definition))}" if explained.definition else ""
        return f"{local(time_ns)}  {source}  event {event.number} after frame {event.frame}: {what}{text}{definition}"

    def gap(self, time_ns: int, gap: Gap) -> str:
        """Format a gap: the number of missing frames or events, their range, and the reason."""
        source = printable(gap.source)
        return f"{local(time_ns)}  {source}  {gap.count} {gap.what} missed, {gap.first} to {gap.last}: {gap.reason}"

    def step(self, time_ns: int, mark: StepMark) -> str:
        """Format a step: its number, and the time after it."""
        return f"{local(time_ns)}  step {mark.step} of {mark.dt_ns / 1e6:g} ms is done: {mark.time_ns / 1e9:g} s"

    def process(self, time_ns: int, change: ProcessChange) -> str:
        """Format a change of a process: name, change and reason."""
        pid = f", pid {change.pid}" if change.pid else ""
        why = f": {printable(change.why)}" if change.why else ""
        return f"{local(time_ns)}  process {printable(change.name)} {change.what}{pid}{why}"

    def _row(self, cells: Sequence[str]) -> str:
        return "  ".join(cell.ljust(width) for cell, width in zip(cells, self._widths, strict=True))


class Csv:
    """Formats each entry as a CSV row (RFC 4180), with one heading row and times in UTC.

    Each register of each block has a column. The column's name includes the source if there are
    several sources, or if another column has the same name. Arrays are JSON. A field is empty if
    the source has had no value yet, or if the register belongs to another block.
    """

    OWN = ("time", "source", "what", "number", "quality", "text", *ABOUT)

    def __init__(self, views: Sequence[View]) -> None:
        several = len({view.source for view in views}) > 1
        self._names = [
            [
                f"{view.source}/{register.path}" if several else heading(view.source, register.path, self.OWN)
                for register in view.registers
            ]
            for view in views
        ]
        self._columns = {name: place for place, name in enumerate(dict.fromkeys(chain(*self._names)))}
        self._views = list(views)
        self._begun = False

    def frame(self, time_ns: int, view: View, frame: Frame) -> Iterator[str]:
        """Format a frame: the column ``what`` is ``frame``, ``text`` is the reason for its quality."""
        values = [""] * len(self._columns)
        if frame.source_ns != 0:
            names = self._names[self._views.index(view)]
            for name, register, decode in zip(names, view.registers, view.codecs, strict=True):
                values[self._columns[name]] = to_text(decode.decode(frame.image), register)
        yield self._row(time_ns, view.source, "frame", frame.number, str(frame.quality), frame.reason, values)

    def event(self, time_ns: int, source: str, event: Event, explained: Explained) -> str:
        """Format an event: the column ``what`` is the kind of the event."""
        row = time_ns, source, kind_of(event), event.number, str(event.quality), event.text
        return self._row(*row, about=cells_of(explained, dumps))

    def gap(self, time_ns: int, gap: Gap) -> str:
        """Format a gap: the column ``number`` is the number of the first missing frame or event."""
        return self._row(time_ns, gap.source, f"missed {gap.count} {gap.what}", gap.first, "", str(gap.reason))

    def step(self, time_ns: int, mark: StepMark) -> str:
        """Format a step, which belongs to no source."""
        return self._row(time_ns, "", "step", mark.step, "", "")

    def process(self, time_ns: int, change: ProcessChange) -> str:
        """Format a change of a process: the column ``number`` is its pid, ``text`` its name and the reason."""
        text = f"{change.name}: {change.why}" if change.why else change.name
        return self._row(time_ns, "", f"process {change.what}", change.pid, "", text)

    def _row(
        self,
        time_ns: int,
        source: str,
        what: str,
        number: int,
        quality: str,
        text: str,
        values: Sequence[str] = (),
        about: Sequence[str] = ("",) * len(ABOUT),
    ) -> str:
        lines = io.StringIO(newline="")
        writer = csv.writer(lines, lineterminator="\n")
        if not self._begun:
            self._begun = True
            writer.writerow([*self.OWN, *self._columns])
        filled = values or [""] * len(self._columns)
        writer.writerow([iso(time_ns), source, what, number, quality, text, *about, *filled])
        return lines.getvalue().removesuffix("\n")
