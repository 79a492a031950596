"""Segments: they are built, opened and refused."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shmio.errors import (
    AlreadyRunningError,
    FormatError,
    NotRunningError,
    SegmentError,
    UnfinishedError,
    WrongInstanceError,
)
from shmio.layout.model import Layout, Register
from shmio.segment import (
    Activity,
    BlockSpec,
    Phase,
    ProcessSpec,
    Quality,
    Report,
    Segment,
    State,
    Supervised,
    instances,
    segment_size,
)
from shmio.segment._atomics import RAW_OFFSET
from shmio.segment.block import Cursor
from shmio.segment.header import GENERATION_OFFSET, HEADER_SIZE
from shmio.segment.processes import MOST_COUNTERS, SUPERVISOR_LOCK
from shmio.segment.segment import PREFIX
from shmio.segment.shm import SharedObject, unlink

LAYOUT = Layout(
    "DB1", 1, 6, False, (Register("speed", "REAL", (), 0, None, 4, 1), Register("on", "BOOL", (), 4, 0, 1, 1))
)
PROCESSES = [ProcessSpec("cell", "source"), ProcessSpec("grpc", "grpc")]


def block(source: str = "cell", **changes: int) -> BlockSpec:
    fields = {"period_ns": 20_000_000, "stale_ns": 500_000_000, "ring_bytes": 1 << 26} | changes
    return BlockSpec(source, LAYOUT, fields["period_ns"], fields["stale_ns"], fields["ring_bytes"])


def test_both_start_times_are_of_the_same_moment(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """They convert times of frames to UTC, so the time that the system needs for the memory must not change them."""
    allocate = SharedObject.allocate

    def busy(shared: SharedObject, size: int) -> None:
        until_ns = time.monotonic_ns() + 50_000_000
        while time.monotonic_ns() < until_ns:
            pass
        allocate(shared, size)

    monkeypatch.setattr(SharedObject, "allocate", busy)
    with Segment.create(instance, [block()], PROCESSES) as built:
        head = built.header
        apart_ns = head.started_utc_ns - head.started_ns - (time.time_ns() - time.monotonic_ns())
        assert abs(apart_ns) < 25_000_000
        built.unlink()


def test_an_opened_segment_has_what_its_supervisor_created(instance: str) -> None:
    with Segment.create(instance, [block("cell"), block("press")], PROCESSES, control="/run/x.sock") as built:
        with Segment.open(instance) as opened:
            assert list(opened.blocks) == ["cell", "press"]
            assert opened.blocks["cell"].layout == LAYOUT
            assert (opened.blocks["press"].period_ns, opened.blocks["press"].stale_ns) == (20_000_000, 500_000_000)
            assert [(slot.name, slot.kind) for slot in opened.processes] == [("cell", "source"), ("grpc", "grpc")]
            assert opened.header == built.header
            assert (opened.header.instance, opened.header.mode, opened.header.control) == (
                instance,
                "live",
                "/run/x.sock",
            )
            assert opened.supervisor == (os.getpid(), State.STARTING)
            assert opened.supervised
            built.set_state(4711, State.RUNNING)
            assert opened.supervisor == (4711, State.RUNNING)
        assert instance in instances()
        built.unlink()
    assert instance not in instances()


def test_the_size_is_the_computed_size(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        assert segment.header.size == segment.shared.size == segment_size([block()], len(PROCESSES))
        segment.unlink()


def test_a_second_supervisor_is_refused_with_the_pid_of_the_first(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        with pytest.raises(AlreadyRunningError, match=f"pid {os.getpid()}"):
            Segment.create(instance, [block()], PROCESSES)
        segment.unlink()


@pytest.mark.parametrize("cleared", [False, True])
def test_a_new_segment_that_another_supervisor_has_locked_is_given_up(
    instance: str, monkeypatch: pytest.MonkeyPatch, cleared: bool
) -> None:
    """The other supervisor comes between creation and lock. It may have removed the segment's name."""
    create = SharedObject.create
    others = []

    def overtaken(name: str, group: str | None = None) -> SharedObject:
        shared = create(name, group)
        other = SharedObject.open(name, writable=True)
        assert other.try_lock(SUPERVISOR_LOCK)
        if cleared:
            unlink(name)
            other.unlock(SUPERVISOR_LOCK)
        others.append(other)
        return shared

    monkeypatch.setattr(SharedObject, "create", overtaken)
    with pytest.raises(AlreadyRunningError, match=f"starting instance {instance}"):
        Segment.create(instance, [block()], PROCESSES)
    for other in others:
        assert other.size == 0, "the object belongs to the other supervisor"
        assert other.current() is not cleared
        other.close()
    unlink(PREFIX + instance)


def test_an_object_is_current_until_its_name_is_removed(instance: str) -> None:
    name = PREFIX + instance
    shared, closed = SharedObject.create(name), SharedObject.open(name, writable=False)
    closed.close()
    assert shared.current()
    assert closed.current()
    unlink(name)
    assert not shared.current()
    assert not closed.current()
    other = SharedObject.create(name)
    assert not shared.current(), "the name belongs to another object"
    assert not closed.current(), "the name belongs to another object"
    assert other.current()
    unlink(name)
    shared.close()
    other.close()


def test_a_private_object_takes_only_the_memory_that_is_used() -> None:
    """Laboratories of many sources have many rings, and short runs use little of each."""
    shared = SharedObject.private("private")
    shared.allocate(64 << 20)
    memory = shared.map()
    for at in range(0, len(memory), 2 << 20):
        memory[at] = 1
    begin = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    found = 0
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if span := re.match(r"([0-9a-f]+)-([0-9a-f]+) ", line):
            inside = int(span[1], 16) <= begin < int(span[2], 16)
        elif line.startswith("Rss:") and inside:
            found = int(line.split()[1])
    assert 0 < found < 8 << 10, f"{found} kB"
    shared.close()


def test_a_ring_without_a_readable_frame_is_reported_with_the_remedy(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        writer = segment.writer("cell")
        assert segment.blocks["cell"].latest() is None
        writer.publish(b"unique", cycle=0)
        at = bytes(segment.memory).find(b"unique") - RAW_OFFSET
        segment.memory[at : at + 8] = (2 * 9 + 1).to_bytes(8, "little")  # a later frame is being written into the slot
        with pytest.raises(SegmentError, match=r"overwritten faster.*ring_mb"):
            segment.blocks["cell"].latest()
        segment.unlink()


def test_an_instance_that_is_not_running_is_named_with_the_remedy(instance: str) -> None:
    with pytest.raises(NotRunningError, match=f"{instance}.*shmio-supervisor up"):
        Segment.open(instance)


@pytest.mark.parametrize("known", [True, False])
def test_an_instance_of_another_configuration_is_refused_with_both_paths(
    instance: str, tmp_path: Path, known: bool
) -> None:
    own, other = (tmp_path / folder / "supervisor.toml" for folder in ("own", "other"))
    with Segment.create(instance, [], [], config=own if known else None) as segment:
        started = str(own) if known else "an unknown file"
        with pytest.raises(WrongInstanceError, match=rf"{started}.* not from {other}; .*--instance {instance}"):
            Segment.open(instance, config=other)
        segment.unlink()


def test_creation_without_room_fails_and_leaves_nothing(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("shmio.segment.shm.os.posix_fallocate", full)
    with pytest.raises(SegmentError, match=r"no room.*ring_mb"):
        Segment.create(instance, [block()], PROCESSES)
    assert instance not in instances()


def test_an_unknown_group_is_named_and_leaves_nothing(instance: str) -> None:
    with pytest.raises(SegmentError, match="no-such-group"):
        Segment.create(instance, [block()], PROCESSES, group="no-such-group")
    assert instance not in instances()


def test_only_the_owner_can_open_it_by_default(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        assert (Path("/dev/shm") / f"shmio-{instance}").stat().st_mode & 0o777 == 0o600
        segment.unlink()


def test_another_abi_version_is_refused(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        segment.memory[8:12] = (7).to_bytes(4, "little")
        with pytest.raises(FormatError, match=r"ABI 7.*ABI 2"):
            Segment.open(instance)
        segment.unlink()


def test_an_object_that_is_not_a_segment_is_refused(instance: str) -> None:
    path = Path("/dev/shm") / f"shmio-{instance}"
    path.write_bytes(b"")
    with pytest.raises(NotRunningError, match="is starting"):
        Segment.open(instance)
    path.write_bytes(bytes(HEADER_SIZE))
    with pytest.raises(UnfinishedError, match="not a complete shmio segment"):
        Segment.open(instance)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
@given(edits=st.lists(st.tuples(st.integers(8, 12_000), st.binary(min_size=1, max_size=8)), min_size=1, max_size=6))
def test_a_damaged_segment_is_refused_or_read_but_never_crashes(instance: str, edits: list[tuple[int, bytes]]) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        try:
            segment.writer("cell").publish(bytes(6), cycle=1)
            for at, data in edits:
                end = min(at + len(data), len(segment.memory))
                segment.memory[at:end] = data[: max(0, end - at)]
            try:
                opened = Segment.open(instance)
            except SegmentError:
                return
            with opened:
                for found in opened.blocks.values():
                    found.ring.latest()
                    with suppress(FormatError):
                        assert found.layout.size == found.ring.frame_size
                for slot in opened.processes:
                    assert isinstance(slot.report.pid, int)
                    assert isinstance(slot.supervised.phase, Phase)
        finally:
            segment.unlink()


def test_a_damaged_layout_is_refused_only_when_it_is_needed(instance: str) -> None:
    with Segment.create(instance, [block("good"), block("damaged")], PROCESSES) as segment:
        at = bytes(segment.memory).rindex(b'{"name":')
        segment.memory[at : at + 1] = b"!"
        with Segment.open(instance) as opened:
            assert opened.blocks["good"].layout == LAYOUT
            assert opened.blocks["damaged"].ring.frame_size == LAYOUT.size
            with pytest.raises(FormatError, match="block damaged: layout"):
                _ = opened.blocks["damaged"].layout
        segment.unlink()


def test_a_section_count_beyond_the_table_is_refused(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        segment.memory[GENERATION_OFFSET + 4 : GENERATION_OFFSET + 8] = (60_000).to_bytes(4, "little")
        with pytest.raises(FormatError, match="the header counts 60000 sections"):
            Segment.open(instance)
        segment.unlink()


@pytest.mark.parametrize(
    ("period_ns", "slots"), [(20_000_000, 512), (1_000_000, 8192), (3_600_000_000_000, 8), (100_000_000, 128)]
)
def test_a_ring_holds_eight_seconds_rounded_up_to_a_power_of_two(period_ns: int, slots: int) -> None:
    assert block(period_ns=period_ns).slots == slots


def test_a_ring_stays_within_its_memory() -> None:
    bounded = block(ring_bytes=10_000, period_ns=1_000_000)
    assert bounded.slots * bounded.slot_bytes <= 10_000
    assert bounded.slots == 16


def test_frames_pass_from_writer_to_reader(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment, Segment.open(instance) as opened:
        reader = opened.blocks["cell"]
        cursor = reader.cursor()
        assert reader.latest() is None
        writer = segment.writer("cell")
        writer.publish(b"abcdef", cycle=5)
        writer.publish(b"ghijkl", cycle=6, quality=Quality.BAD, reason="cut")
        first, second = cursor.next(1.0), cursor.next(1.0)
        assert first is not None
        assert second is not None
        assert (first.raw, first.cycle, first.quality, first.reason) == (b"abcdef", 5, Quality.GOOD, "")
        assert (second.raw, second.quality, second.reason) == (b"ghijkl", Quality.BAD, "cut")
        assert 0 <= first.clock_ns <= second.clock_ns
        assert cursor.next(0.0) is None
        assert cursor.missed == 0
        segment.unlink()


def test_a_slow_reader_counts_missed_frames_exactly(instance: str) -> None:
    with Segment.create(instance, [block(period_ns=1_000_000_000)], PROCESSES) as segment:
        reader = segment.blocks["cell"]
        slots = reader.ring.slot_count
        cursor = reader.cursor()
        writer = segment.writer("cell")
        total = 3 * slots
        for cycle in range(total):
            writer.publish(bytes(6), cycle=cycle)
        seen = []
        while (frame := cursor.poll()) is not None:
            seen.append(frame.cycle)
        assert seen == list(range(seen[0], total))
        assert cursor.missed == total - len(seen) == seen[0] == total - slots
        segment.unlink()


def test_a_reader_that_is_overtaken_repeatedly_still_gets_a_frame() -> None:
    class Fast:
        slot_count = 64
        written = 1000

        def head(self) -> int:
            return self.written

        def read(self, number: int) -> int | None:
            self.written += 3  # the next frame is already being written
            return number if number > self.written - self.slot_count + 1 else None

    ring: Any = Fast()
    cursor: Cursor[Any] = Cursor(ring, lambda fields: fields, 0, lambda: False)
    assert cursor.poll() == cursor.last == cursor.missed + 1
    assert cursor.behind < ring.slot_count


def test_a_new_writer_continues_the_numbers_with_the_next_incarnation(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        assert segment.writer("cell").publish(bytes(6), cycle=1) == 1
        assert segment.writer("cell").publish(bytes(6), cycle=9) == 2
        frames = [segment.blocks["cell"].read(number) for number in (1, 2)]
        assert [(f.incarnation, f.cycle) for f in frames if f] == [(1, 1), (2, 9)]
        segment.unlink()


def test_the_time_for_the_devices_answer_is_part_of_the_age(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        writer = segment.writer("cell")
        writer.publish(bytes(6), cycle=1, asked_ns=time.monotonic_ns() - 400_000_000)
        frame = segment.blocks["cell"].latest()
        assert frame is not None
        assert frame.delay_us >= 400_000
        assert frame.assess(500_000_000, frame.publish_ns + 50_000_000)[0] is Quality.GOOD
        assert frame.assess(500_000_000, frame.publish_ns + 110_000_000)[0] is Quality.BAD
        writer.publish(bytes(6), cycle=2, asked_ns=time.monotonic_ns() + 10**9)
        assert (latest := segment.blocks["cell"].latest())
        assert latest.delay_us == 0
        segment.unlink()


def test_an_old_frame_is_never_good(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        segment.writer("cell").publish(bytes(6), cycle=1)
        frame = segment.blocks["cell"].latest()
        assert frame is not None
        assert frame.assess(500_000_000, frame.publish_ns + 500_000_000) == (Quality.GOOD, "")
        assert frame.assess(500_000_000, frame.publish_ns + 2_500_000_001) == (
            Quality.BAD,
            "stale: no newer frame, and this frame is 2.5 s old",
        )
        segment.unlink()


def test_a_process_slot_has_the_data_of_supervisor_and_process(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment, Segment.open(instance) as opened:
        mine, theirs = segment.processes.find("cell"), opened.processes.find("cell")
        assert (theirs.report, theirs.supervised, theirs.heartbeat_ns) == (
            Report(counters=(0,) * MOST_COUNTERS),
            Supervised(),
            0,
        )
        mine.supervised = Supervised(Phase.BACKOFF, 3, 99, "ä" * 300)
        mine.report = Report(12, Activity.RUNNING, 5, (1, 2, 3, 4, 5, 6), "why\n")
        mine.beat()
        assert theirs.supervised == Supervised(Phase.BACKOFF, 3, 99, "ä" * 175)
        assert theirs.report == Report(12, Activity.RUNNING, 5, (1, 2, 3, 4, 5, 6, *[0] * (MOST_COUNTERS - 6)), "why\n")
        assert theirs.counters["overruns"] == 2
        assert theirs.heartbeat_ns > 0
        segment.unlink()


def test_one_process_at_a_time_has_a_role_until_it_ends(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment, Segment.open(instance) as watcher:
        first, second = Segment.open(instance, writable=True), Segment.open(instance, writable=True)
        assert not watcher.processes.find("cell").alive()
        assert first.processes.find("cell").take()
        assert not second.processes.find("cell").take()
        assert second.processes.find("grpc").take()
        assert watcher.processes.find("cell").alive()
        first.close()
        assert not watcher.processes.find("cell").alive()
        second.close()
        segment.unlink()


def test_closing_frees_the_role_even_if_a_ring_is_referenced(instance: str) -> None:
    with Segment.create(instance, [block()], PROCESSES) as segment:
        holder = Segment.open(instance, writable=True)
        ring = holder.blocks["cell"].ring
        assert holder.processes.find("cell").take()
        holder.close()
        assert not segment.processes.find("cell").alive()
        assert ring.head() == 0  # the mapping remains
        segment.unlink()
