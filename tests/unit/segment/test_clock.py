"""The clock page, which its owner writes and other processes read."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from shmio.errors import FormatError
from shmio.layout.model import Layout, Register
from shmio.model.clock import Clock, ClockMode
from shmio.model.values import Provenance
from shmio.segment import Attributes, Block, BlockSpec, Frame, ProcessSpec, Quality, Segment
from shmio.segment.clock import time_lock
from shmio.segment.header import SectionKind, read_sections, table_state

LAYOUT = Layout("DB1", 1, 4, False, (Register("count", "UDINT", (), 0, None, 4, 1),))
STATE = Clock(
    ClockMode.VIRTUAL, 12, 5_000_000_000, 20_000_000, 11, 30_000_000, True, 2.5, True, 4711, "step 12 waits for sim"
)


def spec(name: str, *, stepped: bool) -> BlockSpec:
    return BlockSpec(name, LAYOUT, 20_000_000, 500_000_000, 1 << 20, Attributes("memory", stepped=stepped))


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    blocks = [spec("sim", stepped=True), spec("cell", stepped=False)]
    processes = [ProcessSpec("sim", "source"), ProcessSpec("cell", "source")]
    with Segment.create(instance, blocks, processes) as segment:
        yield segment
        segment.unlink()


def test_a_new_instance_has_wall_time(segment: Segment) -> None:
    before_ns = time.monotonic_ns() - segment.header.started_ns
    state = segment.clock.read()
    after_ns = time.monotonic_ns() - segment.header.started_ns
    assert (state.mode, state.step, state.done, state.playing, state.owner) == (ClockMode.WALL, 0, 0, False, 0)
    assert state.step_size_ns == 50_000_000
    assert before_ns <= state.time_ns <= after_ns
    assert state.time_ns == state.present_ns


def test_an_instance_stepped_from_the_start_has_time_zero(instance: str) -> None:
    with Segment.create(instance, [], [], stepped=True) as segment:
        state = segment.clock.read()
        assert (str(state.mode), state.time_ns, state.step) == ("virtual", 0, 0)
        assert segment.clock.now_ns() == segment.header.started_ns
        segment.unlink()


def test_another_process_reads_the_written_state(segment: Segment, instance: str) -> None:
    assert segment.shared.try_lock(time_lock(segment.header))
    segment.clock.write(STATE)
    with Segment.open(instance) as reader:
        assert reader.clock.read() == segment.clock.read() == STATE


def test_time_does_not_play_after_its_owner_has_ended(segment: Segment, instance: str) -> None:
    with Segment.open(instance, writable=True) as owner:
        assert owner.shared.try_lock(time_lock(segment.header))
        owner.clock.write(STATE)
        assert segment.clock.read() == STATE
    assert segment.clock.read() == STATE._replace(playing=False)
    assert segment.clock.last_written() == STATE, "the last state stays readable for a successor"


def test_the_page_says_whether_time_was_stepped_from_the_start(segment: Segment, instance: str) -> None:
    segment.clock.write(STATE)
    assert not segment.clock.stepped, "time was taken over later"
    with Segment.create(f"{instance}-stepped", [], [], stepped=True) as other:
        assert other.clock.stepped
        other.unlink()


def test_now_is_before_the_step_in_progress(segment: Segment) -> None:
    segment.clock.write(STATE)
    assert segment.clock.now_ns() == segment.header.started_ns + 4_980_000_000
    segment.clock.write(STATE._replace(stepping=False))
    assert segment.clock.now_ns() == segment.header.started_ns + 5_000_000_000


def test_released_time_continues_from_its_last_value_for_all_readers(segment: Segment, instance: str) -> None:
    segment.clock.write(STATE)
    real = Clock(step=12, done=11, resumed_ns=5_000_000_000, offset_ns=-7_000_000_000)
    segment.clock.write(real)
    with Segment.open(instance) as reader:
        assert reader.clock.last_written() == real._replace(time_ns=5_000_000_000)
        before_ns = time.monotonic_ns()
        now_ns, state = reader.clock.now_ns(), reader.clock.read()
        after_ns = time.monotonic_ns()
        assert before_ns <= now_ns + 7_000_000_000 <= after_ns
        assert now_ns <= reader.header.started_ns + state.time_ns <= after_ns - 7_000_000_000
        assert (real.lead(20_000_000), real.lead(3_000_000_000)) == (12 - 250, 12 - 1)


@pytest.mark.parametrize("copy", [64, 320])
def test_the_last_state_is_readable_after_a_writer_died_half_way(segment: Segment, copy: int) -> None:
    segment.clock.write(STATE)
    (entry,) = [
        entry
        for entry in read_sections(segment.memory, segment.header, table_state(segment.memory)[1], "")
        if entry.kind == SectionKind.CLOCK
    ]
    at = entry.offset + copy
    odd = int.from_bytes(segment.memory[at : at + 8], "little") | 1
    segment.memory[at : at + 8] = odd.to_bytes(8, "little")
    assert segment.clock.last_written() == STATE
    segment.clock.write(STATE._replace(step=13))
    assert segment.clock.read().step == 13


def test_the_begin_and_the_end_of_a_step_change_only_what_belongs_to_the_step(segment: Segment, instance: str) -> None:
    before = STATE._replace(stepping=False, note="a note of the step before")
    page = segment.clock
    with Segment.open(instance) as reader:
        page.write(before)
        seen = reader.clock.bell.value()
        page.begin_step(before, 13, 9_000_000_000, 50_000_000, before.done)
        begun = before._replace(step=13, time_ns=9_000_000_000, dt_ns=50_000_000, stepping=True, note="")
        assert reader.clock.last_written() == page.last_written() == begun
        assert reader.clock.bell.value() == seen, "nobody has to act on a step before it is done"
        page.end_step(before, 13, 9_000_000_000, 50_000_000, 13, "a replay did not move")
        ended = begun._replace(stepping=False, done=13, note="a replay did not move")
        assert reader.clock.last_written() == page.last_written() == ended
        assert reader.clock.bell.value() != seen


@pytest.mark.parametrize("stepping", [True, False])
def test_a_source_reads_the_requested_step(segment: Segment, instance: str, stepping: bool) -> None:
    with Segment.open(instance) as reader:
        assert not reader.clock.step_request().virtual
        segment.clock.write(STATE._replace(stepping=stepping))
        assert reader.clock.step_request() == (True, stepping, STATE.step, STATE.time_ns, STATE.dt_ns)


def test_an_invalid_rate_is_read_as_one(segment: Segment) -> None:
    segment.clock.write(STATE._replace(rate=float("nan")))
    assert segment.clock.read().rate == 1.0


def test_a_long_note_is_cut(segment: Segment) -> None:
    segment.clock.write(STATE._replace(note="ä" * 200))
    assert segment.clock.read().note == "ä" * 83


def test_every_change_rings_the_clocks_doorbell_only(segment: Segment, instance: str) -> None:
    with Segment.open(instance) as reader:
        bell, own = reader.clock.bell, reader.clock.slot_bell(0)
        seen, seen_own = bell.value(), own.value()
        woken = threading.Thread(target=bell.wait, args=(seen,))
        woken.start()
        segment.clock.write(STATE)
        woken.join()
        assert bell.value() != seen
        assert own.value() == seen_own
        segment.clock.slot_bell(0).ring()
        assert own.value() != seen_own


def test_deliveries_are_counted_by_slot(segment: Segment, instance: str) -> None:
    with Segment.open(instance) as reader:
        assert reader.clock.delivered(1) is None
        seen = reader.clock.delivered_bell.value()
        segment.clock.deliver(1, 0)
        assert reader.clock.delivered(1) == 0
        segment.clock.deliver(1, 12)
        assert (reader.clock.delivered(0), reader.clock.delivered(1)) == (None, 12)
        assert reader.clock.delivered_bell.value() != seen
        segment.clock.abstain(1)
        assert reader.clock.delivered(1) is None, "steps do not wait for this slot"


def test_the_age_of_a_frame_uses_the_clock_of_its_block(segment: Segment) -> None:
    sim, cell = segment.writer("sim"), segment.writer("cell")
    hour_ns = 3_600_000_000_000
    segment.clock.write(STATE._replace(time_ns=hour_ns, stepping=False))
    sim.publish(bytes(4), cycle=12)
    cell.publish(bytes(4), cycle=12)
    frames = {}
    for name in ("sim", "cell"):
        frame = segment.blocks[name].latest()
        assert frame is not None
        frames[name] = frame
    assert frames["sim"].publish_ns == segment.header.started_ns + hour_ns
    assert frames["sim"].clock_ns == hour_ns
    assert frames["cell"].clock_ns < hour_ns, "a device's frames have real time"
    assert frames["sim"].age_ns(segment.blocks["sim"].now_ns()) == 0
    segment.clock.write(STATE._replace(time_ns=hour_ns + 600_000_000, stepping=False))
    block = segment.blocks["sim"]
    assert frames["sim"].assess(block.stale_ns, block.now_ns())[0] is Quality.BAD
    assert frames["cell"].assess(block.stale_ns, segment.blocks["cell"].now_ns())[0] is Quality.GOOD


def test_a_step_stamps_its_frames_and_events_with_its_own_time(segment: Segment) -> None:
    writer = segment.writer("sim")
    writer.at_ns = segment.clock.monotonic_ns(7_000_000_000)
    writer.publish(bytes(4), cycle=1, asked_ns=writer.now_ns())
    frame = segment.blocks["sim"].latest()
    assert frame is not None
    assert (frame.clock_ns, frame.delay_us) == (7_000_000_000, 0)


def test_a_segment_without_a_clock_page_is_refused(segment: Segment, instance: str) -> None:
    count = table_state(segment.memory)[1]
    kind_at = segment.header.sections_offset + (count - 1) * 128
    segment.memory[kind_at : kind_at + 4] = (99).to_bytes(4, "little")
    with pytest.raises(FormatError, match=r"no clock page.*older"):
        Segment.open(instance)


def test_a_wait_returns_the_value_of_the_doorbell(segment: Segment) -> None:
    bell = segment.clock.bell
    before = bell.value()
    assert bell.wait(before, 1) == before  # no ring within a nanosecond
    bell.ring()
    assert bell.wait(before) == bell.value() != before


def test_a_frame_from_the_future_is_bad(segment: Segment) -> None:
    """In virtual time, which may go back, no frame of a stepped source is from the future."""
    frame = Frame(1, 1, 0, 0, 1, 1, Quality.GOOD, Provenance.LIVE, 0, 0, "", bytes(4), None)
    sim, cell = segment.blocks["sim"], segment.blocks["cell"]

    def quality(block: Block, publish_ns: int) -> Quality:
        found, reason = block.assess(frame._replace(publish_ns=publish_ns))
        assert ("in the future" in reason) is (found is Quality.BAD), reason
        return found

    for block in (sim, cell):
        assert quality(block, time.monotonic_ns()) is Quality.GOOD
        assert quality(block, time.monotonic_ns() + 10**9) is Quality.BAD
        assert quality(block, (1 << 63) - 1) is Quality.BAD
        bad = frame._replace(publish_ns=(1 << 63) - 1, quality=Quality.BAD, reason="no answer")
        assert block.assess(bad) == (Quality.BAD, "no answer")
    assert segment.shared.try_lock(time_lock(segment.header))
    segment.clock.write(STATE)
    after_ns = segment.clock.monotonic_ns(STATE.time_ns)
    assert sim.now_ns() < after_ns
    assert quality(sim, after_ns) is Quality.GOOD
    assert quality(sim, after_ns + 10**9) is Quality.GOOD, "a restored snapshot may turn time back"
    assert quality(cell, time.monotonic_ns() + 10**9) is Quality.BAD
