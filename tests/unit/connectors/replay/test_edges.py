"""Edges of a replay: several recordings, a source that is not there from the begin, files that lie."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest

from shmio.connectors.replay.player import NOTHING
from shmio.connectors.replay.source import Replay
from shmio.dump.encoding import Gap, Reason
from shmio.errors import CommandError, ConfigError
from shmio.segment import EventKind, Quality, Record, Segment
from shmio.segment.attach import attach
from shmio.segment.coordinator import Coordinator
from tests.unit.connectors.replay.harness import (
    BEGIN_NS,
    LAYOUT,
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
from tests.unit.dump.build import START_NS, Build

if TYPE_CHECKING:
    from shmio.segment import Block


def test_a_source_that_begins_later_is_bad_in_each_round_of_a_loop_until_it_does(tmp_path: Path, instance: str) -> None:
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


def test_an_event_is_looked_for_in_one_recording(tmp_path: Path, instance: str) -> None:
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
        with pytest.raises(CommandError, match=r"several recordings are played: name .* \(one, two\)"):
            attachment.replay.to_event("accepted", jump=True)
        assert [status.position_s for status in attachment.replay.status()] == [0.0, 0.0]


def test_a_successor_begins_while_others_wait_for_its_answer(tmp_path: Path, instance: str) -> None:
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
def test_a_cycle_that_makes_no_sense_is_told(tmp_path: Path, period_ns: int, stale_ns: int) -> None:
    file = tmp_path / "some.mem"
    work = Build(file)
    work.writer.attach(f"layouts/{LAYOUT.hash.hex()}.json", "application/json", LAYOUT.to_json(), START_NS)
    block = SimpleNamespace(source="cell", section=1, layout=LAYOUT, period_ns=period_ns, stale_ns=stale_ns)
    work.blocks["cell"] = work.writer.open_block(cast("Block", block), 1, 0, 0)
    work.frame(1, image(1))
    work.writer.finish()
    assert work.output.close(30)
    with pytest.raises(ConfigError, match="has times that make no sense"):
        Replay(Replay.Options(file=str(file)), "cell")


def test_a_gap_at_a_time_that_makes_no_sense_harms_nothing(tmp_path: Path, instance: str) -> None:
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
