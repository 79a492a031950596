"""A local program that plays virtual time at a rate."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from shmio.errors import NotRunningError, TimeError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.local.attach import Attachment
from shmio.local.time_control import Coordinator
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Quality, Segment

LAYOUT = Layout("DB1", 1, 4, False, (Register("count", "UDINT", (), 0, None, 4, 1),))
MS = 1_000_000
PATIENCE_S = 20.0


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    block = BlockSpec("sim", LAYOUT, 20 * MS, 500 * MS, 1 << 20, Attributes("simulation", stepped=True))
    with Segment.create(instance, [block], [ProcessSpec("sim", "source")], stepped=True) as segment:
        yield segment
        segment.unlink()


@pytest.fixture
def source(segment: Segment) -> Iterator[dict[int, str]]:
    """Run a source that answers every step. A reason in the yielded dict makes the step of that number fail."""
    failures: dict[int, str] = {}
    writer, bell = segment.writer("sim"), segment.clock.slot_bell(0)
    over = threading.Event()

    def run() -> None:
        handled = 0
        while not over.is_set():
            seen = bell.value()
            state = segment.clock.read()
            if state.stepping and state.step != handled:
                handled = state.step
                reason = failures.get(handled, "")
                writer.publish(bytes(4), cycle=handled, quality=Quality.BAD if reason else Quality.GOOD, reason=reason)
            else:
                bell.wait(seen)

    thread = threading.Thread(target=run)
    thread.start()
    yield failures
    over.set()
    bell.ring()
    thread.join()


@pytest.fixture
def cell(instance: str, segment: Segment, source: dict[int, str]) -> Iterator[Attachment]:
    with Attachment(Segment.open(instance, writable=True)) as cell:
        yield cell


def until_step(cell: Attachment, number: int) -> None:
    block, deadline_s = cell.block(), time.monotonic() + PATIENCE_S
    while cell.clock.done < number and cell.clock.playing:
        assert time.monotonic() < deadline_s, f"step {number} was not made"
        block.ring.wait(block.ring.doorbell(), 10 * MS)


def test_step_of_count_zero_is_refused(cell: Attachment) -> None:
    with pytest.raises(ValueRangeError, match="at least 1, not 0"):
        cell.step(count=0)
    assert cell.step(count=2).step == 2


def test_play_runs_until_pause(cell: Attachment) -> None:
    cell.play(rate=100, dt_s=0.01)
    until_step(cell, 5)
    assert (cell.clock.playing, cell.clock.rate) == (True, 100)
    with pytest.raises(TimeError, match="pause it"):
        cell.step()
    cell.pause()
    stands = cell.clock
    assert (stands.playing, stands.stepping) == (False, False)
    assert stands.time_ns == stands.step * 10 * MS
    made = cell.step()
    assert (made.step, made.time_ns) == (stands.step + 1, stands.time_ns + 50 * MS)


def test_playing_program_can_release_time(instance: str) -> None:
    with (
        Segment.create(instance, [], []) as segment,
        Attachment(Segment.open(instance, writable=True)) as cell,
        Attachment(Segment.open(instance, writable=True)) as other,
    ):
        cell.play(rate=100)
        with pytest.raises(TimeError, match="which is playing it; stop that program first"):
            other.release()
        cell.release()
        assert not other.clock.virtual
        assert other.step().step > 0, "time has no owner"
        other.release()
        segment.unlink()


def test_play_keeps_the_rate(cell: Attachment) -> None:
    """Time is never faster than asked for. How much slower it is depends on the machine."""
    begun_ns = cell.block().clock.read().time_ns
    watch = threading.Event()
    cell.play(rate=1, dt_s=3600)
    watch.wait(0.05)
    cell.pause()
    assert cell.clock.time_ns - begun_ns == 3_600_000 * MS, "the second step is an hour away"


def test_failing_step_ends_the_play_and_pause_raises_it(cell: Attachment, source: dict[int, str]) -> None:
    source[3] = "on fire"
    cell.play(rate=1000, dt_s=0.01)
    until_step(cell, 3)
    with pytest.raises(TimeError, match="step 3: sim: on fire"):
        cell.pause()
    assert (cell.clock.done, cell.clock.playing) == (2, False)
    assert cell.step().step == 4


def test_detaching_while_playing_frees_time(instance: str, segment: Segment, source: dict[int, str]) -> None:
    with Attachment(Segment.open(instance, writable=True)) as cell:
        cell.play(rate=100)
        until_step(cell, 1)
    state = segment.clock.read()
    assert (state.playing, state.owner) == (False, 0)
    assert Coordinator(segment).step().number == state.step + 1


def test_invalid_rate_or_step_size_is_refused(cell: Attachment) -> None:
    with pytest.raises(ValueRangeError, match="rate must be above 0"):
        cell.play(0)
    for wrong in (0, -1, 1e300, float("inf"), float("nan")):
        with pytest.raises(ValueRangeError, match=r"0\.001 ms to 3600000 ms"):
            cell.step(dt_s=wrong)
        with pytest.raises(ValueRangeError, match=r"0\.001 ms to 3600000 ms"):
            cell.play(1, dt_s=wrong)
    assert not cell.clock.playing


def test_stopped_instance_refuses_a_step(cell: Attachment, segment: Segment) -> None:
    segment.unlink()
    with pytest.raises(NotRunningError, match="has stopped"):
        cell.step()
