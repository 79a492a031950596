"""The loop of computed sources: by period in wall time, step by step in virtual time."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise

import msgspec
import pytest

from shmio.connectors.base import Computed
from shmio.connectors.models.memory import Memory
from shmio.connectors.models.stepped import RESTARTED, Inputs, PageClock, SteppedLoop
from shmio.connectors.poll_loop import Schedule
from shmio.errors import ConnectorError, TimeError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import parse_topic
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write
from shmio.local.time_control import Coordinator
from shmio.local.writer import SourceWriter
from shmio.model.values import OutcomeKind
from shmio.segment import (
    Attributes,
    BlockSpec,
    BlockWriter,
    EventKind,
    Frame,
    ProcessSpec,
    Provenance,
    Quality,
    Record,
    Segment,
    Stamp,
)
from shmio.segment.clock import SIMULATED_UTC_NS

LAYOUT = Layout(
    "model",
    None,
    12,
    False,
    (
        Register("sum", "UDINT", (), 0, None, 4, 1),
        Register("given", "UDINT", (), 4, None, 4, 1),
        Register("other", "UDINT", (), 8, None, 4, 1),
    ),
)
PERIOD_NS = 20_000_000
MS = 1_000_000
GUEST = 0
PATIENCE_S = 20


class Adder(Computed):
    """A model. Each step adds 1, ``given`` and ``other`` to ``sum``; ``trouble`` may raise or wait."""

    Options = msgspec.Struct

    def __init__(self, trouble: Callable[[int], None] = lambda _: None, **connections: str) -> None:
        self.trouble = trouble
        self.image = bytearray(12)
        self.calls: list[tuple[int, int]] = []
        self._connections = connections

    @property
    def connections(self) -> Mapping[str, str]:
        return self._connections

    def connect(self, values: Mapping[str, Value], doubt: str) -> None:
        if "other" in values:
            struct.pack_into(">I", self.image, 8, values["other"])

    def resume(self, image: bytes) -> None:
        self.image[:] = image

    def begin(self) -> bytes:
        return bytes(self.image)

    def write(self, writes: Sequence[Write]) -> list[str]:
        for offset, _, data in writes:
            self.image[offset : offset + len(data)] = data
        return [""] * len(writes)

    def step(self, time_ns: int, dt_ns: int) -> bytes:
        self.calls.append((time_ns, dt_ns))
        self.trouble(len(self.calls))
        total, given, other = struct.unpack(">III", self.image)
        struct.pack_into(">I", self.image, 0, total + 1 + given + other)
        return bytes(self.image)


class VirtualClock:
    """A clock that moves only by waiting, and stops the loop after ``end_ns``."""

    def __init__(self, begin_ns: int, end_ns: int) -> None:
        self.time_ns, self.end_ns = begin_ns, begin_ns + end_ns

    def now_ns(self) -> int:
        return self.time_ns

    def nudge(self) -> None:
        """Do nothing, because waits of this clock return at once."""

    def wait_ns(self, duration_ns: int | None) -> bool:
        assert duration_ns is not None
        self.time_ns += max(0, duration_ns)
        return self.time_ns >= self.end_ns


@contextmanager
def built(instance: str, *names: str, stepped: bool = True, device: bool = False) -> Iterator[Segment]:
    blocks = [
        BlockSpec(name, LAYOUT, PERIOD_NS, 500 * MS, 1 << 20, Attributes("simulation", ("given",), stepped=True))
        for name in names
    ]
    if device:
        blocks.append(BlockSpec("cell", LAYOUT, PERIOD_NS, 3_600_000 * MS, 1 << 20, Attributes("s7")))
    processes = [ProcessSpec(name, "source") for name in names]
    with Segment.create(instance, blocks, processes, stepped=stepped) as segment:
        yield segment
        segment.unlink()


class Running:
    """The process of one source, run in threads."""

    def __init__(
        self, segment: Segment, name: str, source: Computed, writer_of: type[BlockWriter] = BlockWriter
    ) -> None:
        self._stack = ExitStack()
        self.segment = own = self._stack.enter_context(Segment.open(segment.instance, writable=True))
        slot = own.processes.find(name)
        assert slot.take()
        inputs = None
        if source.connections:
            topics = {path: parse_topic(topic, own.blocks, name) for path, topic in source.connections.items()}
            inputs = Inputs(self._stack.enter_context(Segment.open(segment.instance)), topics)
        self.clock = PageClock(own.clock, slot.index)
        schedule = Schedule(own.header.started_ns, PERIOD_NS)
        self.cursor = own.blocks[name].cursor()
        writer = writer_of(own.blocks[name], own.clock_ns)
        writable = writer.block.attributes.writable
        self.loop = SteppedLoop(
            source, writer, schedule, self.clock, writable, inputs=inputs, blocks=lambda: own.blocks
        )
        self._threads = [threading.Thread(target=run) for run in (self.loop.run, self.loop.commands.run)]
        for thread in self._threads:
            thread.start()

    def next(self) -> Frame:
        frame = self.cursor.next(PATIENCE_S)
        assert frame is not None, "no frame"
        return frame

    def frames(self) -> list[Frame]:
        """Return the frames that were published since the last call."""
        found = []
        while (frame := self.cursor.poll()) is not None:
            found.append(frame)
        return found

    def __enter__(self) -> Running:
        return self

    def __exit__(self, *_: object) -> None:
        self.clock.stop()
        for thread in self._threads:
            thread.join()
        self._stack.close()


def summed(frame: Frame | None) -> int:
    assert frame is not None
    return int.from_bytes(frame.raw[:4], "big")


def latest(segment: Segment, name: str) -> Frame:
    frame = segment.blocks[name].latest()
    assert frame is not None
    return frame


# ---- wall time -------------------------------------------------------------------------------------------------------


def test_model_runs_once_a_period_in_wall_time(instance: str) -> None:
    with built(instance, "sim", stepped=False) as segment:
        source, cursor = Adder(), segment.blocks["sim"].cursor()
        clock = VirtualClock(segment.header.started_ns, 6 * PERIOD_NS)
        loop = SteppedLoop(source, segment.writer("sim"), Schedule(segment.header.started_ns, PERIOD_NS), clock)
        loop.run()
        frames = list(iter(cursor.poll, None))
    assert source.calls == [(cycle * PERIOD_NS, PERIOD_NS) for cycle in range(1, 6)]
    assert [(f.cycle, summed(f), f.quality) for f in frames[:-1]] == [(c, c, Quality.GOOD) for c in range(1, 6)]
    assert {f.provenance for f in frames} == {Provenance.SIMULATED}
    assert (frames[-1].quality, frames[-1].reason) == (Quality.BAD, "the source was stopped")
    assert (loop.counters.polls, loop.counters.overruns) == (5, 0)


def test_step_after_missed_cycles_covers_their_time(instance: str) -> None:
    def slow(call: int) -> None:
        clock.time_ns += 5 * PERIOD_NS // 2 if call == 2 else 0

    with built(instance, "sim", stepped=False) as segment:
        source = Adder(slow)
        clock = VirtualClock(segment.header.started_ns, 7 * PERIOD_NS)
        loop = SteppedLoop(source, segment.writer("sim"), Schedule(segment.header.started_ns, PERIOD_NS), clock)
        loop.run()
    assert [(time_ns // PERIOD_NS, dt_ns // PERIOD_NS) for time_ns, dt_ns in source.calls] == [
        (1, 1),
        (2, 1),
        (4, 2),
        (5, 1),
        (6, 1),
    ]
    assert loop.counters.overruns == 1


def test_failure_in_wall_time_is_one_bad_frame_and_each_cycle_tries_again(instance: str) -> None:
    def fails(call: int) -> None:
        if 3 <= call <= 5:
            raise ConnectorError("the model is on fire")

    with built(instance, "sim", stepped=False) as segment:
        cursor = segment.blocks["sim"].cursor()
        clock = VirtualClock(segment.header.started_ns, 8 * PERIOD_NS)
        loop = SteppedLoop(Adder(fails), segment.writer("sim"), Schedule(segment.header.started_ns, PERIOD_NS), clock)
        loop.run()
        frames = list(iter(cursor.poll, None))
    assert [(f.cycle, summed(f), f.reason) for f in frames[:-1]] == [
        (1, 1, ""),
        (2, 2, ""),
        (3, 2, "the model is on fire"),
        (6, 3, ""),
        (7, 4, ""),
    ]
    assert loop.counters.failures == 3


# ---- virtual time ----------------------------------------------------------------------------------------------------


def test_each_step_of_virtual_time_is_one_frame(instance: str) -> None:
    with built(instance, "sim") as segment:
        source = Adder()
        with Running(segment, "sim", source) as sim:
            begin = sim.next()
            assert (begin.cycle, summed(begin), begin.clock_ns, begin.quality) == (0, 0, 0, Quality.GOOD)
            coordinator = Coordinator(segment)
            for dt_ms in (50, 20, 3_600_000):
                coordinator.step(dt_ms * MS)
            frames = sim.frames()
        assert source.calls == [(50 * MS, 50 * MS), (70 * MS, 20 * MS), (3_600_070 * MS, 3_600_000 * MS)]
        assert [(f.cycle, summed(f), f.clock_ns // MS, f.delay_us) for f in frames] == [
            (1, 1, 50, 0),
            (2, 2, 70, 0),
            (3, 3, 3_600_070, 0),
        ]
        assert frames[0].publish_ns == segment.header.started_ns + 50 * MS
        assert frames[0].source_ns == SIMULATED_UTC_NS + 50 * MS
        assert segment.blocks["sim"].assess(frames[-1]) == (Quality.GOOD, "")


def test_take_over_stops_free_running_and_cycle_numbers_continue(instance: str) -> None:
    with built(instance, "sim", stepped=False) as segment, Running(segment, "sim", Adder()) as sim:
        while sim.next().cycle < 3:
            pass
        coordinator = Coordinator(segment)
        coordinator.take_over()
        taken = coordinator.read()
        steps = [coordinator.step(20 * MS) for _ in range(5)]
        frames = sim.frames()
        by_steps = [f for f in frames if f.cycle > taken.step]
        assert [f.cycle for f in by_steps] == [step.number for step in steps] == [taken.step + n for n in range(1, 6)]
        assert [f.clock_ns for f in by_steps] == [taken.time_ns + n * 20 * MS for n in range(1, 6)]
        assert all(f.clock_ns <= taken.time_ns for f in frames if f.cycle <= taken.step)
        cycles = [f.cycle for f in frames]
        assert cycles == sorted(set(cycles))


def test_released_time_continues_from_virtual_time(instance: str) -> None:
    with built(instance, "sim", stepped=False) as segment:
        source, coordinator, frames = Adder(), Coordinator(segment), []

        def free(sim: Running) -> None:
            released = segment.clock.last_written()
            while (frame := sim.next()).cycle < released.step + 3:
                frames.append(frame)
            frames.append(frame)
            assert 0 <= frame.age_ns(segment.blocks["sim"].now_ns()) < 3_600_000 * MS, (
                "frame and block use the same clock"
            )

        with Running(segment, "sim", source) as sim:
            frames.append(sim.next())
            for dt_ms in (*[1] * 30, 3_600_000):  # more steps than periods have passed, then more time
                coordinator.step(dt_ms * MS)
            stepped = len(source.calls)
            coordinator.release()
            free(sim)
            again = len(source.calls)
            coordinator.take_over()
            first, last = coordinator.step(20 * MS), coordinator.step(20 * MS)
            assert last.number == first.number + 1
            coordinator.release()
            free(sim)
        with Running(segment, "sim", Adder()) as sim:  # as after a restart
            free(sim)
    cycles = [frame.cycle for frame in frames if frame.quality is Quality.GOOD]
    assert cycles == sorted(set(cycles))
    assert [frame.clock_ns for frame in frames] == sorted(frame.clock_ns for frame in frames)
    moments = [(before, time_ns - dt_ns) for (before, _), (time_ns, dt_ns) in pairwise(source.calls)]
    assert all(before <= begun for before, begun in moments)
    assert all(before == begun for before, begun in moments[stepped - 1 : again - 1]), "a model misses no time"


class SlowToAccept(BlockWriter):
    """Delays the source after each event ACCEPTED until a step could have been made without that write."""

    def event(self, record: Record, *, quality: Quality | None = None, at: Stamp | None = None) -> int:
        number = super().event(record, quality=quality, at=at)
        if record.kind is EventKind.ACCEPTED:
            seen = self.block.ring.doorbell()
            while not self.block.clock.read().stepping:
                self.block.clock.bell.wait(self.block.clock.bell.value(), 1 * MS)
            self.block.ring.wait(seen, 20 * MS)
        return number


def test_write_accepted_before_a_step_is_carried_out_in_it(instance: str) -> None:
    with built(instance, "sim") as segment, Running(segment, "sim", Adder(), SlowToAccept) as sim:
        sim.next()
        coordinator, source_writer = Coordinator(segment), SourceWriter(segment.blocks["sim"], GUEST)
        expected = 0
        for given in range(1, 10):
            events = segment.blocks["sim"].events.cursor()
            source_writer.submit({"given": given})
            while (event := events.next(PATIENCE_S)) is None or event.kind != EventKind.ACCEPTED:
                assert event is not None
            coordinator.step()
            expected += 1 + given
            assert summed(latest(segment, "sim")) == expected, f"the write before step {given} is in it"


def test_write_has_its_outcome_while_time_is_paused(instance: str) -> None:
    with built(instance, "sim") as segment, Running(segment, "sim", Adder()) as sim:
        sim.next()
        coordinator, source_writer = Coordinator(segment), SourceWriter(segment.blocks["sim"], GUEST)
        coordinator.step(10 * MS)
        events = segment.blocks["sim"].events.cursor()
        (outcome,) = source_writer.write({"given": 7})
        assert outcome.kind is OutcomeKind.WRITTEN
        told = [event for event in iter(events.poll, None) if event.kind == EventKind.WRITTEN]
        assert [(event.cycle, event.clock_ns) for event in told] == [(1, 10 * MS)], "events have the instance's time"
        assert summed(latest(segment, "sim")) == 1, "a model shows a written value with its next step"
        coordinator.step(10 * MS)
        assert summed(latest(segment, "sim")) == 9


def test_failing_model_fails_the_step_by_name_and_the_next_step_tries_again(instance: str) -> None:
    def fails(call: int) -> None:
        if call in (2, 3):
            raise ConnectorError(f"no solution in call {call}")

    with built(instance, "sim", "other") as segment, ExitStack() as stack:
        sim = stack.enter_context(Running(segment, "sim", Adder(fails)))
        stack.enter_context(Running(segment, "other", Adder()))
        coordinator = Coordinator(segment)
        coordinator.step()
        for call in (2, 3):
            with pytest.raises(TimeError, match=f"step {call}: sim: no solution in call {call}"):
                coordinator.step()
        coordinator.step()
        assert [(f.cycle, f.quality, f.reason) for f in sim.frames()][1:] == [
            (1, Quality.GOOD, ""),
            (2, Quality.BAD, "no solution in call 2"),
            (3, Quality.BAD, "no solution in call 3"),
            (4, Quality.GOOD, ""),
        ]
        assert (latest(segment, "other").cycle, summed(latest(segment, "other"))) == (4, 4)


def test_model_that_cannot_begin_gives_a_bad_frame(instance: str) -> None:
    class Broken(Adder):
        def begin(self) -> bytes:
            raise ConnectorError("no start")

    with built(instance, "sim") as segment, Running(segment, "sim", Broken()) as sim:
        frame = sim.next()
        assert (frame.cycle, frame.quality, frame.reason) == (0, Quality.BAD, "no start")


def test_successor_continues_with_the_image(instance: str) -> None:
    with built(instance, "sim") as segment:
        coordinator = Coordinator(segment)
        with Running(segment, "sim", Adder()):
            coordinator.step()
            coordinator.step()
        assert latest(segment, "sim").reason == "the source was stopped"
        with Running(segment, "sim", Adder()) as sim:
            frame = sim.next()
            assert (frame.cycle, summed(frame), frame.quality) == (2, 2, Quality.GOOD)
            coordinator.step()
            assert summed(latest(segment, "sim")) == 3


def test_process_that_dies_within_a_step_fails_it_and_its_successor_takes_part_in_the_next(instance: str) -> None:
    with built(instance, "sim", "other") as segment, ExitStack() as stack:
        coordinator = Coordinator(segment, hard_s=60)
        reached, errors = threading.Event(), list[TimeError]()
        stack.enter_context(Running(segment, "other", Adder(lambda call: reached.set() if call == 2 else None)))
        with Running(segment, "sim", Adder()):
            coordinator.step()

        def step() -> None:
            with pytest.raises(TimeError) as caught:
                coordinator.step()
            errors.append(caught.value)

        thread = threading.Thread(target=step)
        thread.start()
        assert reached.wait(PATIENCE_S)
        source = Adder()
        stack.enter_context(Running(segment, "sim", source))
        thread.join()
        assert str(errors[0]) == f"step 2: sim: {RESTARTED}"
        assert coordinator.step().number == 3
        assert source.calls == [(150 * MS, 50 * MS)]


def test_source_that_starts_within_a_step_takes_part_in_it(instance: str) -> None:
    with built(instance, "sim") as segment:
        coordinator = Coordinator(segment, soft_s=0.001, hard_s=60)
        thread = threading.Thread(target=coordinator.step)
        thread.start()
        while not segment.clock.read().note:
            segment.clock.bell.wait(segment.clock.bell.value(), 10 * MS)
        with Running(segment, "sim", Adder()) as sim:
            thread.join()
            assert [(f.cycle, summed(f)) for f in sim.frames()] == [(1, 1)]


def test_source_that_missed_steps_continues_with_the_current_one(instance: str) -> None:
    hold, held = threading.Event(), threading.Event()

    def stopped(call: int) -> None:
        if call == 1:
            held.set()
            assert hold.wait(PATIENCE_S)

    with built(instance, "sim") as segment:
        source = Adder(stopped)
        coordinator = Coordinator(segment, soft_s=0.01, hard_s=0.02)
        with Running(segment, "sim", source) as sim:
            sim.next()
            for number in (1, 2, 3):
                with pytest.raises(TimeError, match=f"step {number}: sim: no answer within"):
                    coordinator.step()
            assert held.is_set()
            hold.set()
            assert sim.next().cycle == 1
            Coordinator(segment, hard_s=60).step()
            assert [f.cycle for f in sim.frames()] == [4]
        assert source.calls == [(50 * MS, 50 * MS), (200 * MS, 50 * MS)]


# ---- connected inputs ------------------------------------------------------------------------------------------------


def test_models_read_each_others_values_from_before_the_step(instance: str) -> None:
    """Each model in turn waits until the other has published."""
    with built(instance, "a", "b") as segment, ExitStack() as stack:

        def after(name: str, turn: int) -> Callable[[int], None]:
            def wait(call: int) -> None:
                block = segment.blocks[name]
                while call % 2 == turn and latest(segment, name).cycle < call:
                    block.ring.wait(block.ring.doorbell(), 1 * MS)

            return wait

        stack.enter_context(Running(segment, "a", Adder(after("b", 0), other="b/sum")))
        stack.enter_context(Running(segment, "b", Adder(after("a", 1), other="a/sum")))
        coordinator = Coordinator(segment)
        a, b = 0, 0
        for _ in range(10):
            coordinator.step()
            a, b = a + 1 + b, b + 1 + a
            assert (summed(latest(segment, "a")), summed(latest(segment, "b"))) == (a, b)


def test_a_source_may_be_connected_to_itself(instance: str) -> None:
    with built(instance, "a") as segment, Running(segment, "a", Adder(other="a/sum")):
        coordinator = Coordinator(segment)
        for expected in (1, 3, 7, 15):
            coordinator.step()
            assert summed(latest(segment, "a")) == expected


def test_input_from_a_device_uses_the_newest_frame_unless_it_is_bad(instance: str) -> None:
    with built(instance, "a", device=True) as segment:
        cell = segment.writer("cell")
        with Running(segment, "a", Adder(other="cell/sum")) as sim:
            sim.next()
            coordinator = Coordinator(segment)
            seen = []
            for publish in (
                lambda: None,
                lambda: cell.publish(struct.pack(">III", 10, 0, 0), cycle=10**9),
                lambda: cell.publish(bytes(12), cycle=10**9, quality=Quality.BAD, reason="cable out"),
                lambda: cell.publish(struct.pack(">III", 20, 0, 0), cycle=10**9),
            ):
                publish()
                coordinator.step()
                frame = latest(segment, "a")
                seen.append((summed(frame), frame.quality, frame.reason))
        assert seen == [
            (1, Quality.UNCERTAIN, "input other keeps its value: cell: no data yet"),
            (12, Quality.GOOD, ""),
            (23, Quality.UNCERTAIN, "input other keeps its value: cell: cable out"),
            (44, Quality.GOOD, ""),
        ]


def test_removed_source_of_an_input_is_named(instance: str) -> None:
    with built(instance, "a", device=True) as segment, Running(segment, "a", Adder(other="cell/sum")):
        segment.change(retire=["cell"])
        Coordinator(segment).step()
        frame = latest(segment, "a")
        assert (frame.quality, frame.reason) == (
            Quality.UNCERTAIN,
            "input other: source 'cell' no longer exists",
        )


# ---- memory ----------------------------------------------------------------------------------------------------------


def test_memory_shows_a_write_at_once_while_time_is_paused(instance: str) -> None:
    with built(instance, "panel") as segment, Running(segment, "panel", Memory(Memory.Options(), LAYOUT)) as panel:
        panel.next()
        coordinator, source_writer = Coordinator(segment), SourceWriter(segment.blocks["panel"], GUEST)
        coordinator.step(3_600_000 * MS)
        assert segment.blocks["panel"].assess(panel.next()) == (Quality.GOOD, "")
        for given in (1, 2, 3):
            (outcome,) = source_writer.write({"given": given})
            assert outcome.kind is OutcomeKind.WRITTEN
            frame = latest(segment, "panel")
            assert (frame.raw[7], frame.cycle, frame.clock_ns) == (given, 1, 3_600_000 * MS)
        coordinator.step()
        frame = latest(segment, "panel")
        assert (frame.raw[7], frame.cycle) == (3, 2)


def test_model_reads_from_a_memory_what_was_written_before_the_step(instance: str) -> None:
    with built(instance, "a", "panel") as segment, ExitStack() as stack:
        stack.enter_context(Running(segment, "panel", Memory(Memory.Options(), LAYOUT))).next()
        stack.enter_context(Running(segment, "a", Adder(other="panel/given"))).next()
        coordinator, source_writer = Coordinator(segment), SourceWriter(segment.blocks["panel"], GUEST)
        expected = 0
        for given in range(1, 20):
            source_writer.write({"given": given})
            coordinator.step()
            expected += 1 + given
            assert summed(latest(segment, "a")) == expected
