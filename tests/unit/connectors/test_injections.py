"""Injections in a source's process: commands lay, feed and lift them; frames and events show them."""

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
from shmio.layout.values.codec import Value
from shmio.model.values import OutcomeKind
from shmio.segment import Direction, Event, EventKind, Frame, Provenance, Quality, Segment, Write
from tests.unit.connectors.harness import PERIOD_NS, SourceRig, block, source_segment, tag_layout

LAYOUT = tag_layout("""
position = { type = "LREAL", initial = 0.5 }
lamps = { type = "ARRAY[0..9] OF BOOL", initial = [true] }
speed = "INT"
"axis/1" = "INT"
"axis/2" = "INT"
locked = "INT"
""")
WRITABLE = ("lamps", "speed", "axis")


class Device(Connector):
    """A device whose block can be written."""

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


class Rig(SourceRig):
    """A source's process with its loop, run in threads, and its clients."""

    def __init__(self, segment: Segment, *, armed: bool = True) -> None:
        super().__init__(segment)
        self.device = Device()
        self.asked: list[int] = []
        self.armed = armed
        self.frames = self.block.cursor()
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
            assert frame is not None, "no such frame"
        return frame

    def event(self, kind: EventKind) -> Event:
        while (event := self.events.next(20)) is None or event.kind != kind:
            assert event is not None, f"no event {kind}"
        return event

    def sees(self, values: Mapping[str, Value]) -> Frame:
        """Wait until consumers see these values."""
        return self.until(lambda frame: all(self.value(path, frame) == value for path, value in values.items()))


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    with source_segment(instance, block(LAYOUT, WRITABLE)) as segment:
        yield segment


@pytest.fixture
def rig(segment: Segment) -> Iterator[Rig]:
    rig = Rig(segment)
    yield rig
    rig.stop()


def test_consumers_keep_the_last_value_until_the_shadow_has_one(rig: Rig) -> None:
    rig.client.write({"speed": 7})
    rig.sees({"speed": 7})
    number = rig.client.inject(["speed"], name="test")
    rig.client.write({"speed": 9})
    frame = rig.until(lambda frame: frame.raw != frame.image)
    assert (rig.value("speed", frame), frame.provenance) == (7, Provenance.LIVE)
    assert [rig.reading(path).provenance for path in ("speed", "lamps")] == ["injected", "live"]
    rig.client.shadow(number, {"speed": -1})
    assert rig.value("speed") == -1, "the value is visible at once"
    rig.client.lift(number)
    last = rig.block.latest()
    assert last is not None
    assert (rig.value("speed", last), last.provenance, last.effective) == (9, Provenance.LIVE, None)


def test_events_describe_an_injection(rig: Rig) -> None:
    number = rig.client.inject(["speed"], name="drive test", priority=3)
    laid = rig.event(EventKind.INJECTED)
    assert (laid.injection, laid.command, laid.writer, laid.text) == (number, number, 4, "drive test")
    (entry,) = rig.block.injections.read()
    assert json.loads(laid.data) == {
        "direction": "out", "priority": 3, "keep": False, "ranges": [list(entry.ranges[0])],
    }  # fmt: skip
    assert (entry.number, entry.direction, entry.priority, entry.name) == (number, "out", 3, "drive test")
    assert (entry.writer, entry.pid, entry.keep) == (4, 100, False)
    assert [register.path for register in LAYOUT.registers if entry.covers(register)] == ["speed"]
    rig.other.shadow(number, {"speed": 258})
    given = rig.event(EventKind.SHADOWED)
    assert (given.injection, given.writer, given.data) == (number, 5, b"\2\1")
    rig.other.lift(number)
    lifted = rig.event(EventKind.LIFTED)
    assert (lifted.injection, lifted.writer, lifted.text) == (number, 5, "lifted")
    assert rig.block.injections.read() == ()


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
    assert rig.value("lamps") == [True] * 10, "of equal priorities, the newest is outermost"
    rig.client.lift(everything)
    assert rig.value("lamps") == [place == 3 for place in range(10)]


def test_writes_go_to_the_injection_and_its_values_to_the_device(rig: Rig) -> None:
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


def test_only_covered_bits_of_an_array_are_diverted(rig: Rig) -> None:
    number = rig.client.inject(["lamps/2"], direction=Direction.IN)
    (outcome,) = rig.other.write({"lamps": [True] * 10})
    assert outcome.kind is OutcomeKind.WRITTEN
    diverted = rig.event(EventKind.DIVERTED)
    assert (diverted.mask, diverted.injection) == (4, number)
    rig.sees({"lamps": [place != 2 for place in range(10)]})


def test_values_toward_the_device_pass_through_inner_injections(rig: Rig) -> None:
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


def test_shadow_is_lifted_when_its_client_ends_unless_it_is_kept(rig: Rig) -> None:
    kept = rig.client.inject(["axis/1"], keep=True)
    rig.client.shadow(kept, {"axis/1": 11})
    other = rig.other.inject(["axis/2"])
    rig.other.shadow(other, {"axis/2": 12})
    gone = rig.client.inject(["speed"])
    rig.client.shadow(gone, {"speed": 13})
    rig.owners[4] = Owner(4, 101)  # another process owns the queue now
    lifted = rig.event(EventKind.LIFTED)
    assert (lifted.injection, lifted.text) == (gone, "the injection's client has ended")
    rig.sees({"axis/1": 11, "axis/2": 12, "speed": 0})


def test_clients_are_not_checked_at_every_command(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.connectors.injections.LOOK_NS", 10**15)
    rig.asked.clear()
    number = rig.client.inject(["speed"])
    for value in range(20):
        rig.client.shadow(number, {"speed": value})
    assert len(rig.asked) <= 2, "at the injection, and at the first check"


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


def test_values_below_other_injections_outlive_the_sources_process(rig: Rig) -> None:
    inner, outer = (rig.client.inject(["speed"], name=name) for name in ("inner", "outer"))
    more = {"name": "more", "target": "cell/speed", "operation": "offset", "value": 100, "priority": 1}
    rig.client.declare(msgspec.convert(more, Declaration))
    rig.client.shadow(inner, {"speed": 7})
    rig.client.shadow(outer, {"speed": 9})
    rig.sees({"speed": 109})
    rig.stop()
    rig.start()
    assert rig.value("speed") == 109, "the offset is added once"
    rig.client.lift(outer)
    rig.sees({"speed": 107})


def test_invalid_requests_are_refused(rig: Rig) -> None:
    with pytest.raises(PathError, match="no register matches"):
        rig.client.inject(["speeds"])
    with pytest.raises(CommandError, match="cell/locked is not writable"):
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
    with pytest.raises(CommandError, match="owns the queue from which"):
        rig.other.inject(["speed"])


def test_injections_beyond_the_space_in_the_segment_are_refused(rig: Rig) -> None:
    name = "\1" * 256  # each takes six characters in the JSON document of all injections
    laid: list[int] = []
    with pytest.raises(CommandError, match="injections of one source are too large"):
        laid.extend(rig.client.inject(["speed"], name=name) for _ in range(MAX_INJECTIONS))
    assert [entry.number for entry in rig.block.injections.read()] == laid
    rig.client.lift(laid[0])
    rig.client.inject(["speed"], name=name)


def test_injection_toward_an_unarmed_device_is_refused(segment: Segment) -> None:
    rig = Rig(segment, armed=False)
    try:
        with pytest.raises(CommandError, match="needs `armed = true`"):
            rig.client.inject(["speed"], direction=Direction.IN)
        rig.client.inject(["speed"])
    finally:
        rig.stop()
