"""``shmio-dump cat``: print a recording line by line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from shmio.cli.recordings.damage_report import DamageReport
from shmio.cli.recordings.each import not_closed
from shmio.cli.recordings.printers import Csv, JsonLines, Printer, Table, View
from shmio.cli.recordings.progress import Progress
from shmio.cli.recordings.times import time_range
from shmio.cli.run import room
from shmio.errors import PathError, RecordingError
from shmio.layout.glob import named
from shmio.layout.model import Layout, Register
from shmio.layout.topic import parse_topic
from shmio.logs import printable
from shmio.recording.format.channels import Channel
from shmio.recording.format.encoding import EVENT, FRAME, GAP, PROCESS, STEP, ProcessChange, StepMark
from shmio.recording.reading.reader import Message, Reader
from shmio.recording.reading.survey import Survey, survey
from shmio.recording.times import span
from shmio.segment import Event, Frame
from shmio.segment.explain import Explainer


def execute(arguments: argparse.Namespace) -> int:
    """Print a line for each frame in which a chosen value or the quality changed.

    Events, gaps and steps have lines, too. Damage is reported where it occurs; then the exit status
    is 1, and everything else is printed.
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
        return "nothing is recorded in it"
    return f"nothing of what was asked for is in it then; it goes {span(found.begin_ns, found.end_ns)}"


def _views(
    reader: Reader, channels: Sequence[Channel], patterns: Sequence[str], report: DamageReport
) -> dict[int, View]:
    """Return the blocks to show by the channel of their frames, without those with damaged layouts.

    Raises:
        PathError: A pattern names nothing.
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
        problem, some = PathError(f"{pattern}: no register of this recording has such a path"), False
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
    """Raise PathError with a remedy if a pattern is a file, as when the shell expands ``*.mem``."""
    for pattern in patterns:
        if Path(pattern).is_file():
            raise PathError(f"{pattern} is a file, but cat prints only one: shmio-dump merge FILE… -o NEW joins them")


def _layout(reader: Reader, channel: Channel) -> Layout | None:
    """Return the layout of a channel; None if it is damaged, which is reported with the frames."""
    try:
        return reader.layout(channel)
    except RecordingError:
        return None


def _lines(
    message: Message, views: dict[int, View], sources: set[str], printer: Printer, explainers: dict[int, Explainer]
) -> Iterator[str]:
    channel, time_ns, item = message
    if isinstance(item, Frame):
        if views[channel.number].news(item):
            yield from printer.frame(time_ns, views[channel.number], item)
    elif isinstance(item, Event):
        yield printer.event(time_ns, channel.source, item, explainers[channel.number].explain(item))
    elif isinstance(item, StepMark):
        yield printer.step(time_ns, item)
    elif isinstance(item, ProcessChange):
        yield printer.process(time_ns, item)
    elif item.source in sources:
        yield printer.gap(time_ns, item)
