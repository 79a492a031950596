"""Injections through a source's process: laid, fed and lifted by commands, seen in frames and events by everybody."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence

import msgspec
import pytest

from shmio.config import Declaration
from shmio.connectors.base import Connector
from shmio.connectors.injection_layers import MAX_INJECTIONS, Owner
from shmio.connectors.poll_loop import Schedule, SourceLoop, WallClock
from shmio.errors import CommandError, PathError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.values.codec import Value
from shmio.local.reading import reading
from shmio.local.writer import SourceWriter
from shmio.model.values import OutcomeKind, Reading
from shmio.segment import (  # fmt: skip
    Attributes,
    BlockSpec,
    Direction,
    Event,
    EventKind,
    Frame,
    ProcessSpec,
    Provenance,
    Quality,
    Segment,
    Write,
)

TABLE = b"""
[registers]
position = { type = "LREAL", initial = 0.5 }
lamps = { type = "ARRAY[0..9] OF BOOL", initial = [true] }
speed = "INT"
"axis/1" = "INT"
"axis/2" = "INT"
locked = "INT"
"""
LAYOUT = compile_sources([Source("cell.toml", TABLE)]).layouts[0]
WRITABLE = ("lamps", "speed", "axis")
PERIOD_NS = 10_000_000


class Device(Connector):
    """A device whose block can be written; its program counts ``position`` up at each read."""

    can_write = True

    def __init__(self) -> None:
        self.memory = bytearray(LAYOUT.size)
        self.writes: list[Write] = []

    @property
    def timeout_s(self) -> float:
        return 1.0

    def connect(self) -> None:
        pass

    def read(self) -> bytes:
        return bytes(self.memory)

    def write(self, writes: Sequence[Write]) -> list[str]:
        for offset, mask, data in writes:
            own = bytes([mask]) if mask else b"\xff" * len(data)
            for at, (bits, byte) in enumerate(zip(own, data, strict=True), offset):
                self.memory[at] = self.memory[at] & ~bits | byte & bits
        self.writes += writes
        return [""] * len(writes)

    def close(self) -> None:
        pass


class Rig:
    """A source's process in threads, and clients of it."""

    def __init__(self, segment: Segment, *, armed: bool = True) -> None:
        self.segment = segment
        self.block = segment.blocks["cell"]
        self.device = Device()
        self.owners = {4: Owner(4, 100), 5: Owner(5, 200)}
        self.asked: list[int] = []
        self.armed = armed
        self.client = SourceWriter(self.block, 4)
        self.other = SourceWriter(self.block, 5)
        self.frames = self.block.cursor()
        self.events = self.block.events.cursor()
        self.start()

    def start(self) -> None:
        self._clock = WallClock()
        schedule = Schedule(self.segment.header.started_ns, PERIOD_NS)
        writer = self.segment.writer("cell")
        loop = SourceLoop(
            self.device, writer, schedule, self._clock, WRITABLE, armed=self.armed, owner_of=self._owner_of
        )
        self._threads = [threading.Thread(target=run) for run in (loop.run, loop.commands.run)]
        for thread in self._threads:
            thread.start()
        self.until(lambda frame: frame.quality is Quality.GOOD)

    def _owner_of(self, writer: int) -> Owner | None:
        self.asked.append(writer)
        return self.owners.get(writer)

    def stop(self) -> None:
        self._clock.stop()
        for thread in self._threads:
            thread.join()

    def until(self, wanted: Callable[[Frame], bool]) -> Frame:
        while (frame := self.frames.next(20)) is None or not wanted(frame):
            assert frame is not None, "not seen"
        return frame

    def event(self, kind: EventKind) -> Event:
        while (event := self.events.next(20)) is None or event.kind != kind:
            assert event is not None, f"no event {kind}"
        return event

    def value(self, path: str, frame: Frame | None = None) -> Value:
        return self.reading(path, frame).value

    def reading(self, path: str, frame: Frame | None = None) -> Reading:
        register = LAYOUT.registers[LAYOUT.by_path[path]]
        return reading(self.block, register, frame or self.block.latest())

    def sees(self, values: Mapping[str, Value]) -> Frame:
        """Wait until consumers see these."""
        return self.until(lambda frame: all(self.value(path, frame) == value for path, value in values.items()))


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    spec = BlockSpec("cell", LAYOUT, PERIOD_NS, 10**9, 1 << 20, Attributes("device", WRITABLE))
    with Segment.create(instance, [spec], [ProcessSpec("cell", "source")]) as segment:
        yield segment
        segment.unlink()


@pytest.fixture
def rig(segment: Segment) -> Iterator[Rig]:
    rig = Rig(segment)
    yield rig
    rig.stop()


def test_consumers_hold_the_last_value_until_the_shadow_has_one(rig: Rig) -> None:
    rig.client.write({"speed": 7})
    rig.sees({"speed": 7})
    number = rig.client.inject(["speed"], name="test")
    rig.client.write({"speed": 9})
    frame = rig.until(lambda frame: frame.raw != frame.image)
    assert (rig.value("speed", frame), frame.provenance) == (7, Provenance.LIVE)
    assert [rig.reading(path).provenance for path in ("speed", "lamps")] == ["injected", "live"]
    rig.client.shadow(number, {"speed": -1})
    assert rig.value("speed") == -1, "it was not seen at once"
    rig.client.lift(number)
    last = rig.block.latest()
    assert last is not None
    assert (rig.value("speed", last), last.provenance, last.effective) == (9, Provenance.LIVE, None)


def test_events_tell_what_was_done(rig: Rig) -> None:
    number = rig.client.inject(["speed"], name="drive test", priority=3)
    laid = rig.event(EventKind.INJECTED)
    assert (laid.injection, laid.command, laid.writer, laid.text) == (number, number, 4, "drive test")
    (standing,) = rig.block.standing.read()
    assert json.loads(laid.data) == {
        "direction": "out", "priority": 3, "keep": False, "ranges": [list(standing.ranges[0])],
    }  # fmt: skip
    assert (standing.number, standing.direction, standing.priority, standing.name) == (number, "out", 3, "drive test")
    assert (standing.writer, standing.pid, standing.keep) == (4, 100, False)
    assert [register.path for register in LAYOUT.registers if standing.covers(register)] == ["speed"]
    rig.other.shadow(number, {"speed": 258})
    given = rig.event(EventKind.SHADOWED)
    assert (given.injection, given.writer, given.data) == (number, 5, b"\2\1")
    rig.other.lift(number)
    lifted = rig.event(EventKind.LIFTED)
    assert (lifted.injection, lifted.writer, lifted.text) == (number, 5, "lifted")
    assert rig.block.standing.read() == ()


def test_bits_elements_structures_and_whole_blocks(rig: Rig) -> None:
    lamp = rig.client.inject(["lamps/3"])
    rig.client.shadow(lamp, {"lamps/3": True})
    axis = rig.client.inject(["axis"], priority=1)
    rig.client.shadow(axis, {"axis/1": 5, "axis/2": 6})
    assert rig.value("lamps") == [place == 3 for place in range(10)]
    assert (rig.value("axis/1"), rig.value("axis/2")) == (5, 6)
    everything = rig.client.inject(["**"])
    rig.client.shadow(everything, {"lamps": [True] * 10, "axis/1": 1, "position": 1.5})
    assert rig.value("position") == 1.5
    assert rig.value("axis/1") == 5, "the higher priority is outermost"
    assert rig.value("lamps") == [True] * 10, "of equal ones the newest is"
    rig.client.lift(everything)
    assert rig.value("lamps") == [place == 3 for place in range(10)]


def test_what_is_written_goes_to_the_injection_and_its_values_to_the_device(rig: Rig) -> None:
    number = rig.client.inject(["lamps/2", "speed"], direction=Direction.IN)
    outcomes = rig.other.write({"speed": 20, "axis/1": 3})
    assert [(outcome.kind, outcome.done) for outcome in outcomes] == [
        (OutcomeKind.TAKEN, True),
        (OutcomeKind.WRITTEN, True),
    ]
    diverted = rig.event(EventKind.DIVERTED)
    assert (diverted.injection, diverted.writer, diverted.data) == (number, 5, b"\x14\0")
    rig.sees({"speed": 0, "axis/1": 3})
    (outcome,) = rig.client.shadow(number, {"speed": 21})
    assert outcome.kind is OutcomeKind.WRITTEN
    rig.sees({"speed": 21})
    accepted = rig.event(EventKind.ACCEPTED)
    while accepted.data != b"\x15\0":
        accepted = rig.event(EventKind.ACCEPTED)
    assert (accepted.injection, accepted.writer) == (number, 4)


def test_of_an_array_only_the_covered_bits_are_diverted(rig: Rig) -> None:
    number = rig.client.inject(["lamps/2"], direction=Direction.IN)
    (outcome,) = rig.other.write({"lamps": [True] * 10})
    assert outcome.kind is OutcomeKind.WRITTEN
    diverted = rig.event(EventKind.DIVERTED)
    assert (diverted.mask, diverted.injection) == (4, number)
    rig.sees({"lamps": [place != 2 for place in range(10)]})


def test_values_on_their_way_in_pass_the_inner_injections(rig: Rig) -> None:
    inner = rig.client.inject(["speed"], direction=Direction.IN)
    outer = rig.client.inject(["speed"], direction=Direction.IN)
    rig.other.write({"speed": 1})
    assert rig.event(EventKind.DIVERTED).injection == outer
    (outcome,) = rig.client.shadow(outer, {"speed": 2})
    assert outcome.kind is OutcomeKind.TAKEN
    assert rig.event(EventKind.DIVERTED).injection == inner
    (outcome,) = rig.client.shadow(inner, {"speed": 3})
    assert outcome.kind is OutcomeKind.WRITTEN
    rig.sees({"speed": 3})


def test_a_shadow_goes_when_its_client_does_unless_it_is_to_be_kept(rig: Rig) -> None:
    kept = rig.client.inject(["axis/1"], keep=True)
    rig.client.shadow(kept, {"axis/1": 11})
    other = rig.other.inject(["axis/2"])
    rig.other.shadow(other, {"axis/2": 12})
    gone = rig.client.inject(["speed"])
    rig.client.shadow(gone, {"speed": 13})
    rig.owners[4] = Owner(4, 101)  # another process has the queue by now
    lifted = rig.event(EventKind.LIFTED)
    assert (lifted.injection, lifted.text) == (gone, "its client is gone")
    rig.sees({"axis/1": 11, "axis/2": 12, "speed": 0})


def test_clients_are_looked_after_now_and_then_however_many_commands_come(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.connectors.injections.LOOK_NS", 10**15)
    rig.asked.clear()
    number = rig.client.inject(["speed"])
    for value in range(20):
        rig.client.shadow(number, {"speed": value})
    assert len(rig.asked) <= 2, "when it was laid, and at the first look"


def test_injections_outlive_the_sources_process(rig: Rig) -> None:
    number = rig.client.inject(["speed", "lamps/1"], name="test")
    rig.client.shadow(number, {"speed": 99, "lamps/1": True})
    rig.stop()
    rig.start()
    assert rig.value("speed") == 99
    assert rig.value("lamps") == [place == 1 for place in range(10)]
    rig.client.shadow(number, {"speed": 98})
    assert rig.value("speed") == 98
    del rig.owners[4]
    rig.sees({"speed": 0})


def test_values_beneath_other_injections_outlive_the_sources_process(rig: Rig) -> None:
    inner, outer = (rig.client.inject(["speed"], name=name) for name in ("inner", "outer"))
    more = {"name": "more", "target": "cell/speed", "operation": "offset", "value": 100, "priority": 1}
    rig.client.declare(msgspec.convert(more, Declaration))
    rig.client.shadow(inner, {"speed": 7})
    rig.client.shadow(outer, {"speed": 9})
    rig.sees({"speed": 109})
    rig.stop()
    rig.start()
    assert rig.value("speed") == 109, "it was added twice"
    rig.client.lift(outer)
    rig.sees({"speed": 107})


def test_what_cannot_be_is_refused(rig: Rig) -> None:
    with pytest.raises(PathError, match="names no register"):
        rig.client.inject(["speeds"])
    with pytest.raises(CommandError, match="covers registers that are not writable"):
        rig.client.inject(["locked"], direction=Direction.IN)
    number = rig.client.inject(["speed"], name="test")
    (outcome,) = rig.client.shadow(number, {"axis/1": 1})
    assert outcome.kind is OutcomeKind.REJECTED
    assert "not covered by the injection test" in outcome.text
    (outcome,) = rig.client.shadow(number + 1, {"speed": 1})
    assert f"there is no injection {number + 1}" in outcome.text
    with pytest.raises(CommandError, match="there is no injection"):
        rig.client.lift(number + 1)
    del rig.owners[5]
    with pytest.raises(CommandError, match=r"command queue .* has no owner"):
        rig.other.inject(["speed"])


def test_what_the_segment_has_no_room_for_is_refused(rig: Rig) -> None:
    name = "\1" * 256  # six characters each in the document that everybody reads
    laid: list[int] = []
    with pytest.raises(CommandError, match="injections of one source are too large"):
        laid.extend(rig.client.inject(["speed"], name=name) for _ in range(MAX_INJECTIONS))
    assert [standing.number for standing in rig.block.standing.read()] == laid
    rig.client.lift(laid[0])
    rig.client.inject(["speed"], name=name)


def test_toward_a_device_that_is_not_armed_nothing_is_injected(segment: Segment) -> None:
    rig = Rig(segment, armed=False)
    try:
        with pytest.raises(CommandError, match="needs `armed = true`"):
            rig.client.inject(["speed"], direction=Direction.IN)
        rig.client.inject(["speed"])
    finally:
        rig.stop()
