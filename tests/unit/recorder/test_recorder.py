"""Everything that is published is recorded in order, or is within an exact gap."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import mcap.reader
import pytest

from shmio.errors import RecordingError
from shmio.recorder import recorder as module
from shmio.recorder.file_output import Output, create
from shmio.recorder.instance_follower import InstanceFollower, StartPositions
from shmio.recorder.recorder import AttachedFile, Recorder
from shmio.recording.format.encoding import FRAME_V2, Reason, decode_event, decode_frame, restore
from shmio.recording.reading.reader import Reader
from shmio.recording.selection import Selection
from shmio.segment import Event, EventKind, Frame, Provenance, Quality, Record, Segment
from tests.unit.recorder.harness import OTHER, RING, gaps, numbers, publish, read, recorder, spec


def test_frames_and_events_survive_a_round_trip(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    writer.publish(b"\0\1", cycle=1, source_ns=1_700_000_000 * 10**9, effective=b"\0\7", provenance=Provenance.INJECTED)
    writer.event(Record(EventKind.ACCEPTED, "grün", 4, 99, 3, 1, 12, 0, 2, b"ab"))
    writer.publish(b"\0\2", cycle=2, source_ns=0, quality=Quality.BAD, reason="cable out")
    recording = recorder(segment, tmp_path)
    assert recording.close()
    block = writer.block
    assert [message.item for message in read(recording.output.path)] == [
        block.events.read(1), block.read(1), block.events.read(2), block.read(2),
    ]  # fmt: skip


def test_frames_and_events_of_busy_sources_are_in_order(segment: Segment, tmp_path: Path) -> None:
    """Threads publish while the recorder works. Numbers and references give the true order."""
    recording = recorder(segment, tmp_path)
    writers = [segment.writer(source) for source in ("cell", "press")]

    def events(index: int) -> None:
        for item in range(200):
            writers[index].event(Record(EventKind.WRITTEN, command=1, item=item))

    with ThreadPoolExecutor() as pool:
        work = [pool.submit(events, 0), pool.submit(events, 1), pool.submit(publish, writers[0], 300)]
        while not all(done.done() for done in work):
            recording.run_once()
    assert recording.close()
    messages = read(recording.output.path)
    assert numbers(recording.output.path) == list(range(1, 301))
    for source, count in (("cell", 201), ("press", 201)):
        frame = event = time_ns = 0
        for channel, log_ns, item in messages:
            if channel.source == source:
                assert log_ns >= time_ns
                time_ns = log_ns
                if isinstance(item, Frame):
                    assert (item.number, item.event) == (frame + 1, event)
                    frame += 1
                elif isinstance(item, Event):
                    assert (item.number, item.frame) == (event + 1, frame)
                    event += 1
        assert event == count


def test_a_recorder_slower_than_the_ring_counts_missed_frames_exactly(segment: Segment, tmp_path: Path) -> None:
    recording = recorder(segment, tmp_path)
    writer = segment.writer("cell")
    publish(writer, 10)
    recording.run_once()
    publish(writer, 3 * RING)
    recording.run_once()
    publish(writer, 5)
    assert recording.close()
    found = numbers(recording.output.path)
    [gap] = gaps(recording.output.path)
    assert (gap.source, gap.what, gap.first, gap.reason) == ("cell", "frames", 11, Reason.OVERTAKEN)
    assert found == [*range(1, 11), *range(gap.last + 1, 3 * RING + 16)]
    assert gap.count == recording.counters.missed == 3 * RING + 15 - len(found)
    times = {item.number: log_ns for _, log_ns, item in read(recording.output.path) if isinstance(item, Frame)}
    assert (gap.after_ns, gap.before_ns) == (times[10], times[gap.last + 1])


def test_missed_events_are_counted_exactly(segment: Segment, tmp_path: Path) -> None:
    recording = recorder(segment, tmp_path)
    writer = segment.writer("press")
    recording.run_once()
    for item in range(3000):
        writer.event(Record(EventKind.WRITTEN, item=item))
    assert recording.close()
    [gap] = gaps(recording.output.path)
    assert (gap.source, gap.what, gap.first) == ("press", "events", 2)
    assert numbers(recording.output.path, "press", Event) == [1, *range(gap.last + 1, 3002)]


def test_a_recorder_outside_the_instance_starts_with_the_current_frames(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    publish(writer, 10)
    recording = recorder(segment, tmp_path, start=StartPositions(first=False))
    publish(writer, 3)
    assert recording.close()
    assert numbers(recording.output.path) == [11, 12, 13]
    assert gaps(recording.output.path) == []


def test_only_chosen_sources_are_recorded(segment: Segment, tmp_path: Path) -> None:
    recording = recorder(segment, tmp_path, selection=Selection(["press"]))
    for source in ("cell", "press"):
        publish(segment.writer(source), 2)
    assert recording.close()
    assert {message.channel.source for message in read(recording.output.path)} == {"press"}


def test_a_changed_layout_and_a_new_source_are_separate_blocks(segment: Segment, tmp_path: Path) -> None:
    recording = recorder(segment, tmp_path)
    publish(segment.writer("cell"), 3)
    recording.run_once()
    old = segment.blocks["cell"]
    publish_late = segment.writer("cell")  # keeps the old block's writer, whose last frames are recorded too
    publish(publish_late, 2)
    segment.change(add=[spec("cell", OTHER), spec("robot")], retire=["cell", "press"])
    publish(segment.writer("cell"), 4)
    publish(segment.writer("robot"), 1)
    assert recording.close()
    with Reader(recording.output.path) as reader:
        found: dict[int, list[int]] = {}
        for channel, _, item in reader.messages():
            if isinstance(item, Frame):
                found.setdefault(channel.block, []).append(item.number)
                layout = {"cell": old.layout if channel.block == 1 else OTHER}.get(channel.source, old.layout)
                assert reader.layout(channel) == layout
        blocks = {channel.block: channel.source for channel in reader.channels.values() if channel.source}
        layouts = [name for name in reader.attachments if name.startswith("layouts/")]
    assert blocks == {1: "cell", 3: "cell", 4: "robot"}, "press has no block, as it published nothing"
    assert found == {1: [1, 2, 3, 4, 5], 3: [1, 2, 3, 4], 4: [1]}
    assert len(layouts) == 2


def test_a_block_added_and_removed_between_two_looks_is_recorded(segment: Segment, tmp_path: Path) -> None:
    recording = recorder(segment, tmp_path)
    publish(segment.writer("cell"), 3)
    with Segment.open(segment.instance, writable=True) as other:
        for layout in (OTHER, spec("cell").layout):
            other.change(add=[spec("cell", layout)], retire=["cell"])
            publish(other.writer("cell"), 4)
    assert recording.close()
    found: dict[int, list[int]] = {}
    for channel, _, item in read(recording.output.path):
        if isinstance(item, Frame):
            found.setdefault(channel.section, []).append(item.number)
    assert list(found.values()) == [[1, 2, 3], [1, 2, 3, 4], [1, 2, 3, 4]]


def test_a_recorder_outside_the_instance_skips_ended_blocks(segment: Segment, tmp_path: Path) -> None:
    publish(segment.writer("cell"), 3)
    segment.change(add=[spec("cell", OTHER)], retire=["cell"])
    recording = recorder(segment, tmp_path, start=StartPositions(first=False))
    publish(segment.writer("cell"), 1)
    assert recording.close()
    assert numbers(recording.output.path) == [1]


def test_a_frame_is_in_the_file_within_a_second(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recorder's clock advances only when the test moves it."""
    clock = SimpleNamespace(s=1000.0)
    monkeypatch.setattr(
        module,
        "time",
        SimpleNamespace(monotonic=lambda: clock.s, monotonic_ns=lambda: round(clock.s * 1e9), time_ns=lambda: 1),
    )
    recording = recorder(segment, tmp_path)
    publish(segment.writer("cell"), 1)
    begun_s, given = clock.s, recording.output.tell()
    while recording.output.tell() == given:
        clock.s += recording.tap.pause_s
        recording.run_once()
    assert clock.s - begun_s < 1.0
    recording.close()


def test_the_file_is_plain_mcap(segment: Segment, tmp_path: Path) -> None:
    files = [AttachedFile("config/supervisor.toml", "application/toml", b"[instance]\n", 5)]
    recording = recorder(segment, tmp_path, attachments=lambda source, _: [] if source else files)
    writer = segment.writer("cell")
    publish(writer, 3 * RING)
    assert recording.close()
    with recording.output.path.open("rb") as stream:
        reader = mcap.reader.make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert reader.get_header().profile == "shmio"
        messages = list(reader.iter_messages())
        assert (
            len(messages)
            == summary.statistics.message_count
            == sum([recording.counters.frames, recording.counters.events, 1])
        )
        gap = next(json.loads(message.data) for _, channel, message in messages if channel.topic == "gaps")
        assert gap["count"] == recording.counters.missed
        [(_, channel, last)] = [entry for entry in messages if entry[1].topic == "cell/frames"][-1:]
        assert channel.message_encoding == FRAME_V2
        data = restore(last.data, last.sequence, last.log_time, last.publish_time)
        assert decode_frame(data) == writer.block.latest()
        assert (channel.metadata["source"], channel.metadata["layout"]) == ("cell", writer.block.layout.hash.hex())
        event = next(message for _, channel, message in messages if channel.topic == "cell/events")
        assert decode_event(event.data).kind == EventKind.STARTED
        attached = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        assert attached["config/supervisor.toml"] == b"[instance]\n"
        assert attached[f"layouts/{writer.block.layout.hash.hex()}.json"] == writer.block.layout.to_json()
        [metadata] = list(reader.iter_metadata())
        assert metadata.metadata["instance"] == segment.instance
        assert metadata.metadata["epoch"] == f"{segment.header.epoch:016x}"


def test_frames_lost_to_a_full_disk_are_gaps_and_it_continues(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, fd = create(tmp_path, segment.instance)
    output = Output(path, fd, limit_bytes=2000)
    recording = Recorder(InstanceFollower(segment), output, by="test")
    monkeypatch.setattr(module, "CHUNK_S", 0.0)  # a chunk in each turn
    writer = segment.writer("cell")

    def turns(until: Callable[[], object]) -> None:
        while not until():
            publish(writer, 50, first=writer.block.ring.head())
            recording.run_once()

    full = OSError(28, "No space left on device")
    with monkeypatch.context() as broken:
        broken.setattr(Output, "_put", lambda output, _: setattr(output, "error", full.strerror))
        turns(lambda: recording.counters.missed >= 500 and recording.problem)
        assert recording.problem.startswith(f"{path}: No space left on device; ")
        assert f"{recording.counters.missed} frames and events lost so far" in recording.problem
    turns(lambda: not output.full)
    publish(writer, 3, first=writer.block.ring.head())
    assert recording.close()
    assert recording.problem == ""
    missed = gaps(path)
    assert {gap.reason for gap in missed} == {Reason.NO_ROOM}
    lost = [number for gap in missed for number in range(gap.first, gap.last + 1)]
    assert len(lost) == sum(gap.count for gap in missed) == recording.counters.missed >= 500
    assert sorted(numbers(path) + lost) == list(range(1, writer.block.ring.head() + 1))


def test_a_removed_file_is_reported(segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CHECK_S", 0.0)
    recording = recorder(segment, tmp_path)
    recording.run_once()
    recording.output.path.unlink()
    with pytest.raises(RecordingError, match="was removed while it was being written"):
        recording.run_once()
    recording.output.close(30)
