"""Builds recordings with the recorder's own writer. The test sets every byte and time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from shmio.layout.model import Layout, Register
from shmio.recorder.file_output import Output
from shmio.recording.format.encoding import Gap, ProcessChange, ProcessEvent, Reason, StepMark
from shmio.recording.writer import Channels, Writer
from shmio.segment import Block, Event, EventKind, Frame, Provenance, Quality, Record

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 20_000_000

LAYOUT = Layout(
    "DB1",
    1,
    16,
    False,
    (
        Register("count", "INT", (), 0, None, 2, 1),
        Register("speed", "REAL", (), 2, None, 4, 1),
        Register("on", "BOOL", (), 6, 3, 1, 1),
        Register("row", "INT", ((1, 3),), 8, None, 6, 3),
    ),
)


def image(count: int, speed: float = 0.0, *, on: bool = False) -> bytes:
    """Return an image of LAYOUT."""
    from shmio.layout.values.codec import codec

    data = bytearray(LAYOUT.size)
    for register, value in zip(LAYOUT.registers, (count, speed, on, [1, 2, count]), strict=True):
        codec(register).encode_into(value, data)
    return bytes(data)


class Build:
    """Builds one file. The time of a message follows from its cycle."""

    def __init__(self, file: Path, *, epoch: str = "00" * 8, first: int = 1) -> None:
        fd = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        self.output = Output(file, fd, limit_bytes=1 << 30)
        about = {"instance": "a50", "epoch": epoch, "recorder": "test", "started_utc_ns": str(START_NS)}
        self.writer = Writer(self.output, about)
        self.first = first
        self.blocks: dict[str, Channels] = {}
        self.events: dict[str, int] = {}

    def block(self, source: str, layout: Layout = LAYOUT, section: int = 1, after_event: int = 0) -> None:
        """Begin a block."""
        digest = layout.hash.hex()
        self.writer.attach(f"layouts/{digest}.json", "application/json", layout.to_json(), START_NS)
        block = SimpleNamespace(
            source=source, section=section, layout=layout, period_ns=PERIOD_NS, stale_ns=10 * PERIOD_NS
        )
        number = len(self.blocks) + 1
        self.events[source] = after_event
        self.blocks[source] = self.writer.open_block(cast("Block", block), number, self.first - 1, after_event)

    def frame(self, at: int, data: bytes, source: str = "cell", *, late_ns: int = 0, **other: Any) -> None:
        """Add a frame at its number's time, or ``late_ns`` later."""
        clock_ns = at * PERIOD_NS
        fields: dict[str, Any] = {
            "number": at,
            "cycle": at,
            "publish_ns": clock_ns,
            "clock_ns": clock_ns,
            "source_ns": START_NS + clock_ns,
            "incarnation": 1,
            "quality": Quality.GOOD,
            "provenance": Provenance.LIVE,
            "event": self.events.get(source, 0),
            "delay_us": 100,
            "reason": "",
            "raw": data,
            "effective": None,
        }
        self.writer.frame(self.blocks[source], Frame(**(fields | other)), START_NS + clock_ns + late_ns)

    def event(self, number: int, after: int, text: str = "", source: str = "cell", *, cycle: int | None = None) -> None:
        """Add an event after a frame. Its cycle is by default its number."""
        self.events[source] = number
        cycle = after if cycle is None else cycle
        clock_ns = cycle * PERIOD_NS
        utc_ns = START_NS + clock_ns
        event = Event(
            number, EventKind.QUALITY, after, cycle, clock_ns, clock_ns, utc_ns, 1, Quality.GOOD,
            0xFFFFFFFF, 0, 0, 0, 0, 0, 0, b"", text, 0,
        )  # fmt: skip
        self.writer.event(self.blocks[source], event, utc_ns)

    def tell(self, record: Record, after: int = 1, source: str = "cell") -> None:
        """Add an event of any kind after a frame."""
        self.events[source] += 1
        clock_ns = after * PERIOD_NS
        utc_ns = START_NS + clock_ns
        event = Event(
            self.events[source], record.kind, after, after, clock_ns, clock_ns, utc_ns, 1, Quality.GOOD,
            record.writer, record.command, record.item, record.items, record.offset, record.mask, record.size,
            record.data, record.text, record.injection,
        )  # fmt: skip
        self.writer.event(self.blocks[source], event, utc_ns)

    def gap(self, first: int, last: int, source: str = "cell", what: str = "frames") -> None:
        number = list(self.blocks).index(source) + 1
        before_ns = START_NS + (last + 1) * PERIOD_NS
        after_ns = START_NS + (first - 1) * PERIOD_NS
        gap = Gap(source, number, what, first, last, last - first + 1, Reason.OVERTAKEN, after_ns, before_ns)
        self.writer.gap(gap, before_ns)

    def step(self, step: int) -> None:
        """Add the end of a step."""
        self.writer.step(StepMark(step, step * PERIOD_NS, PERIOD_NS), START_NS + step * PERIOD_NS)

    def process(self, what: ProcessEvent, at: int) -> None:
        """Add a change of the source's process."""
        self.writer.process(ProcessChange("cell", "source", 4711, what, "", 0), START_NS + at * PERIOD_NS)

    def chunk(self) -> None:
        self.writer.flush()
        self.output.flush()


@contextmanager
def build(file: Path, **options: Any) -> Iterator[Build]:
    """Open a file to build, and close it at the end."""
    work = Build(file, **options)
    try:
        yield work
        work.writer.finish()
    finally:
        assert work.output.close(30)


def plain(file: Path, first: int = 1, last: int = 100, chunk: int = 10) -> Path:
    """Build a file with counting frames of one source; ``chunk`` is the number of frames in a chunk."""
    with build(file, first=first) as work:
        work.block("cell")
        for number in range(first, last + 1):
            work.frame(number, image(number, number / 2, on=number % 2 == 1))
            if number % chunk == 0:
                work.chunk()
    return file


def varied(file: Path, first: int = 1) -> Path:
    """Build a file with two sources and every kind of message. ``first`` is the number of the first frame."""
    with build(file, first=first) as work:
        work.block("cell", after_event=(first - 1) // 15)
        work.block("press", section=2)
        work.process(ProcessEvent.IS, first)
        for number in range(first, 61):
            if number % 20 == 7:
                work.frame(number, image(number), quality=Quality.BAD, reason="no answer")
            elif number % 20 == 9:
                work.frame(number, image(number), effective=image(1000 + number))
            elif number in (31, 32, 33):
                if number == 33:
                    work.gap(31, 33)
            else:
                work.frame(number, image(number))
            work.frame(number, image(-number), "press")
            if number % 15 == 0:
                work.event(number // 15, number, f"event {number // 15}")
            if number > 50:
                work.step(number)
            if number % 10 == 0:
                work.chunk()
    return file
