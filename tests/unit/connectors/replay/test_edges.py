"""Edge cases of a replay: several recordings, a source whose recording begins late, invalid times."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest

from shmio.connectors.replay.loop import NOTHING, Player, Search
from shmio.connectors.replay.recording import Entry, RecordedSource, Recording
from shmio.connectors.replay.source import Replay
from shmio.errors import CommandError, ConfigError, RecordingError
from shmio.local.attach import attach
from shmio.local.replays import ReplayRequest
from shmio.local.time_control import Coordinator
from shmio.recording.format.encoding import Gap, Reason
from shmio.segment import EventKind, Quality, Record, Segment
from shmio.segment.playhead import MoveRequest
from tests.unit.connectors.replay.harness import (
    BEGIN_NS,
    LAYOUT,
    MS,
    PATIENCE_S,
    PERIOD_NS,
    Playing,
    S,
    built,
    counts,
    image,
    record,
    recorded,
)
from tests.unit.recording.build import START_NS, Build

if TYPE_CHECKING:
    from collections.abc import Iterator

    from shmio.segment import Block


def test_source_that_begins_late_is_bad_until_then_in_each_round(tmp_path: Path, instance: str) -> None:
    with recorded(tmp_path, instance, "cell", "late") as [cell, late]:
        for number in range(100):
            cell.frame(BEGIN_NS + number * PERIOD_NS, image(number))
            if number >= 80:
                late.frame(BEGIN_NS + number * PERIOD_NS, image(number))
    [file] = tmp_path.glob("*.mem")
    with built(instance, "late") as segment, Playing(segment, file, "late", loop=True) as playing:
        coordinator = Coordinator(segment)
        coordinator.step(1900 * MS)
        assert {frame.quality for frame in playing.frames()} == {Quality.GOOD}
        coordinator.step(S)
        frames = playing.frames()
        assert (frames[-1].quality, frames[-1].reason) == (Quality.BAD, NOTHING)
        coordinator.step(S)
        assert [frame.quality for frame in playing.frames()] == [Quality.GOOD] * 16
        coordinator.close()


def test_search_for_an_event_needs_a_single_recording(tmp_path: Path, instance: str) -> None:
    files: list[Path] = []
    for name, later_ns in (("a", 0), ("b", 5 * S)):
        (tmp_path / name).mkdir()
        with recorded(tmp_path / name, instance + name) as [cell]:
            for number in range(20):
                cell.frame(BEGIN_NS + later_ns + number * PERIOD_NS, image(number))
            cell.event(BEGIN_NS + later_ns + 19 * PERIOD_NS, Record(EventKind.ACCEPTED))
        files += (tmp_path / name).glob("*.mem")
    with (
        built(instance, "one", "two") as segment,
        Playing(segment, files[0], "one", source="cell"),
        Playing(segment, files[1], "two", source="cell"),
        attach(instance, writable=True) as attachment,
    ):
        with pytest.raises(CommandError, match=r"several recordings are playing; .* \(one, two\)"):
            attachment.replay.to_event("accepted", jump=True)
        assert [status.position_s for status in attachment.replay.status()] == [0.0, 0.0]


def test_successor_starts_while_the_playhead_is_locked(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance) as segment, Segment.open(instance, writable=True) as other:
        with Playing(segment, file) as playing:
            playing.next()
        head = other.blocks["cell"].playhead
        assert head is not None
        with head.held(), Playing(segment, file) as playing:
            assert playing.loop.counters.failures == 0


@pytest.mark.parametrize(
    ("period_ns", "stale_ns"),
    [(0, S), (-PERIOD_NS, S), (1, S), (10**30, 10**30), (PERIOD_NS, 0), (PERIOD_NS, -1), (PERIOD_NS, 10**30)],
)
def test_invalid_period_or_stale_time_is_refused(tmp_path: Path, period_ns: int, stale_ns: int) -> None:
    file = tmp_path / "some.mem"
    work = Build(file)
    work.writer.attach(f"layouts/{LAYOUT.hash.hex()}.json", "application/json", LAYOUT.to_json(), START_NS)
    block = SimpleNamespace(source="cell", section=1, layout=LAYOUT, period_ns=period_ns, stale_ns=stale_ns)
    work.blocks["cell"] = work.writer.open_block(cast("Block", block), 1, 0, 0)
    work.frame(1, image(1))
    work.writer.finish()
    assert work.output.close(30)
    with pytest.raises(ConfigError, match="has invalid times"):
        Replay(Replay.Options(file=str(file)), "cell")


def test_gap_with_an_invalid_time_is_harmless(tmp_path: Path, instance: str) -> None:
    file = tmp_path / "some.mem"
    work = Build(file)
    work.block("cell", LAYOUT)
    work.frame(1, image(1))
    work.writer.gap(Gap("cell", 1, "frames", 2, 2, 1, Reason.OVERTAKEN, -(1 << 63)), START_NS + 2 * PERIOD_NS)
    work.frame(3, image(3))
    work.writer.finish()
    assert work.output.close(30)
    with built(instance) as segment, Playing(segment, file) as playing:
        coordinator = Coordinator(segment)
        coordinator.step(S)
        assert counts(playing.frames())[:2] == [1, 3]
        coordinator.close()


def test_successor_repeats_no_event(tmp_path: Path, instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with recorded(tmp_path, instance) as [cell]:
        for number in range(10):
            cell.frame(BEGIN_NS + number * PERIOD_NS, image(number))
            cell.event(BEGIN_NS + number * PERIOD_NS + MS, Record(EventKind.NOTED, str(number)))
    [file] = tmp_path.glob("*.mem")
    monkeypatch.setattr(Player, "end", lambda *_: None)  # as if killed: no last frame is published
    with built(instance) as segment, attach(instance, writable=True) as attachment:
        events = segment.blocks["cell"].events.cursor()
        with Playing(segment, file):
            attachment.replay.to_event("noted")
            attachment.step(1.0)
        with Playing(segment, file):
            attachment.replay.play()
            attachment.step(0.05)
        told = [event for event in iter(events.poll, None) if event.kind == EventKind.NOTED]
    assert [event.text for event in told] == ["0", "1", "2"]


def test_delayed_process_does_not_read_the_frames_that_it_skips(
    tmp_path: Path, instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading these frames would delay the process even more."""
    with recorded(tmp_path, instance) as [cell]:
        for number in range(2000):
            cell.frame(BEGIN_NS + number * PERIOD_NS, image(number))
            if number % 100 == 0:
                cell.take()
    [file] = tmp_path.glob("*.mem")
    read = []
    entries = RecordedSource.entries

    def counted(recorded: RecordedSource, from_ns: int | None) -> Iterator[Entry]:
        for entry in entries(recorded, from_ns):
            read.append(entry)
            yield entry

    monkeypatch.setattr(RecordedSource, "entries", counted)
    with built(instance, stepped=False) as segment, Playing(segment, file, paused=True) as playing:
        playing.next()
        head = playing.block.playhead
        assert head is not None
        now_ns = segment.clock.present_ns()
        with head.held():
            head.ask(MoveRequest(now_ns - 30 * S, paused=False, speed=1.0))
        segment.clock.slot_bell(0).ring()
        assert counts([playing.next()])[0] >= 1500
        assert len(read) < 200
    assert playing.loop.counters.overruns >= 1400


def test_request_within_a_step_takes_effect_after_it(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with (
        built(instance) as segment,
        Playing(segment, file) as playing,
        attach(instance, writable=True) as attachment,
    ):
        head = segment.blocks["cell"].playhead
        assert head is not None
        coordinator = Coordinator(segment)
        stepping = coordinator.stepping(100 * MS)
        next(stepping)
        playing.until(lambda: (play := head.read()) is not None and play.step == 1)
        asking = threading.Thread(target=attachment.replay.pause)
        asking.start()
        until_s = time.monotonic() + PATIENCE_S
        while head.asks(0) is None and time.monotonic() < until_s:
            pass
        for _ in stepping:
            pass
        asking.join()
        coordinator.close()
        [status] = attachment.replay.status()
        assert (status.paused, status.position_s) == (True, 0.1)


def test_search_can_be_cancelled(tmp_path: Path, instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    file = record(tmp_path, instance)
    monkeypatch.setattr(Search, "advance", lambda _: None)  # a search that never ends
    with built(instance, stepped=False) as segment, Playing(segment, file), attach(instance, writable=True) as attached:
        asked = []

        def cancelled() -> bool:
            asked.append(True)
            return len(asked) > 1

        with pytest.raises(CommandError, match="the search in source cell was given up"):
            attached.replay.change(ReplayRequest(event="noted"), cancelled)
        [status] = attached.replay.seek(0.1)
        assert status.position_s == 0.1, "another request takes its place"


def test_a_recording_of_more_sources_than_an_instance_may_have_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "many.mem"
    work = Build(file)
    for number in range(257):
        work.block(f"s{number}", LAYOUT, number + 1)
        work.frame(1, image(1), f"s{number}")
    work.writer.finish()
    assert work.output.close(30)
    with pytest.raises(RecordingError, match=r"has 257 sources, but an instance has at most 256; copy some"):
        Recording([file])
