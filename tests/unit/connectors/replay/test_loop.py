"""Playing a recording: frames and events as recorded, at their times, live and step by step."""

from __future__ import annotations

import time
from itertools import groupby
from pathlib import Path

import pytest

from shmio.connectors.replay.loop import OVER, STOPPED
from shmio.local.attach import attach
from shmio.local.time_control import Coordinator
from shmio.local.writer import SourceWriter
from shmio.model.values import NO_WRITER
from shmio.segment import EventKind, Origin, Provenance, Quality, Record
from shmio.segment.playhead import MoveRequest
from tests.unit.connectors.replay.harness import (
    BEGIN_NS,
    MS,
    PERIOD_NS,
    Playing,
    S,
    built,
    counts,
    image,
    record,
    recorded,
)

GUEST = 0


def outcome_of_write(source_writer: SourceWriter, value: int) -> str:
    [outcome] = source_writer.write({"count": value})
    return f"{outcome.kind}: {outcome.text}"


def test_frames_are_replayed_unchanged_at_their_times(tmp_path: Path, instance: str) -> None:
    """The instance's clock in each frame is the time at which the frame was due, without jitter."""
    file = record(tmp_path, instance)
    with built(instance, stepped=False) as segment, Playing(segment, file, speed=4) as cell:
        first = cell.next()
        frames = [first, *(cell.next() for _ in range(19))]
        last = cell.next()
    assert counts(frames) == list(range(20))
    assert [frame.cycle for frame in frames] == list(range(5001, 5021))
    assert [frame.source_ns for frame in frames] == [BEGIN_NS + n * PERIOD_NS for n in range(20)]
    assert {frame.clock_ns - first.clock_ns - n * PERIOD_NS // 4 for n, frame in enumerate(frames)} == {0}
    assert {frame.publish_ns - first.publish_ns - n * PERIOD_NS for n, frame in enumerate(frames)} == {0}
    assert {(frame.quality, frame.provenance, frame.delay_us) for frame in frames} == {
        (Quality.GOOD, Provenance.REPLAYED, 3)
    }
    assert (last.quality, last.reason, last.raw) == (Quality.BAD, OVER, frames[-1].raw)
    assert last.publish_ns - frames[-1].publish_ns == PERIOD_NS


def test_no_frame_comes_before_its_time(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance, stepped=False) as segment, Playing(segment, file) as cell:
        for _ in range(20):
            frame = cell.next()
            assert segment.clock.present_ns() >= frame.clock_ns


def test_instance_may_use_the_recordings_clock(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    origin = Origin(BEGIN_NS, 7_000 * S)
    with built(instance, stepped=False, origin=origin) as segment, Playing(segment, file, own_clock=True) as cell:
        frames = [cell.next() for _ in range(20)]
        assert segment.clock.utc_ns(frames[0].publish_ns) == 7_000 * S + BEGIN_NS
    assert [frame.clock_ns for frame in frames] == [BEGIN_NS + n * PERIOD_NS for n in range(20)]
    assert [segment.clock_ns(frame.publish_ns) for frame in frames] == [frame.clock_ns for frame in frames]


def test_events_are_replayed_without_an_owner(tmp_path: Path, instance: str) -> None:
    with recorded(tmp_path, instance) as [cell]:
        cell.frame(BEGIN_NS, image(0))
        cell.event(BEGIN_NS + MS, Record(EventKind.ACCEPTED, "", 3, 77, 1, 1, 0, 0, 2, b"\0\5"))
        cell.event(BEGIN_NS + 2 * MS, Record(EventKind.WRITTEN, "", 3, 77, 1, 1, 0, 0, 2))
        cell.event(BEGIN_NS + 3 * MS, Record(EventKind.NOTED, "valve 3 sticks"))
        cell.frame(BEGIN_NS + PERIOD_NS, image(1), quality=Quality.UNCERTAIN, reason="doubt")
        cell.event(BEGIN_NS + PERIOD_NS, Record(EventKind.QUALITY, "doubt"), Quality.UNCERTAIN)
        cell.frame(BEGIN_NS + 2 * PERIOD_NS, image(2), quality=Quality.BAD, reason="gone")
    [file] = tmp_path.glob("*.mem")
    with built(instance) as segment, Playing(segment, file) as playing:
        coordinator = Coordinator(segment)
        coordinator.step(2 * S)
        frames, events = playing.frames(), playing.happened()
        coordinator.close()
    told = [(event.kind, event.command, event.item, event.data, event.text, event.quality) for event in events]
    assert told == [
        (EventKind.ACCEPTED, 77, 1, b"\0\5", "", Quality.GOOD),
        (EventKind.WRITTEN, 77, 1, b"", "", Quality.GOOD),
        (EventKind.NOTED, 0, 0, b"", "valve 3 sticks", Quality.GOOD),
        (EventKind.QUALITY, 0, 0, b"", "doubt", Quality.UNCERTAIN),
    ]
    assert {event.writer for event in events} == {NO_WRITER}
    assert [event.utc_ns for event in events] == [7_000 * S + BEGIN_NS + n for n in (MS, 2 * MS, 3 * MS, PERIOD_NS)]
    assert [event.frame for event in events] == [1, 1, 1, 2]
    assert [(frame.quality, frame.reason) for frame in frames] == [
        (Quality.GOOD, ""),
        (Quality.UNCERTAIN, "doubt"),
        (Quality.BAD, "gone"),
    ], "after a bad last frame, no frame says that the recording is over"


@pytest.mark.parametrize("injections", ["keep", "leave out"])
def test_recorded_injections_are_kept_or_left_out(tmp_path: Path, instance: str, injections: str) -> None:
    with recorded(tmp_path, instance) as [cell]:
        cell.frame(BEGIN_NS, image(1), effective=image(99))
        cell.event(BEGIN_NS, Record(EventKind.INJECTED, "mine", 3, 5, 0, 1, injection=5))
        cell.event(BEGIN_NS + MS, Record(EventKind.QUALITY, ""))
    [file] = tmp_path.glob("*.mem")
    kept = injections == "keep"
    with built(instance) as segment, Playing(segment, file, injections=injections) as playing:
        coordinator, source_writer = Coordinator(segment), SourceWriter(segment.blocks["cell"], GUEST)
        coordinator.step(10 * MS)
        [frame] = playing.frames()
        assert (frame.raw, frame.image) == (image(1), image(99) if kept else image(1))
        assert [event.kind for event in playing.happened()] == [EventKind.INJECTED] * kept + [EventKind.QUALITY]
        segment.processes.external[0].take()
        number = source_writer.inject(["other"])
        source_writer.shadow(number, {"other": 7})
        shown = playing.next(lambda frame: frame.image[2:] == b"\0\7")
        assert (shown.raw, shown.image) == (image(1), image(99 if kept else 1, 7)), (
            "the new injection is outside the recorded one"
        )
        source_writer.lift(number)
        assert playing.next(lambda frame: frame.image[2:] == b"\0\0").image == frame.image
        coordinator.close()


def test_replay_refuses_writes(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance) as segment, Playing(segment, file) as cell:
        cell.next()  # the process accepts commands now
        source_writer = SourceWriter(segment.blocks["cell"], GUEST)
        assert outcome_of_write(source_writer, 5) == "refused: source cell replays a recording, so it cannot be written"
        kinds = [event.kind for event in cell.happened()]
    assert kinds == [EventKind.ACCEPTED, EventKind.REFUSED]


def test_gap_is_bad_until_the_recording_continues(tmp_path: Path, instance: str) -> None:
    """The source was faster than the recorder, so the recording has a gap."""
    with recorded(tmp_path, instance) as [cell]:
        slots = cell.writer.block.ring.slot_count
        for number in range(slots + 10):
            cell.frame(BEGIN_NS + number * PERIOD_NS, image(number))
            if not number:
                cell.take()
    [file] = tmp_path.glob("*.mem")
    with built(instance) as segment, Playing(segment, file) as playing:
        coordinator = Coordinator(segment)
        coordinator.step(PERIOD_NS)
        [_, frame] = playing.frames()
        assert frame.quality is Quality.BAD
        assert frame.reason.startswith("replay: not in the recording: ")
        assert frame.reason.endswith("frames (overtaken)")
        coordinator.step(10 * S)
        frames = playing.frames()
        assert {frame.quality for frame in frames} == {Quality.GOOD}
        assert [event.text for event in playing.happened()][-1] == "replay: the recording continues"
        coordinator.close()


# ---- virtual time ----------------------------------------------------------------------------------------------------


def test_step_plays_the_frames_within_it(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance, origin=Origin(BEGIN_NS, 0)) as segment, Playing(segment, file, own_clock=True) as cell:
        coordinator = Coordinator(segment)
        assert counts([cell.next()]) == [0], "the first frame is shown before the first step"
        by_step = []
        for _ in range(10):
            step = coordinator.step(50 * MS)
            by_step.append(counts(cell.frames()))
            end_ns = min(step.time_ns, BEGIN_NS + 20 * PERIOD_NS)
            assert segment.blocks["cell"].now_ns() == segment.clock.monotonic_ns(end_ns)
        coordinator.close()
    assert by_step[:4] == [[1, 2], [3, 4, 5], [6, 7], [8, 9, 10]]
    assert [count for step in by_step for count in step][:19] == list(range(1, 20))
    assert by_step[-1] == [], "steps are answered after the end of the recording, too"


def test_steps_are_reproducible(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    runs = []
    for number in range(2):
        with built(f"{instance}{number}") as segment, Playing(segment, file, speed=0.7, loop=True) as cell:
            coordinator = Coordinator(segment)
            for _ in range(20):
                coordinator.step(50 * MS)
            coordinator.close()
            runs.append([(f.number, f.cycle, f.clock_ns, f.raw, f.quality, f.reason) for f in cell.frames()])
    assert runs[0] == runs[1]
    cycles = [cycle for _, cycle, *_ in runs[0]]
    assert cycles == [5001 + n % 20 for n in range(len(cycles))]
    assert len(cycles) > 30


def test_long_step_plays_each_round_of_a_loop(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance) as segment, Playing(segment, file, loop=True) as cell:
        coordinator = Coordinator(segment)
        cell.next()
        coordinator.step(2 * S - 1)
        coordinator.close()
        assert counts(cell.frames()) == (5 * list(range(20)))[1:]


def test_frames_before_a_step_are_known_though_the_loop_restarts_within_it(tmp_path: Path, instance: str) -> None:
    """A model that computes the step must see the frames before it, whichever process is faster."""
    file = record(tmp_path, instance)
    with built(instance) as segment, Playing(segment, file, loop=True) as cell:
        coordinator = Coordinator(segment)
        coordinator.step(300 * MS)
        stepping = coordinator.stepping(200 * MS)
        next(stepping)
        head = cell.block.playhead
        assert head is not None
        cell.until(lambda: (play := head.read()) is not None and play.step == 2)
        frames = cell.frames()
        assert counts(frames[-5:]) == [1, 2, 3, 4, 5]
        assert counts([frame for frame in frames if not cell.block.came_with(frame, 2)]) == list(range(16))
        for _ in stepping:
            pass
        assert not any(cell.block.came_with(frame, 2) for frame in frames), "after the step, all frames are visible"
        coordinator.close()


def test_loop_skips_frames_of_earlier_rounds(tmp_path: Path, instance: str) -> None:
    """The newest frame is always of the current round."""
    file = record(tmp_path, instance)
    with built(instance, stepped=False) as segment, Playing(segment, file, loop=True, paused=True) as cell:
        cell.next()
        head = cell.block.playhead
        assert head is not None
        now_ns = segment.clock.present_ns()
        with head.held():
            head.ask(MoveRequest(now_ns - 5 * S, paused=False))
        segment.clock.slot_bell(0).ring()
        assert cell.next().clock_ns > now_ns - S
        cell.until(lambda: cell.loop.counters.overruns >= 200)


def test_sources_of_one_recording_stay_synchronous(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance, "cell", "other")
    with (
        built(instance, "cell", "other", stepped=False) as segment,
        Playing(segment, file) as cell,
        Playing(segment, file, "other") as other,
    ):
        pairs = [(cell.next().clock_ns, other.next().clock_ns) for _ in range(20)]
    assert all(one == two for one, two in pairs)


def test_step_continues_after_a_take_over(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance, stepped=False) as segment, Playing(segment, file, speed=0.1) as cell:
        first = cell.next()
        coordinator = Coordinator(segment)
        coordinator.take_over()
        seen = counts([first, *cell.frames()])
        coordinator.step(10 * S)
        assert seen + counts(cell.frames())[:-1] == list(range(20))
        coordinator.close()


# ---- releases and successors -----------------------------------------------------------------------------------------


def test_replay_continues_after_a_release(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance, stepped=False) as segment, Playing(segment, file, speed=0.1) as cell:
        frames = [cell.next()]
        coordinator = Coordinator(segment)
        coordinator.step(PERIOD_NS * 50)  # five frames
        coordinator.release()
        while counts(frames)[-1] < 9:
            frames.append(cell.next())
        coordinator.take_over()
        assert coordinator.step(PERIOD_NS * 50).number > 1
        coordinator.release()
        while frames[-1].quality is Quality.GOOD:
            frames.append(cell.next())
    assert counts(frames[:-1]) == list(range(20)), "each frame once"
    assert frames[-1].reason == OVER
    assert [frame.clock_ns for frame in frames] == sorted(frame.clock_ns for frame in frames)


def test_successor_continues_without_a_gap(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance) as segment:
        coordinator = Coordinator(segment)
        cursor = segment.blocks["cell"].cursor()
        with Playing(segment, file):
            coordinator.step(100 * MS)
        with Playing(segment, file):
            coordinator.step(100 * MS)
            coordinator.step(10 * S)
        coordinator.close()
        frames = [frame for frame in iter(cursor.poll, None) if frame.quality is Quality.GOOD]
    assert [count for count, _ in groupby(counts(frames))] == list(range(20)), "the last frame may be shown again"


def test_successor_shows_the_last_frame_while_time_is_paused(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance) as segment:
        coordinator = Coordinator(segment)
        with Playing(segment, file):
            coordinator.step(100 * MS)
        last = segment.blocks["cell"].latest()
        assert last is not None
        assert last.reason == STOPPED
        with Playing(segment, file) as cell:
            frame = cell.next()
            assert (counts([frame]), frame.quality, frame.reason) == ([5], Quality.GOOD, "")
            coordinator.step(100 * MS)
            assert counts(cell.frames()) == [6, 7, 8, 9, 10]
        coordinator.close()


def test_another_recording_starts_from_its_beginning(tmp_path: Path, instance: str) -> None:
    files = [record(tmp_path / name, f"{instance}{name}") for name in "ab"]
    with built(instance) as segment:
        coordinator = Coordinator(segment)
        with Playing(segment, files[0]) as cell:
            coordinator.step(300 * MS)
        with Playing(segment, files[1], start=0.1) as cell:
            assert counts([cell.next()]) == [4], "the frame before the start"
            coordinator.step(100 * MS)
            assert counts(cell.frames()) == [5, 6, 7, 8, 9, 10]
        coordinator.close()


def test_requests_for_an_earlier_recording_are_ignored(tmp_path: Path, instance: str) -> None:
    files = [record(tmp_path / name, f"{instance}{name}") for name in "ab"]
    with built(instance) as segment, attach(instance, writable=True) as attachment:
        with Playing(segment, files[0]):
            attachment.replay.seek(0.2)
        with Playing(segment, files[1], start=0.1) as cell:
            assert counts([cell.next()]) == [4]
            attachment.step(0.02)
            assert counts(cell.frames()) == [5, 6]


def test_age_is_in_recorded_time(tmp_path: Path, instance: str) -> None:
    """Values of a slow replay do not become stale."""
    file = record(tmp_path, instance)
    with built(instance, stepped=False) as segment, Playing(segment, file, speed=0.01) as cell:
        frame = cell.next()
        begun_s = time.monotonic()
        while time.monotonic() - begun_s < 0.7:  # longer than the stale time, shorter than the wait for the next frame
            age_ns = frame.age_ns(cell.block.now_ns())
            assert age_ns < 20 * MS
        assert cell.block.assess(frame)[0] is Quality.GOOD
