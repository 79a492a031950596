"""Declared injections in a source's process: values for consumers, writes to the device, events."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import Any

import msgspec
import pytest

from shmio.config import Declaration
from shmio.connectors.commands import CommandProcessor
from shmio.connectors.injection_layers import MAX_HELD, Owner
from shmio.connectors.output import Image, Output
from shmio.errors import CommandError
from shmio.injection.draw import SeededRandom
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value, codec
from shmio.local.writer import CommandSender
from shmio.model.clock import Clock
from shmio.model.values import OutcomeKind
from shmio.segment import CommandKind, Event, EventKind, Frame, Provenance, Quality, Segment, Write
from shmio.segment.injection_list import declared_document
from shmio.testing.cell import until
from tests.unit.connectors.harness import SourceRig, block, source_segment, tag_layout

LAYOUT = tag_layout("""
position = "LREAL"
speed = "INT"
lamps = "ARRAY[0..9] OF BOOL"
flags = "WORD"
"axis/1" = "REAL"
"axis/2" = "REAL"
""")
FIRST: list[Value] = [True, *[False] * 9]
"""Values of ten lamps, of which only the first is on."""


def declaration(name: str, target: str | list[str], operation: str, **keys: Any) -> Declaration:
    return msgspec.convert({"name": name, "target": target, "operation": operation, **keys}, Declaration)


class Rig(SourceRig):
    """A source's process without its loop: the test plays the device, cycle by cycle."""

    def __init__(self, segment: Segment) -> None:
        super().__init__(segment)
        self.writer = segment.writer("cell")
        self.output = Output(self.writer)
        self.processor = CommandProcessor(
            self.output, ["**"], lambda: 0, armed=True, owner_of=self.owners.get, blocks=lambda: segment.blocks
        )
        self.processor.open()
        self.cycle = 0
        self.image = bytearray(LAYOUT.size)
        self.written: list[Write] = []
        self._thread = threading.Thread(target=self.processor.run)
        self._thread.start()

    def close(self) -> None:
        self.processor.stop()
        self._thread.join(20)
        assert not self._thread.is_alive()

    def give(self, values: Mapping[str, Value]) -> None:
        """Set values in the device."""
        for path, value in values.items():
            codec(LAYOUT.registers[LAYOUT.by_path[path]], LAYOUT.byte_order).encode_into(value, self.image)

    def poll(self, values: Mapping[str, Value] | None = None, quality: Quality = Quality.GOOD) -> Frame:
        """Run one cycle, as the loop does, and return its frame."""
        self.give(values or {})
        self.cycle += 1
        self.writer.cycle = self.cycle
        self.processor.release(self.cycle)
        if self.processor.waiting:
            self.processor.carry_out(self._write)
        self.output.publish(Image(bytes(self.image), self.cycle, 1, quality, Provenance.LIVE, ""))
        frame = self.block.latest()
        assert frame is not None
        return frame

    def _write(self, writes: Any) -> list[str]:
        self.written += writes
        return [""] * len(writes)

    def follow(self, path: str, values: Sequence[Value], give: str | None = None) -> list[Value]:
        """Set ``give`` (default: ``path``) to each value in turn; return what consumers see at ``path``."""
        seen = []
        for value in values:
            self.poll({give or path: value})
            seen.append(self.value(path))
        return seen

    def told(self, *kinds: EventKind) -> list[Event]:
        """Return the events of these kinds since the last call."""
        found = []
        while (event := self.events.next(0)) is not None:
            if event.kind in kinds:
                found.append(event)
        return found

    def write(self, values: Mapping[str, Value]) -> int:
        """Send a command, wait until it is judged, and return its number."""
        judged = self.block.events.cursor()
        ticket = self.other.submit(values)
        while (event := judged.next(20)) is not None and event.command != ticket.number:
            pass
        # The event comes before the command is queued; the next command is judged after both.
        with pytest.raises(CommandError, match="no injection"):
            self.client.lift(1)
        return ticket.number

    def settle(self) -> None:
        """Wait until the commands' thread has handled all commands."""
        with pytest.raises(CommandError, match="no injection"):
            self.client.lift(1)


@pytest.fixture
def make(instance: str) -> Iterator[Callable[..., Rig]]:
    """Makes a rig whose configuration declares the given injections."""
    with ExitStack() as stack:

        def make(*declared: Declaration) -> Rig:
            blocks = [block(LAYOUT, ["**"], "cell", declared), block(LAYOUT, ["**"], "other")]
            rig = Rig(stack.enter_context(source_segment(instance, *blocks)))
            stack.callback(rig.close)
            return rig

        yield make


RAMP = [10, 20, 30, 40, 50, 60, 70, 80]


def test_operation_is_visible_between_two_times(make: Callable[..., Rig]) -> None:
    rig = make(declaration("drift", "cell/speed", "offset", value=100, start_s=0.03, end_s=0.05))
    rig.events = rig.block.events.cursor(after=0)
    assert rig.follow("speed", RAMP[:6]) == [10, 20, 130, 140, 50, 60]
    laid, on, off = rig.told(EventKind.INJECTED, EventKind.ACTIVATED, EventKind.DEACTIVATED)
    assert (on.cycle, on.injection, on.text, on.item) == (3, laid.injection, "drift", 1)
    assert (off.cycle, off.injection) == (5, laid.injection)
    (entry,) = rig.block.injections.read()
    assert entry.running is not None
    assert (entry.running.state, entry.configured, entry.active) == ("over", True, False)
    told = {**msgspec.to_builtins(entry.running.declaration), "seed": entry.running.seed}
    assert json.loads(laid.data) == told, "the event has the declaration, with the drawn seed"


def test_device_uses_the_instance_clock_after_a_release(make: Callable[..., Rig]) -> None:
    rig = make(declaration("drift", "cell/speed", "offset", value=100, start_s=3600.03, end_s=3600.05))
    hour_ns = 3600 * 10**9
    rig.segment.clock.write(Clock(step=7, done=7, resumed_ns=hour_ns, offset_ns=hour_ns))
    assert rig.follow("speed", RAMP[:6]) == [10, 20, 130, 140, 50, 60]


def test_frames_are_unchanged_while_nothing_is_active(make: Callable[..., Rig]) -> None:
    rig = make(declaration("drift", "cell/speed", "offset", value=100, start_s=0.03, end_s=0.04))
    assert [rig.poll().effective is None for _ in range(5)] == [True, True, False, True, True]


@pytest.mark.parametrize(
    ("operation", "keys", "seen"),
    [
        ("set", {"value": -5}, [-5] * 4),
        ("set", {"value": "16#FF"}, [255] * 4),
        ("scale", {"value": 0.25}, [2, 5, 8, 10]),
        ("scale", {"value": 1e6}, [32767] * 4),
        ("clamp", {"min": 15, "max": 35}, [15, 20, 30, 35]),
        ("freeze", {}, [10] * 4),
        ("delay", {"delay_cycles": 2}, [10, 10, 10, 20]),
        ("delay", {"delay_ms": 10}, [10, 10, 20, 30]),
        ("drop", {}, [10] * 4),
        ("flip", {"bits": [0, 15]}, [value ^ 1 | -32768 for value in RAMP[:4]]),
    ],
)
def test_operations(make: Callable[..., Rig], operation: str, keys: dict[str, Any], seen: list[Value]) -> None:
    rig = make(declaration("one", "cell/speed", operation, **keys))
    assert rig.follow("speed", RAMP[:4]) == seen
    frame = rig.poll({"speed": 5})
    assert frame.effective is not None
    assert frame.raw[:8] == frame.effective[:8], "the neighbours are unchanged"


def test_each_activation_and_each_seed_has_its_own_values(make: Callable[..., Rig]) -> None:
    noise = {"amplitude": 5, "distribution": "gaussian"}
    rig = make(
        declaration("noise", "cell/axis/1", "noise", seed=7, **noise, when="cell/lamps/0"),
        declaration("other", "cell/axis/2", "noise", seed=8, **noise, when="cell/lamps/0"),
    )

    def run() -> list[tuple[Value, Value]]:
        rig.poll({"lamps": FIRST})
        seen = [(rig.value("axis/1"), rig.value("axis/2"))]
        for _ in range(5):
            rig.poll()
            seen.append((rig.value("axis/1"), rig.value("axis/2")))
        rig.poll({"lamps": [False] * 10})
        return seen

    first, second = run(), run()
    assert len(set(first)) == 6
    assert first != second, "each activation has its own values"
    assert all(one != other for one, other in first)


def test_frame_between_two_cycles_has_the_same_random_values(make: Callable[..., Rig]) -> None:
    rig = make(
        declaration("noise", "cell/axis/1", "noise", amplitude=5, seed=1),
        declaration("loss", "cell/speed", "drop", probability=0.5, seed=1),
        declaration("late", "cell/flags", "delay", delay_cycles=1),
    )
    for cycle in range(20):
        before = rig.poll({"speed": cycle, "flags": cycle})
        number = rig.client.inject(["position"])
        between = rig.block.latest()
        assert between is not None
        rig.client.lift(number)
        assert before.effective is not None
        assert between.effective is not None
        assert between.number > before.number
        assert between.effective[8:] == before.effective[8:]


def test_drop_with_a_probability_loses_some_cycles(make: Callable[..., Rig]) -> None:
    rig = make(declaration("loss", "cell/speed", "drop", probability=0.5, seed=3))
    given = list(range(1, 41))
    seen = rig.follow("speed", given)
    kept = [number for number, shown in zip(given, seen, strict=True) if number == shown]
    assert 10 < len(kept) < 30
    for place, shown in enumerate(seen):
        assert shown == max((number for number in kept if number <= given[place]), default=given[0])


def test_condition_on_this_source_and_another(make: Callable[..., Rig]) -> None:
    rig = make(declaration("stuck", "cell/speed", "set", value=0, when="cell/flags.%X3 and other/speed > 5"))
    other = rig.segment.writer("other")
    speed = LAYOUT.registers[LAYOUT.by_path["speed"]]

    def publish(value: int, quality: Quality = Quality.GOOD) -> None:
        image = bytearray(LAYOUT.size)
        codec(speed, LAYOUT.byte_order).encode_into(value, image)
        other.publish(image, cycle=1, quality=quality)

    def seen(flags: int) -> Value:
        rig.poll({"speed": 9, "flags": flags})
        return rig.value("speed")

    assert seen(8) == 9, "the other source has no frame yet"
    publish(6)
    assert [seen(flags) for flags in (8, 7, 8)] == [0, 9, 0]
    publish(6, Quality.BAD)
    assert seen(8) == 9, "a bad value does not count"
    publish(6)
    assert seen(8) == 0
    rig.poll(quality=Quality.BAD)
    assert rig.value("speed") == 9


def layout_of(*names: str) -> Layout:
    return tag_layout("".join(f'\n{name} = "INT"' for name in names))


class TestReloads:
    """A condition reads a source that reloads replace."""

    @pytest.fixture
    def rig(self, make: Callable[..., Rig]) -> Rig:
        return make(declaration("stuck", "cell/speed", "set", value=-1, when="other/speed > 5"))

    def replace_other(self, rig: Rig, layout: Layout | None) -> None:
        """Do what a reload does, which gives the source ``other`` another layout, or removes it."""
        add = [] if layout is None else [block(layout, ["**"], "other")]
        rig.segment.change(add=add, retire=[name for name in ("other",) if name in rig.segment.blocks])

    def publish(self, rig: Rig, **values: Value) -> None:
        layout = rig.segment.blocks["other"].layout
        image = bytearray(layout.size)
        for path, value in values.items():
            codec(layout.registers[layout.by_path[path]], layout.byte_order).encode_into(value, image)
        rig.segment.writer("other").publish(image, cycle=1)

    def stuck(self, rig: Rig) -> bool:
        rig.poll()
        return rig.value("speed") == -1

    @pytest.mark.parametrize("when", ["other/speed > 1000", "other/nothing"])
    @pytest.mark.parametrize("names", [("position", "speed"), ("speed",), ("load", "more", "speed")])
    def test_a_declaration_between_a_reload_and_the_look_at_it(
        self, rig: Rig, when: str, names: tuple[str, ...]
    ) -> None:
        self.replace_other(rig, layout_of(*names))
        late = declaration("late", "cell/axis/1", "set", value=1, when=when)
        with suppress(CommandError):
            rig.client.declare(late)
        self.publish(rig, speed=6)
        assert self.stuck(rig)
        self.publish(rig, **dict.fromkeys(names, 6) | {"speed": 5})
        assert not self.stuck(rig)

    @pytest.mark.parametrize("without", [layout_of("load", "more"), None])
    def test_a_condition_waits_for_its_register(
        self, rig: Rig, without: Layout | None, caplog: pytest.LogCaptureFixture
    ) -> None:
        self.publish(rig, speed=6)
        assert self.stuck(rig)
        self.replace_other(rig, without)
        if without is not None:
            self.publish(rig, load=6, more=6)
        assert not self.stuck(rig)
        until(lambda: "injection stuck cannot start" in caplog.text, "warning")
        assert not self.stuck(rig)
        self.replace_other(rig, layout_of("more", "speed"))
        self.publish(rig, speed=6)
        until(lambda: self.stuck(rig), "injection")
        self.publish(rig, speed=5, more=6)
        assert not self.stuck(rig)


def test_condition_reads_the_devices_value_not_the_injected_one(make: Callable[..., Rig]) -> None:
    rig = make(declaration("limit", "cell/speed", "set", value=0, when="cell/speed > 50"))
    assert rig.follow("speed", RAMP) == [10, 20, 30, 40, 50, 0, 0, 0]


def test_on_a_condition_for_a_limited_time(make: Callable[..., Rig]) -> None:
    rig = make(declaration("pulse", "cell/speed", "set", value=-1, when="rising(cell/flags > 0)", for_s=0.02, times=2))
    assert rig.follow("speed", [0, 1, 1, 1, 1, 0, 1, 0, 0, 0, 1, 0], give="flags") == [
        0, -1, -1, 0, 0, 0, -1, -1, 0, 0, 0, 0,
    ]  # fmt: skip
    turns = [(event.cycle, event.item) for event in rig.told(EventKind.ACTIVATED, EventKind.DEACTIVATED)]
    assert turns == [(2, 1), (4, 1), (7, 2), (9, 2)]


def test_priority_orders_declared_injections_and_those_of_clients(make: Callable[..., Rig]) -> None:
    rig = make(
        declaration("outer", "cell/speed", "offset", value=1, priority=5),
        declaration("inner", "cell/speed", "scale", value=2),
    )
    assert rig.follow("speed", [10]) == [21]
    number = rig.client.inject(["speed"], priority=3)
    rig.client.shadow(number, {"speed": 100})
    rig.poll()
    assert rig.value("speed") == 101, "the client's injection is between the declared ones"
    rig.client.lift(number)
    rig.poll()
    assert rig.value("speed") == 21
    assert [rig.reading(path).provenance for path in ("speed", "flags")] == ["injected", "live"]


def test_bits_elements_ranges_structures_and_whole_blocks(make: Callable[..., Rig]) -> None:
    rig = make(
        declaration("bit", "cell/flags.%X2", "set", value=True),
        declaration("byte", "cell/flags.%B1", "set", value=0x55),
        declaration("lamps", ["cell/lamps/2..4", "cell/lamps/9"], "set", value=True),
        declaration("axes", "cell/axis", "offset", value=1.5),
    )
    rig.poll({"flags": 1, "axis/1": 1, "axis/2": 2})
    assert rig.value("flags") == 0x5505
    assert rig.value("lamps") == [place in (2, 3, 4, 9) for place in range(10)]
    assert (rig.value("axis/1"), rig.value("axis/2")) == (2.5, 3.5)
    everything = declaration("all", "cell", "freeze", priority=9)
    rig.client.declare(everything)
    held = rig.poll().effective
    assert rig.poll({"position": 7, "flags": 0, "speed": 3}).effective == held


# -- toward the device -------------------------------------------------------------------------------------------------


def test_write_reaches_the_device_altered(make: Callable[..., Rig]) -> None:
    rig = make(declaration("gain", "cell/speed/in", "scale", value=2, start_s=0.02, end_s=0.04))
    rig.poll()
    rig.poll()
    number = rig.write({"speed": 21, "flags": 7})
    rig.poll()
    assert rig.written == [Write(8, 0, b"\x2a\0"), Write(12, 0, b"\x07\0")]
    events = rig.told(EventKind.DIVERTED, EventKind.ACCEPTED, EventKind.WRITTEN)
    injection = events[0].injection
    assert [(event.kind, event.command, event.data[:1], event.injection) for event in events] == [
        (EventKind.DIVERTED, number, b"\x15", injection),
        (EventKind.ACCEPTED, number, b"\x2a", injection),
        (EventKind.ACCEPTED, number, b"\x07", 0),
        (EventKind.WRITTEN, number, b"", 0),
        (EventKind.WRITTEN, number, b"", 0),
    ]
    assert [event.text for event in events[-2:]] == ["after the injection 'gain' changed the value", ""]
    rig.poll()
    rig.write({"speed": 21})
    rig.poll()
    assert rig.written[-1] == Write(8, 0, b"\x15\0"), "the injection is over"


def test_drop_takes_what_is_written(make: Callable[..., Rig]) -> None:
    rig = make(declaration("hole", "cell/lamps/3/in", "drop"))
    rig.poll()
    assert rig.other.write({"lamps/3": True})[0].kind is OutcomeKind.TAKEN
    rig.write({"lamps": [True] * 10})
    rig.poll()
    bits = {(write.offset, write.mask) for write in rig.written}
    assert bits == {(10, 1 << bit) for bit in range(8) if bit != 3} | {(11, 0)}


def test_a_delayed_write_is_sent_later(make: Callable[..., Rig]) -> None:
    rig = make(
        declaration("late", "cell/speed/in", "delay", delay_cycles=2, priority=1),
        declaration("gain", "cell/speed/in", "scale", value=3),
    )
    rig.poll()
    rig.write({"speed": 5})
    sent = []
    for _ in range(4):
        rig.poll()
        sent.append(list(rig.written))
    assert sent == [[], [], [Write(8, 0, b"\x0f\0")], [Write(8, 0, b"\x0f\0")]], (
        "sent later, through the inner injection"
    )
    rig.events = rig.block.events.cursor(after=0)
    told = (EventKind.DIVERTED, EventKind.TAKEN, EventKind.ACCEPTED, EventKind.WRITTEN)
    kinds = [event.kind for event in rig.told(*told)]
    assert kinds == [
        EventKind.DIVERTED, EventKind.TAKEN, EventKind.DIVERTED, EventKind.ACCEPTED, EventKind.WRITTEN,
    ]  # fmt: skip


@pytest.mark.parametrize("by", ["lift", "disconnect"])
def test_delayed_write_expires_when_its_injection_is_lifted_or_the_device_disconnects(
    make: Callable[..., Rig], by: str
) -> None:
    rig = make()
    number = rig.client.declare(declaration("late", "cell/speed/in", "delay", delay_ms=20))
    rig.poll()
    rig.write({"speed": 5})
    if by == "lift":
        rig.other.lift(number)
    else:
        rig.processor.close("cable out")
        rig.processor.open()
    (lost,) = rig.told(EventKind.EXPIRED)
    assert lost.injection == number
    assert lost.text == f"an injection delayed the write, and discarded it: {'lifted' if by == 'lift' else 'cable out'}"
    for _ in range(4):
        rig.poll()
    assert rig.written == []


def test_full_delay_rejects_writes(make: Callable[..., Rig]) -> None:
    rig = make(declaration("late", "cell/speed/in", "delay", delay_cycles=2))
    rig.poll()
    for value in range(MAX_HELD):
        assert rig.other.write({"speed": value})[0].kind is OutcomeKind.TAKEN
    (outcome,) = rig.other.write({"speed": 1})
    assert (outcome.kind, outcome.text) == (
        OutcomeKind.REJECTED, f"the injection late delays {MAX_HELD} writes already, which is the maximum",
    )  # fmt: skip
    rig.client.lift(rig.block.injections.read()[0].number)
    rig.write({"speed": 1})


# -- declared by clients, and kept over processes ----------------------------------------------------------------------


def test_clients_declaration_is_lifted_when_it_is_over_or_the_client_ends(make: Callable[..., Rig]) -> None:
    rig = make()
    over = rig.client.declare(declaration("short", "cell/speed", "set", value=1, end_s=0.02))
    gone = rig.other.declare(declaration("left", "cell/flags", "set", value=1))
    kept = rig.other.declare(declaration("kept", "cell/flags", "set", value=2), keep=True)
    rig.poll()
    rig.poll()
    rig.settle()
    rig.owners[5] = Owner(5, 201)
    lifted: list[tuple[int, str]] = []
    while len(lifted) < 2:
        event = rig.events.next(20)
        assert event is not None
        lifted += [(event.injection, event.text)] if event.kind == EventKind.LIFTED else []
    assert lifted == [(over, "over"), (gone, "the injection's client has ended")]
    assert [entry.number for entry in rig.block.injections.read()] == [kept]


def test_lifted_injection_of_the_configuration_stays_lifted(make: Callable[..., Rig]) -> None:
    rig = make(declaration("stuck", "cell/speed", "set", value=-1))
    rig.poll({"speed": 5})
    (entry,) = rig.block.injections.read()
    rig.client.lift(entry.number)
    rig.poll()
    assert rig.value("speed") == 5
    assert [one.lifted for one in rig.block.injections.read()] == [True]
    with pytest.raises(CommandError, match="the injection stuck was lifted already"):
        rig.client.lift(entry.number)
    rig.close()
    again = Rig(rig.segment)
    try:
        again.poll({"speed": 6})
        assert again.value("speed") == 6
    finally:
        again.close()


def test_successor_process_continues_active_injections(make: Callable[..., Rig]) -> None:
    rig = make(
        declaration("held", "cell/speed", "freeze", when="cell/lamps/0"),
        declaration("noise", "cell/axis/1", "noise", amplitude=5, when="cell/lamps/0"),
        declaration("once", "cell/flags", "set", value=77, when="cell/lamps/0", for_s=0.03, times=1),
    )
    rig.poll({"lamps": FIRST, "speed": 3})
    seeds = {one.name: one.running.seed for one in rig.block.injections.read() if one.running}
    draw = SeededRandom(seeds["noise"], "noise")
    expected = [float(5 * (2 * draw.uniform(1, place, 1)[0] - 1)) for place in range(4)]
    rig.close()
    again = Rig(rig.segment)
    again.image, again.cycle = rig.image, rig.cycle
    try:
        seen = []
        for _ in range(3):
            again.poll({"speed": 9})
            seen.append((again.value("speed"), again.value("axis/1"), again.value("flags")))
        assert [speed for speed, _, _ in seen] == [3, 3, 3]
        assert [noise for _, noise, _ in seen] == pytest.approx(expected[1:], rel=1e-6)
        assert [flags for _, _, flags in seen] == [77, 77, 0]
        assert again.told(EventKind.INJECTED) == [], "the successor lays no injection again"
    finally:
        again.close()


def test_the_configuration_may_change_while_the_process_runs(make: Callable[..., Rig]) -> None:
    stay = declaration("stay", "cell/axis/1", "freeze")
    rig = make(stay, declaration("go", "cell/flags", "set", value=1), declaration("turn", "cell/speed", "set", value=1))
    rig.poll({"axis/1": 1})
    before = {entry.name: entry.number for entry in rig.block.injections.read()}
    changed = [
        stay,
        declaration("turn", "cell/speed", "set", value=2),
        declaration("new", "cell/lamps/1", "set", value=1),
    ]
    rig.block.declared.write(declared_document(changed))
    rig.block.commands.wake()
    until(
        lambda: "new" in {entry.name for entry in rig.block.injections.read()},
        "the new injection, which is created last",
    )
    rig.poll({"axis/1": 2})
    assert (rig.value("axis/1"), rig.value("flags"), rig.value("speed")) == (1, 0, 2)
    after = {entry.name: entry.number for entry in rig.block.injections.read()}
    assert set(after) == {"stay", "turn", "new"}
    assert before["stay"] == after["stay"]
    assert before["turn"] != after["turn"]


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (declaration("x", "cell/speeds", "freeze"), "target: cell/speeds: cell has no such register"),
        (
            declaration("x", "other/speed", "freeze"),
            "target: it names source other, but the declaration was sent to source cell",
        ),
        (declaration("x", "cell/speed", "set"), "value: this key is needed for operation 'set'"),
        (declaration("x", "cell/speed", "set", value="hot"), "value: speed: INT: expected"),
        (declaration("x", "cell/speed", "freeze", when="cell/speed >"), "when: at character 13: expected a register"),
    ],
)
def test_faulty_declaration_is_refused_by_the_source(make: Callable[..., Rig], wrong: Declaration, reason: str) -> None:
    rig = make()
    with pytest.raises(CommandError) as refused:
        rig.client.declare(wrong)
    assert reason in str(refused.value)
    assert rig.block.injections.read() == ()


def test_garbage_in_place_of_a_declaration_is_refused(make: Callable[..., Rig]) -> None:
    rig = make()
    sender = CommandSender(rig.block, 4)
    for garbage in (b"{", b"[]", b'{"name": 1}', b"\xff" * 100, b"[" * 5000):
        number = sender.submit([Write(0, 0, garbage)], 1 << 60, CommandKind.DECLARE)
        while (event := rig.events.next(20)) is None or event.command != number:
            assert event is not None
        assert event.kind == EventKind.REJECTED
    rig.client.declare(declaration("x", "cell/speed", "freeze"))


@pytest.mark.parametrize(("operation", "keys"), [("set", {"value": "NaN"}), ("flip", {"bits": list(range(23, 31))})])
def test_nan_from_an_injection_does_not_reach_the_device(
    make: Callable[..., Rig], operation: str, keys: dict[str, Any]
) -> None:
    rig = make(declaration("mad", "cell/axis/1/in", operation, **keys))
    rig.poll()
    rig.told()
    rig.write({"axis/1": 0.0, "axis/2": 2.5})
    rig.poll()
    (refused,) = rig.told(EventKind.REFUSED)
    assert refused.text.startswith(
        "the injection 'mad' changed the value: axis/1: NaN and infinities are written only if"
    )
    other = LAYOUT.registers[LAYOUT.by_path["axis/2"]].offset
    assert [write.offset for write in rig.written] == [other]
