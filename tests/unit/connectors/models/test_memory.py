"""The memory connector in the source's loop: a written value is visible at once, and stays."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from shmio.connectors import registry
from shmio.connectors.base import Computed
from shmio.connectors.models.stepped import PageClock, SteppedLoop
from shmio.connectors.poll_loop import Schedule
from shmio.errors import CommandError, ConfigError
from shmio.layout.compiler import Source, compile_sources
from shmio.local.reading import reading
from shmio.local.writer import SourceWriter
from shmio.model.values import OutcomeKind
from shmio.segment import Attributes, BlockSpec, Frame, ProcessSpec, Provenance, Quality, Segment

TABLE = b"""
[registers]
position = { type = "LREAL", initial = 0.5 }
lamps = "ARRAY[1..12] OF BOOL"
name = { type = "STRING[8]", initial = "R3200" }
locked = "INT"
"""
LAYOUT = compile_sources([Source("cell.toml", TABLE)]).layouts[0]
PERIOD_NS = 200_000_000
WRITABLE = ("position", "lamps", "name")


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    spec = BlockSpec("cell", LAYOUT, PERIOD_NS, 10 * PERIOD_NS, 1 << 20, Attributes("memory", WRITABLE, stepped=True))
    with Segment.create(instance, [spec], [ProcessSpec("cell", "source")]) as segment:
        yield segment
        segment.unlink()


@contextmanager
def running(segment: Segment) -> Iterator[SourceWriter]:
    """Run the source's process in threads, and yield a client that writes to it."""
    options = registry.convert_options("memory", {})
    memory = registry.load("memory")(options, LAYOUT)
    assert isinstance(memory, Computed)
    clock = PageClock(segment.clock, 0)
    schedule = Schedule(segment.header.started_ns, PERIOD_NS)
    cursor = segment.blocks["cell"].cursor()
    loop = SteppedLoop(memory, segment.writer("cell"), schedule, clock, WRITABLE)
    threads = [threading.Thread(target=run) for run in (loop.run, loop.commands.run)]
    for thread in threads:
        thread.start()
    try:
        while (frame := cursor.next(20)) is None or frame.quality is not Quality.GOOD:
            assert frame is not None, "no frame"
        yield SourceWriter(segment.blocks["cell"], 4)
    finally:
        clock.stop()
        for thread in threads:
            thread.join()


def values(segment: Segment, frame: Frame | None = None) -> dict[str, object]:
    block = segment.blocks["cell"]
    return {r.path: reading(block, r, frame or block.latest()).value for r in LAYOUT.registers}


def test_memory_begins_with_the_initial_values(segment: Segment) -> None:
    with running(segment):
        frame = segment.blocks["cell"].latest()
        assert frame is not None
        assert frame.provenance is Provenance.SIMULATED
        assert values(segment) == {"position": 0.5, "lamps": [False] * 12, "name": "R3200", "locked": 0}


def test_written_value_is_visible_at_once_and_stays(segment: Segment) -> None:
    cursor = segment.blocks["cell"].cursor()
    cycles: list[int] = []

    def until(path: str, value: object) -> None:
        while (frame := cursor.next(20)) is None or values(segment, frame)[path] != value:
            assert frame is not None, f"{path} was not seen as {value}"
        assert frame.cycle * PERIOD_NS <= frame.clock_ns, "the cycle of the frame has begun"
        cycles.append(frame.cycle)

    with running(segment) as source_writer:
        for number in range(20):
            (outcome,) = source_writer.write({"position": number + 0.25})
            assert outcome.kind is OutcomeKind.WRITTEN
            assert values(segment)["position"] == number + 0.25, "the outcome comes after the frame"
            until("position", number + 0.25)
        source_writer.write({"lamps/3": True, "name": "R800"})
        until("name", "R800")
        assert cursor.missed == 0
        assert cycles == sorted(cycles)
        assert cycles[-1] - cycles[0] < 20, "the writes do not wait for a cycle each"
    with running(segment):  # a successor process
        lamps = [place == 3 for place in range(1, 13)]
        assert values(segment) == {"position": 19.25, "lamps": lamps, "name": "R800", "locked": 0}


def test_register_that_is_not_writable_is_refused(segment: Segment) -> None:
    with running(segment) as source_writer:
        with pytest.raises(CommandError, match="not writable"):
            source_writer.write({"locked": 1})
        assert values(segment)["locked"] == 0


def test_connector_has_no_options() -> None:
    with pytest.raises(ConfigError, match="host"):
        registry.convert_options("memory", {"host": "10.0.0.1"})
