"""The loop that runs a connector, with a virtual clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any, ClassVar

import msgspec
import pytest

from shmio.connectors.base import Connector, Lost, UnconfirmedError
from shmio.connectors.poll_loop import Schedule, SourceLoop
from shmio.errors import ConnectorError
from shmio.layout.model import Layout, Register
from shmio.local.writer import CommandSender
from shmio.segment import BlockSpec, EventKind, Frame, ProcessSpec, Quality, Segment, Write
from shmio.segment.block import Bytes

LAYOUT = Layout("DB1", 1, 4, False, (Register("count", "UDINT", (), 0, None, 4, 1),))
PERIOD_NS = 20_000_000


class VirtualClock:
    """A clock that moves only by waiting, and stops the loop at ``end_ns``."""

    def __init__(self, end_ns: int) -> None:
        self.time_ns = 0
        self.end_ns = end_ns

    def now_ns(self) -> int:
        return self.time_ns

    def wait_ns(self, duration_ns: int) -> bool:
        self.time_ns += max(0, duration_ns)
        return self.time_ns >= self.end_ns


class Device(Connector):
    """A device that counts its reads; ``trouble`` may raise or take time."""

    Options = msgspec.Struct

    def __init__(self, trouble: Callable[[str, int], None]) -> None:
        self.trouble = trouble
        self.connected = False
        self.reads = 0
        self.calls: list[str] = []

    @property
    def timeout_s(self) -> float:
        return 1.0

    def connect(self) -> None:
        assert not self.connected
        self.calls.append("connect")
        self.trouble("connect", self.reads)
        self.connected = True

    def read(self) -> bytes:
        assert self.connected
        self.reads += 1
        self.trouble("read", self.reads)
        return self.reads.to_bytes(4, "big")

    def close(self) -> None:
        self.calls.append("close")
        self.connected = False


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    with Segment.create(
        instance, [BlockSpec("cell", LAYOUT, PERIOD_NS, 10**9, 1 << 20)], [ProcessSpec("cell", "source")]
    ) as s:
        yield s
        s.unlink()


def run(segment: Segment, trouble: Callable[[str, int], None], cycles: int) -> tuple[Device, SourceLoop, list[Frame]]:
    clock = VirtualClock(cycles * PERIOD_NS)
    device = Device(trouble)
    loop = SourceLoop(device, segment.writer("cell"), Schedule(0, PERIOD_NS), clock)
    cursor = segment.blocks["cell"].cursor()
    loop.run()
    frames = []
    while (frame := cursor.poll()) is not None:
        frames.append(frame)
    return device, loop, frames


def test_each_cycle_gives_one_frame_and_the_end_a_bad_one(segment: Segment) -> None:
    device, loop, frames = run(segment, lambda *_: None, 6)
    assert [(f.cycle, int.from_bytes(f.raw, "big"), f.quality) for f in frames[:-1]] == [
        (cycle, cycle, Quality.GOOD) for cycle in range(1, 6)
    ]
    assert (frames[-1].quality, frames[-1].reason) == (Quality.BAD, "the source was stopped")
    assert frames[-1].raw == frames[-2].raw
    assert device.calls == ["connect", "close"]
    assert (loop.counters.polls, loop.counters.overruns, loop.counters.connects) == (5, 0, 1)


def test_outage_is_one_bad_frame_with_the_last_bytes_and_the_loop_recovers(segment: Segment) -> None:
    def cut_in_reads_3_to_5(hook: str, reads: int) -> None:
        if hook == "read" and 3 <= reads <= 5:
            raise ConnectorError("cable out")

    device, loop, frames = run(segment, cut_in_reads_3_to_5, 60)
    assert [int.from_bytes(f.raw, "big") for f in frames[:4]] == [1, 2, 2, 6]
    assert [(f.quality, f.reason) for f in frames[1:4]] == [
        (Quality.GOOD, ""),
        (Quality.BAD, "cable out"),
        (Quality.GOOD, ""),
    ]
    assert device.calls[:7] == ["connect", "close", "connect", "close", "connect", "close", "connect"]
    assert (loop.counters.failures, loop.counters.overruns) == (3, 0)


def test_a_loss_is_published_before_the_connection_is_closed(segment: Segment) -> None:
    """To close it may take time, in which the last values must not be shown as good."""
    seen = []

    def lost_in_read_3(hook: str, reads: int) -> None:
        if hook == "read" and reads == 3:
            raise ConnectorError("cable out")

    class Slow(Device):
        def close(self) -> None:
            frame = segment.blocks["cell"].latest()
            assert frame is not None
            seen.append((frame.quality, frame.reason))
            super().close()

    SourceLoop(Slow(lost_in_read_3), segment.writer("cell"), Schedule(0, PERIOD_NS), VirtualClock(6 * PERIOD_NS)).run()
    assert seen[0] == (Quality.BAD, "cable out")


def test_cycle_numbers_do_not_go_back_after_a_restart_within_a_period(segment: Segment) -> None:
    class Punctual(VirtualClock):
        def wait_ns(self, duration_ns: int) -> bool:
            return super().wait_ns(min(duration_ns, self.end_ns - self.time_ns))

    cursor = segment.blocks["cell"].cursor()
    clock = Punctual(5 * PERIOD_NS + PERIOD_NS // 4)
    for end_ns in (clock.end_ns, 7 * PERIOD_NS):
        clock.end_ns = end_ns
        SourceLoop(Device(lambda *_: None), segment.writer("cell"), Schedule(0, PERIOD_NS), clock).run()
    cycles = []
    while (frame := cursor.poll()) is not None:
        cycles.append(frame.cycle)
    assert cycles[:7] == [1, 2, 3, 4, 5, 5, 6], "the last frame has the cycle in which it came"


def test_new_reason_gives_a_new_bad_frame(segment: Segment) -> None:
    reasons = iter(["refused", "refused", "garbage"])

    def trouble(hook: str, reads: int) -> None:
        if hook == "connect" and (reason := next(reasons, None)):
            raise ConnectorError(reason)

    _, loop, frames = run(segment, trouble, 60)
    assert [f.reason for f in frames[:3]] == ["refused", "garbage", ""]
    assert frames[0].raw == bytes(4)
    assert loop.note == "the source was stopped"


def test_back_off_grows_up_to_two_seconds(segment: Segment) -> None:
    attempts: list[int] = []

    def absent(hook: str, _: int) -> None:
        if hook == "connect":
            attempts.append(clock.time_ns)
            raise ConnectorError("absent")

    clock = VirtualClock(8 * 10**9)
    SourceLoop(Device(absent), segment.writer("cell"), Schedule(0, PERIOD_NS), clock).run()
    gaps_ms = [(b - a) // 1_000_000 for a, b in pairwise(attempts)]
    assert gaps_ms == sorted(gaps_ms)
    assert gaps_ms[0] < 150
    assert max(gaps_ms) <= 2000 + 2 * PERIOD_NS // 1_000_000


def test_cycles_missed_by_a_slow_read_are_overruns(segment: Segment) -> None:
    clock = VirtualClock(20 * PERIOD_NS)

    def slow(hook: str, reads: int) -> None:
        if hook == "read" and reads == 2:
            clock.time_ns += 5 * PERIOD_NS

    loop = SourceLoop(Device(slow), segment.writer("cell"), Schedule(0, PERIOD_NS), clock)
    loop.run()
    assert loop.counters.overruns == 4
    assert loop.counters.polls + loop.counters.overruns == 19


def test_a_defect_in_a_connector_is_not_taken_for_a_device_error(segment: Segment) -> None:
    def defect(hook: str, _: int) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(segment, defect, 5)
    frame = segment.blocks["cell"].latest()
    assert frame is not None
    assert frame.quality is Quality.BAD


def test_a_successor_keeps_the_last_bytes_while_it_cannot_connect(segment: Segment) -> None:
    run(segment, lambda *_: None, 4)

    def absent(hook: str, _: int) -> None:
        raise ConnectorError("absent")

    _, _, frames = run(segment, absent, 4)
    assert (frames[0].raw, frames[0].quality, frames[0].incarnation) == ((3).to_bytes(4, "big"), Quality.BAD, 2)


def test_an_answer_that_took_too_long_is_never_good(segment: Segment) -> None:
    clock = VirtualClock(300 * PERIOD_NS)

    def held(hook: str, reads: int) -> None:
        if hook == "read" and reads == 3:
            clock.time_ns += segment.blocks["cell"].stale_ns + 1

    device = Device(held)
    cursor = segment.blocks["cell"].cursor()
    SourceLoop(device, segment.writer("cell"), Schedule(0, PERIOD_NS), clock).run()
    frames = list(iter(cursor.poll, None))
    values = [(int.from_bytes(f.raw, "big"), f.quality) for f in frames[:4]]
    assert values == [(1, Quality.GOOD), (2, Quality.GOOD), (2, Quality.BAD), (4, Quality.GOOD)]
    assert "the answer took 1000 ms" in frames[2].reason
    assert device.calls[:3] == ["connect", "close", "connect"]


def test_bad_frame_has_the_time_of_its_bytes(segment: Segment) -> None:
    def fails_first_and_in_read_3(hook: str, reads: int) -> None:
        if (hook == "connect" and not device_calls) or (hook == "read" and reads == 3):
            device_calls.append(hook)
            raise ConnectorError("out")

    device_calls: list[str] = []
    _, _, frames = run(segment, fails_first_and_in_read_3, 60)
    never, first, second, again = frames[:4]
    assert (never.quality, never.source_ns) == (Quality.BAD, 0)
    assert 0 < first.source_ns <= second.source_ns
    assert (again.quality, again.source_ns) == (Quality.BAD, second.source_ns)


def test_back_off_grows_for_a_flapping_device(segment: Segment) -> None:
    clock = VirtualClock(8 * 10**9)
    connects_ns: list[int] = []

    def flaps(hook: str, reads: int) -> None:
        if hook == "connect":
            connects_ns.append(clock.time_ns)
        elif reads % 2 == 0:
            raise ConnectorError("gone again")

    SourceLoop(Device(flaps), segment.writer("cell"), Schedule(0, PERIOD_NS), clock).run()
    gaps_ms = [(b - a) // 1_000_000 for a, b in pairwise(connects_ns)]
    assert gaps_ms[0] < 300
    assert gaps_ms[-1] >= 2000


def test_stable_device_is_reconnected_at_once(segment: Segment) -> None:
    clock = VirtualClock(20 * 10**9)
    failures_ns: list[int] = []
    connects_ns: list[int] = []

    def fails_every_100_reads(hook: str, reads: int) -> None:
        if hook == "connect":
            connects_ns.append(clock.time_ns)
        elif reads % 100 == 0:
            failures_ns.append(clock.time_ns)
            raise ConnectorError("gone")

    SourceLoop(Device(fails_every_100_reads), segment.writer("cell"), Schedule(0, PERIOD_NS), clock).run()
    waits_ms = [(c - f) // 1_000_000 for f, c in zip(failures_ns, connects_ns[1:], strict=False)]
    assert len(waits_ms) > 5
    assert max(waits_ms) < 150


def test_reason_that_differs_only_in_numbers_gives_no_new_frame(segment: Segment) -> None:
    def varies(hook: str, reads: int) -> None:
        if hook == "read":
            raise ConnectorError(f"frame of {reads} bytes")

    _, _, frames = run(segment, varies, 100)
    assert [frame.reason for frame in frames] == ["frame of 1 bytes", "the source was stopped"]


def test_empty_reason_is_replaced_and_another_error_code_is_a_new_reason(segment: Segment) -> None:
    reasons = iter(["", "error 0x8104", "error 0x8304"])

    def fails(hook: str, reads: int) -> None:
        if hook == "read" and reads > 1 and (reason := next(reasons, None)) is not None:
            raise ConnectorError(reason)

    _, _, frames = run(segment, fails, 100)
    assert [frame.reason for frame in frames[1:4]] == ["the connector gave no reason", "error 0x8104", "error 0x8304"]


class Pipe(Device):
    """A device that answers after ``answer_ns`` and accepts ``cycles`` requests at once."""

    def __init__(self, clock: VirtualClock, answer_ns: int, cycles: int) -> None:
        super().__init__(lambda *_: None)
        self.clock = clock
        self.answer_ns = answer_ns
        self.cycles = cycles
        self.asked_ns: list[int] = []
        self.most = 0

    @property
    def depth(self) -> int:
        return self.cycles

    def submit(self) -> None:
        self.asked_ns.append(self.clock.time_ns)
        self.most = max(self.most, len(self.asked_ns))

    def collect(self, until_ns: int) -> bytes | None:
        due_ns = self.asked_ns[0] + self.answer_ns
        if due_ns > until_ns:
            self.clock.time_ns = max(self.clock.time_ns, until_ns)
            return None
        self.clock.time_ns = max(self.clock.time_ns, due_ns)
        self.asked_ns.pop(0)
        return self.read()


def pipe(segment: Segment, cycles: int, answer_ns: int) -> tuple[Pipe, SourceLoop, list[Frame]]:
    clock = VirtualClock(100 * PERIOD_NS)
    device = Pipe(clock, answer_ns, cycles)
    loop = SourceLoop(device, segment.writer("cell"), Schedule(0, PERIOD_NS), clock)
    cursor = segment.blocks["cell"].cursor()
    loop.run()
    return device, loop, [frame for frame in iter(cursor.poll, None) if frame.quality is Quality.GOOD]


def test_two_cycles_under_way_keep_up_with_slow_answers(segment: Segment) -> None:
    device, loop, frames = pipe(segment, 2, 3 * PERIOD_NS // 2)
    assert device.most == 2
    assert loop.counters.overruns == 0
    assert [frame.cycle for frame in frames] == list(range(1, len(frames) + 1))
    assert len(frames) >= 97
    assert all(b.publish_ns >= a.publish_ns for a, b in pairwise(frames))


def test_one_cycle_under_way_skips_cycles_if_answers_are_slow(
    segment: Segment,
) -> None:
    device, loop, frames = pipe(segment, 1, 17 * PERIOD_NS // 10)
    assert device.most == 1
    assert [frame.cycle for frame in frames[:6]] == [1, 2, 4, 6, 7, 9]  # asked at 1, 2.7, 4.4, 6.1, 7.8, 9.5
    assert loop.counters.overruns + loop.counters.polls == 98  # the last cycle was still under way


def test_one_answer_that_is_late_by_less_than_a_period_skips_no_cycle(segment: Segment) -> None:
    class Hiccup(Pipe):
        def submit(self) -> None:
            self.answer_ns = (19 if len(asked) == 4 else 1) * PERIOD_NS // 10
            asked.append(self.clock.time_ns)
            super().submit()

    asked: list[int] = []
    clock = VirtualClock(20 * PERIOD_NS)
    loop = SourceLoop(Hiccup(clock, 0, 1), segment.writer("cell"), Schedule(0, PERIOD_NS), clock)
    loop.run()
    assert [at_ns / PERIOD_NS for at_ns in asked[:8]] == [1, 2, 3, 4, 5, 6.9, 7, 8]
    assert loop.counters.overruns == 0


def test_requests_under_way_are_dropped_with_the_connection(segment: Segment) -> None:
    clock = VirtualClock(60 * PERIOD_NS)
    device = Pipe(clock, PERIOD_NS // 2, 2)
    collect = device.collect

    def cut_once(until_ns: int) -> bytes | None:
        if device.reads == 3 and device.connected and "cut" not in device.calls:
            device.calls.append("cut")
            device.asked_ns.clear()
            raise ConnectorError("cut")
        return collect(until_ns)

    device.collect = cut_once  # type: ignore[method-assign]
    cursor = segment.blocks["cell"].cursor()
    SourceLoop(device, segment.writer("cell"), Schedule(0, PERIOD_NS), clock).run()
    values = [(int.from_bytes(frame.raw, "big"), frame.quality) for frame in iter(cursor.poll, None)]
    assert values[:5] == [
        (1, Quality.GOOD),
        (2, Quality.GOOD),
        (3, Quality.GOOD),
        (3, Quality.BAD),
        (4, Quality.GOOD),
    ]


class Writing(Device):
    """A device whose count can be set."""

    can_write = True

    def write(self, writes: Sequence[Write]) -> list[str]:
        self.calls.append("write")
        self.trouble("write", self.reads)
        self.reads = int.from_bytes(writes[-1].data, "big")
        return [""] * len(writes)


def test_a_write_is_done_before_the_read_so_that_the_frame_shows_it(segment: Segment) -> None:
    sender = CommandSender(segment.blocks["cell"], 4)

    def command_before_read_4(hook: str, reads: int) -> None:
        if hook == "read" and reads == 3:
            sender.submit([Write(0, 0, (1000).to_bytes(4, "big"))], 10**18)
            loop.commands._take_one(4)  # what the commands' thread does

    clock = VirtualClock(8 * PERIOD_NS)
    loop = SourceLoop(Writing(command_before_read_4), segment.writer("cell"), Schedule(0, PERIOD_NS), clock, ["count"])
    block = segment.blocks["cell"]
    cursor = block.cursor()
    loop.run()
    frames = list(iter(cursor.poll, None))
    assert [int.from_bytes(frame.raw, "big") for frame in frames[:5]] == [1, 2, 3, 1001, 1002]
    events = [event for n in range(1, block.events.head() + 1) if (event := block.events.read(n))]
    assert [(event.kind, event.frame) for event in events] == [
        (EventKind.STARTED, 0),
        (EventKind.QUALITY, 0),
        (EventKind.ACCEPTED, 2),
        (EventKind.WRITTEN, 3),
        (EventKind.QUALITY, len(frames) - 1),
        (EventKind.STOPPED, len(frames)),
    ]
    assert frames[3].event == 4


def test_readers_of_the_first_good_frame_may_write(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    sender = CommandSender(segment.blocks["cell"], 4)
    writer = segment.writer("cell")
    publish = writer.publish

    def published(raw: Bytes, **options: Any) -> int:
        frame = publish(raw, **options)
        if frame == 1:
            sender.submit([Write(0, 0, (1000).to_bytes(4, "big"))], 10**18)
            loop.commands._take_one(4)  # what the commands' thread does
        return frame

    monkeypatch.setattr(writer, "publish", published)
    loop = SourceLoop(Writing(lambda *_: None), writer, Schedule(0, PERIOD_NS), VirtualClock(4 * PERIOD_NS), ["count"])
    cursor = segment.blocks["cell"].cursor()
    loop.run()
    frames = list(iter(cursor.poll, None))
    assert [(int.from_bytes(f.raw, "big"), f.quality) for f in frames[:2]] == [(1, Quality.GOOD), (1001, Quality.GOOD)]


def test_a_write_lost_with_the_connection_is_unknown_and_never_repeated(segment: Segment) -> None:
    sender = CommandSender(segment.blocks["cell"], 4)

    def trouble(hook: str, reads: int) -> None:
        if hook == "read" and reads == 3:
            sender.submit([Write(0, 0, bytes(4))], 10**18)
            loop.commands._take_one(4)
        if hook == "write":
            raise ConnectorError("cut")

    clock = VirtualClock(60 * PERIOD_NS)
    device = Writing(trouble)
    loop = SourceLoop(device, segment.writer("cell"), Schedule(0, PERIOD_NS), clock, ["count"])
    loop.run()
    block = segment.blocks["cell"]
    kinds = [event.kind for n in range(1, block.events.head() + 1) if (event := block.events.read(n))]
    assert kinds.count(EventKind.UNKNOWN) == 1
    assert device.calls.count("write") == 1
    assert device.reads > 10, "the loop recovers"


class Slow(Writing):
    """A device that confirms writes some cycles later, or never."""

    def __init__(self, trouble: Callable[[str, int], None], cycles: int, error: type[ConnectorError] | None) -> None:
        super().__init__(trouble)
        self._cycles, self._error = cycles, error
        self._asked = 0

    def send(self, writes: Sequence[Write]) -> None:
        self.writes, self._asked = writes, 0
        self.calls.append("send")

    def confirm(self, until_ns: int) -> list[str] | None:
        self._asked += 1
        if self._asked < self._cycles:
            return None
        if self._error is UnconfirmedError:
            raise UnconfirmedError("late", [Lost.UNKNOWN] * len(self.writes))
        if self._error is not None:
            raise self._error("cut")
        return self.write(self.writes)


@pytest.mark.parametrize(
    ("cycles", "error", "ends", "bad"),
    [
        (4, None, [EventKind.WRITTEN] * 2, 0),
        (4, UnconfirmedError, [EventKind.UNKNOWN] * 2, 0),
        (4, ConnectorError, [EventKind.UNKNOWN, EventKind.EXPIRED], 1),
        (100, None, [EventKind.UNKNOWN, EventKind.EXPIRED], 0),
    ],
    ids=["late", "unconfirmed", "lost", "stopped"],
)
def test_frames_go_on_while_the_device_has_not_confirmed_a_write(
    segment: Segment, cycles: int, error: type[ConnectorError] | None, ends: list[EventKind], bad: int
) -> None:
    """A second command waits for the outcome of the first."""
    sender = CommandSender(segment.blocks["cell"], 4)

    def commands(hook: str, reads: int) -> None:
        if hook == "read" and reads in (3, 4):
            sender.submit([Write(0, 0, (1000 * reads).to_bytes(4, "big"))], 10**18)
            loop.commands._take_one(4)

    device = Slow(commands, cycles, error)
    clock = VirtualClock(14 * PERIOD_NS)
    loop = SourceLoop(device, segment.writer("cell"), Schedule(0, PERIOD_NS), clock, ["count"])
    block = segment.blocks["cell"]
    cursor = block.cursor()
    loop.run()
    frames = list(iter(cursor.poll, None))
    events = [event for n in range(1, block.events.head() + 1) if (event := block.events.read(n))]
    found = [event for event in events if event.command]
    assert [event.kind for event in found if event.kind != EventKind.ACCEPTED] == ends
    first = next(event for event in found if event.kind == ends[0])
    if cycles == 4:
        assert first.frame == 6, "three frames came in between"
    assert sum(frame.quality is Quality.BAD for frame in frames[:-1]) == bad
    assert len(frames) > 8


def test_a_doubtful_image_is_uncertain_with_its_reason(segment: Segment) -> None:
    class Stopped(Device):
        @property
        def doubt(self) -> str:
            return "the PLC is in STOP" if 3 <= self.reads <= 5 else ""

    cursor = segment.blocks["cell"].cursor()
    SourceLoop(
        Stopped(lambda *_: None), segment.writer("cell"), Schedule(0, PERIOD_NS), VirtualClock(9 * PERIOD_NS)
    ).run()
    frames = list(iter(cursor.poll, None))[:-1]
    assert [frame.quality for frame in frames] == [Quality.GOOD] * 2 + [Quality.UNCERTAIN] * 3 + [Quality.GOOD] * 3
    assert {frame.reason for frame in frames[2:5]} == {"the PLC is in STOP"}


def test_cycles_that_pass_while_the_process_is_stopped_are_overruns(segment: Segment) -> None:
    class Held(VirtualClock):
        def wait_ns(self, duration_ns: int) -> bool:
            ended = super().wait_ns(duration_ns)
            if self.time_ns == 4 * PERIOD_NS:  # the process is stopped, and continues in cycle 7
                self.time_ns += 3 * PERIOD_NS + 1
            return ended

    clock = Held(10 * PERIOD_NS)
    loop = SourceLoop(Device(lambda *_: None), segment.writer("cell"), Schedule(0, PERIOD_NS), clock)
    cursor = segment.blocks["cell"].cursor()
    loop.run()
    frames = [frame for frame in iter(cursor.poll, None) if frame.quality is Quality.GOOD]
    assert [frame.cycle for frame in frames] == [1, 2, 3, 7, 8, 9]
    assert loop.counters.overruns == 3


def test_frame_has_the_delay_of_the_device(segment: Segment) -> None:
    _, _, frames = run(segment, lambda *_: None, 3)
    assert 0 < frames[0].delay_us < 10**7
    assert frames[-1].delay_us == 0, "a bad frame has no answer"


def test_frames_after_the_outcome_of_a_write_show_it(segment: Segment) -> None:
    """Several cycles are under way at once."""

    class Register(Pipe):
        can_write = True
        value = 0
        answers: ClassVar[list[int]] = []

        def submit(self) -> None:
            super().submit()
            self.answers.append(self.value)

        def read(self) -> bytes:
            if self.clock.time_ns > 30 * PERIOD_NS:
                self.command()
            return int(self.answers.pop(0)).to_bytes(4, "big")

        def command(self) -> None:
            if not self.value and not loop.commands.waiting:
                sender.submit([Write(0, 0, (77).to_bytes(4, "big"))], 10**18)
                loop.commands._take_one(4)

        def write(self, writes: Sequence[Write]) -> list[str]:
            assert not self.asked_ns, "reads under way"
            self.value = int.from_bytes(writes[-1].data, "big")
            return [""] * len(writes)

    sender = CommandSender(segment.blocks["cell"], 4)
    clock = VirtualClock(60 * PERIOD_NS)
    device = Register(clock, 5 * PERIOD_NS // 2, 4)
    block = segment.blocks["cell"]
    cursor = block.cursor()
    loop = SourceLoop(device, segment.writer("cell"), Schedule(0, PERIOD_NS), clock, ["count"])
    loop.run()
    events = [event for n in range(1, block.events.head() + 1) if (event := block.events.read(n))]
    (written,) = (event.number for event in events if event.kind == EventKind.WRITTEN)
    frames = [frame for frame in iter(cursor.poll, None) if frame.quality is Quality.GOOD]
    assert {int.from_bytes(frame.raw, "big") for frame in frames if frame.event >= written} == {77}
    assert {int.from_bytes(frame.raw, "big") for frame in frames if frame.event < written} == {0}
