"""Helpers for tests of replays: make recordings, and run a replay's process in threads."""

from __future__ import annotations

import os
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from shmio.connectors.injection_layers import Owner
from shmio.connectors.models.stepped import PageClock
from shmio.connectors.replay.loop import ReplayLoop
from shmio.connectors.replay.source import Replay, begin
from shmio.layout.model import Layout, Register
from shmio.segment import (
    Attributes,
    BlockSpec,
    BlockWriter,
    Event,
    EventKind,
    Frame,
    Origin,
    ProcessSpec,
    Quality,
    Record,
    Segment,
    Stamp,
)
from tests.unit.recorder.harness import recorder

LAYOUT = Layout(
    "DB1", 1, 4, False, (Register("count", "INT", (), 0, None, 2, 1), Register("other", "INT", (), 2, None, 2, 1))
)
MS = 1_000_000
S = 1_000 * MS
PERIOD_NS = 20 * MS
BEGIN_NS = 100 * S
"""Instance clock of the first frame of a recording."""
PATIENCE_S = 20.0


def image(count: int, other: int = 0) -> bytes:
    """Return an image of LAYOUT with these values."""
    return struct.pack(">HH", count, other)


class Recorded:
    """A source of an instance that is recorded. The test sets the time of each frame and event."""

    def __init__(self, segment: Segment, source: str, take: Callable[[], object]) -> None:
        self._segment = segment
        self.take = take
        """Let the recorder write what was published so far."""
        self.writer = BlockWriter(segment.blocks[source], segment.clock_ns)
        self.cycle = 5_000

    def stamp(self, clock_ns: int) -> Stamp:
        """Return the stamp for a time of the recorded instance."""
        return Stamp(self._segment.header.started_ns + clock_ns, clock_ns, 7_000 * S + clock_ns)

    def frame(self, clock_ns: int, raw: bytes, **told: Any) -> None:
        at = self.stamp(clock_ns)
        self.cycle += 1
        self.writer.publish(raw, cycle=self.cycle, source_ns=clock_ns, asked_ns=at.publish_ns - 3000, at=at, **told)

    def event(self, clock_ns: int, record: Record, quality: Quality = Quality.GOOD) -> None:
        self.writer.cycle = self.cycle
        self.writer.event(record, quality=quality, at=self.stamp(clock_ns))


@contextmanager
def recorded(folder: Path, instance: str, *sources: str, name: str = "") -> Iterator[list[Recorded]]:
    """Record an instance to the folder. The instance started long before the recording."""
    specs = [BlockSpec(source, LAYOUT, PERIOD_NS, 500 * MS, 1 << 22) for source in sources or ("cell",)]
    origin = Origin(BEGIN_NS - S, 7_000 * S)
    with Segment.create(f"{instance}{name}-recorded", specs, [], origin=origin) as segment:
        taking = recorder(segment, folder)
        yield [Recorded(segment, spec.source, taking.run_once) for spec in specs]
        taking.close()
        segment.unlink()


def record(folder: Path, instance: str, *sources: str, frames: int = 20) -> Path:
    """Record sources that count from 0; by default one source. The register ``other`` is 1 from count 10 on."""
    folder.mkdir(exist_ok=True)
    with recorded(folder, instance, *sources) as all_of_them:
        for number in range(frames):
            for one in all_of_them:
                one.frame(BEGIN_NS + number * PERIOD_NS, image(number, number >= 10))
    [file] = folder.glob("*.mem")
    return file


@contextmanager
def built(instance: str, *names: str, stepped: bool = True, origin: Origin | None = None) -> Iterator[Segment]:
    """Create the segment of an instance that replays."""
    attributes = Attributes("replay", ("count",), stepped=True, replay=True)
    blocks = [BlockSpec(name, LAYOUT, PERIOD_NS, 500 * MS, 1 << 22, attributes) for name in names or ("cell",)]
    processes = [*(ProcessSpec(block.source, "source") for block in blocks), ProcessSpec("grpc", "grpc")]
    with Segment.create(instance, blocks, processes, stepped=stepped, origin=origin) as segment:
        yield segment
        segment.unlink()


class Playing:
    """The process of a replay, run in threads."""

    def __init__(self, segment: Segment, file: Path | list[str], name: str = "cell", **options: Any) -> None:
        self._stack = ExitStack()
        files = [str(file)] if isinstance(file, Path) else file
        own = self._stack.enter_context(Segment.open(segment.instance, writable=True))
        slot = own.processes.find(name)
        assert slot.take()
        self.source = Replay(Replay.Options(file=files, **options), name)
        self._stack.callback(self.source.close)
        self.block = own.blocks[name]
        self.cursor, self.events = self.block.cursor(), self.block.events.cursor()
        beginning = begin(self.source, self.block, own.header.started_ns, own.blocks.values())
        self.clock = PageClock(own.clock, slot.index)
        self.loop = ReplayLoop(
            self.source,
            own.writer(name, beginning.at),
            beginning,
            self.clock,
            self.block.attributes.writable,
            owner_of=lambda writer: Owner(writer, os.getpid()),
            blocks=lambda: own.blocks,
        )
        self._threads = [threading.Thread(target=run) for run in (self.loop.run, self.loop.commands.run)]
        for thread in self._threads:
            thread.start()

    def next(self, where: Callable[[Frame], bool] = lambda _: True) -> Frame:
        """Return the next frame for which ``where`` is true."""
        while True:
            frame = self.cursor.next(PATIENCE_S)
            assert frame is not None, "no frame"
            if where(frame):
                return frame

    def frames(self) -> list[Frame]:
        """Return the frames that were published since the last call."""
        return list(iter(self.cursor.poll, None))

    def happened(self) -> list[Event]:
        """Return the events since the last call, except STARTED and STOPPED."""
        told = list(iter(self.events.poll, None))
        return [event for event in told if event.kind not in (EventKind.STARTED, EventKind.STOPPED)]

    def until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition that becomes true when the process rings the doorbell."""
        until_s = time.monotonic() + PATIENCE_S
        while True:
            seen = self.block.ring.doorbell()
            if condition():
                return
            assert time.monotonic() < until_s, "the condition is not true"
            self.block.ring.wait(seen, round(PATIENCE_S * 1e9))

    def stop(self) -> None:
        """Stop the process and wait for its end."""
        self.clock.stop()
        for thread in self._threads:
            thread.join()
        self._stack.close()

    def __enter__(self) -> Playing:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def counts(frames: list[Frame]) -> list[int]:
    """Return the register ``count`` of each frame."""
    return [int.from_bytes(frame.raw[:2], "big") for frame in frames]
