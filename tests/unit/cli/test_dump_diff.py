"""``shmio-dump diff``: compares two recordings."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shmio.cli.dump import IGNORABLE, main
from shmio.layout.model import Layout, Register
from shmio.recording import compare
from shmio.segment import Provenance, Quality
from tests.unit.recording.build import Build, build, image, plain, varied


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def diff(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, dict[str, Any]]]:
    """Compare a.mem with b.mem; return the exit status and the result for the source cell."""

    def call(*arguments: str) -> tuple[int, dict[str, Any]]:
        status = main(["diff", "a.mem", "b.mem", "--json", *arguments])
        said = capsys.readouterr()
        assert said.err == ""
        found = json.loads(said.out)
        assert found["same"] == (status == 0)
        return status, next(source for source in found["sources"] if source["source"] == "cell")

    return call


Diff = Callable[..., tuple[int, dict[str, Any]]]


def counting(file: str, change: Callable[[Build, int], bool] = lambda _work, _number: False, last: int = 50) -> None:
    """Record a counter. ``change`` may write a frame itself; it then returns True, and no other frame is written."""
    with build(Path(file)) as work:
        work.block("cell")
        for number in range(1, last + 1):
            if not change(work, number):
                work.frame(number, image(number, number / 4))


def test_command_and_library_agree_on_what_can_be_ignored() -> None:
    assert compare.IGNORABLE == IGNORABLE


def test_equal_recordings(capsys: pytest.CaptureFixture[str]) -> None:
    varied(Path("a.mem"))
    varied(Path("b.mem"))
    assert main(["diff", "a.mem", "b.mem"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out == [
        "cell: 57 frames are the same; 4 events are the same",
        "press: 60 frames are the same; 0 events are the same",
        "the same",
    ]


def test_replayed_frames_are_no_difference(diff: Diff) -> None:
    counting("a.mem")

    def replayed(work: Build, number: int) -> bool:
        other: dict[str, Any] = {"provenance": Provenance.REPLAYED, "incarnation": 9, "publish_ns": 5, "delay_us": 3}
        work.frame(number, image(number, number / 4), **other)
        return True

    counting("b.mem", replayed)
    assert diff()[0] == 0


def test_differing_values_quality_and_times(diff: Diff) -> None:
    counting("a.mem")

    def change(work: Build, number: int) -> bool:
        others: dict[int, dict[str, Any]] = {
            20: {"data": image(number, number / 4 + 0.5)},
            21: {"data": image(number + 3, number / 4 + 0.75)},
            30: {"data": image(number, number / 4), "quality": Quality.BAD, "reason": "no answer"},
            40: {"data": image(number, number / 4), "source_ns": 7},
            45: {"data": image(number, number / 4), "effective": image(0)},
        }
        if number in others:
            work.frame(number, **others[number])
        return number in others

    counting("b.mem", change)
    status, found = diff()
    assert status == 1
    frames = found["frames"]
    assert (frames["compared"], frames["differing"], frames["only_first"], frames["only_second"]) == (50, 5, 0, 0)
    assert frames["first"]["numbers"] == [20, 20]
    assert frames["first"]["what"] == ["speed: 5.0 -> 5.5"]
    assert found["fields"] == {"quality": 1, "reason": 1, "source time": 1}
    assert {path: (r["count"], r["largest"]) for path, r in found["registers"].items()} == {
        "speed": (3, 11.25),
        "count": (2, 45),
        "row/3": (2, 45),
    }
    assert diff("--ignore", "times,reason")[1]["fields"] == {"quality": 1}
    assert diff("--only", "cell/on")[1]["registers"] == {}
    assert diff("--only", "cell/speed", "--tolerance", "0.8")[1]["registers"]["speed"]["count"] == 1
    assert diff("--only", "speed", "--relative", "0.2")[1]["registers"]["speed"]["count"] == 1


def test_tolerance_applies_to_floating_point_only(diff: Diff) -> None:
    counting("a.mem")

    def change(work: Build, number: int) -> bool:
        if number == 9:
            work.frame(9, image(10, 9 / 4))
        return number == 9

    counting("b.mem", change)
    assert set(diff("--tolerance", "5")[1]["registers"]) == {"count", "row/3"}


def test_frames_missing_in_one_recording(diff: Diff) -> None:
    counting("a.mem")

    def fewer(work: Build, number: int) -> bool:
        if number == 12:
            work.gap(10, 12)
        return number in (10, 11, 12) or number > 45 or number < 3

    counting("b.mem", fewer)
    status, found = diff()
    assert status == 1
    frames = found["frames"]
    assert (frames["compared"], frames["differing"], frames["only_first"], frames["only_second"]) == (40, 0, 10, 0)
    frames = diff("--ignore", "ends")[1]["frames"]
    assert (frames["only_first"], frames["first"]["numbers"]) == (3, [10, None])
    frames = diff("--ignore", "times", "cycle")[1]["frames"]
    assert (frames["compared"], frames["only_first"]) == (40, 10), "compared one by one, in their order"


def test_source_missing_in_one_recording(diff: Diff) -> None:
    varied(Path("a.mem"))
    with build(Path("b.mem")) as work:
        work.block("press", section=2)
    status, found = diff()
    assert (status, found["frames"]["only_first"]) == (1, 57)
    assert main(["diff", "a.mem", "b.mem", "--source", "other"]) == 1


def test_differing_events(diff: Diff) -> None:
    for file, text in (("a.mem", "one"), ("b.mem", "other")):
        with build(Path(file)) as work:
            work.block("cell")
            work.frame(1, image(1))
            work.event(1, 1, text)
    status, found = diff()
    assert (status, found["events"]["first"]["what"]) == (1, ["text: one -> other"])
    assert diff("--ignore", "events")[0] == 0


def telling(file: str, told: list[tuple[int, str]], first: int = 1, last: int = 40) -> None:
    """Record frames, and events after some of them."""
    with build(Path(file), first=first) as work:
        work.block("cell")
        for number in range(first, last + 1):
            work.frame(number, image(number))
            for text in (text for at, text in told if at == number):
                work.event(work.events["cell"] + 1, number, text)


def test_events_match_though_recordings_begin_at_different_times(diff: Diff) -> None:
    told = [(2, "early"), (10, "one"), (10, "two"), (20, "three")]
    telling("a.mem", told)
    telling("b.mem", told, first=5)
    assert diff("--ignore", "ends")[0] == 0
    status, found = diff()
    events = found["events"]
    assert (status, events["compared"], events["differing"], events["only_first"]) == (1, 3, 0, 1)


def test_additional_event_is_one_difference(diff: Diff) -> None:
    telling("a.mem", [(at, f"event {at}") for at in range(1, 40)])
    more = [(at, f"event {at}") for at in range(1, 40)]
    telling("b.mem", [*more[:9], (10, "another"), *more[9:]])
    for ignored in ([], ["--ignore", "cycle"], ["--ignore", "cycle,times"]):
        events = diff(*ignored)[1]["events"]
        counts = tuple(events[name] for name in ("compared", "differing", "only_first", "only_second"))
        assert counts == (39, 0, 0, 1), ignored
        assert events["first"]["numbers"] == [None, 10]


def test_events_of_one_cycle_are_matched_by_content(diff: Diff) -> None:
    telling("a.mem", [(5, "one"), (5, "two")])
    telling("b.mem", [(5, "two"), (5, "one")])
    assert diff()[0] == 0
    telling("b.mem", [(5, "two"), (5, "three")])
    events = diff()[1]["events"]
    assert (events["compared"], events["differing"], events["first"]["what"]) == (2, 1, ["text: one -> three"])


def test_only_the_overlap_counts_when_ends_are_ignored(diff: Diff) -> None:
    """An event in only one recording is a difference if both were recording at that time."""
    telling("a.mem", [(3, "before b"), (20, "within both")], last=30)
    telling("b.mem", [(35, "behind a")], first=10)
    status, found = diff("--ignore", "ends")
    events = found["events"]
    assert (status, events["only_first"], events["only_second"]) == (1, 1, 0)
    assert events["first"]["numbers"] == [2, None]
    assert found["frames"] | {"first": None} == {
        "compared": 21, "differing": 0, "only_first": 0, "only_second": 0, "first": None,
    }  # fmt: skip


def test_recordings_may_begin_and_end_within_a_cycle(diff: Diff) -> None:
    """While time is paused, several frames and events have the same cycle and time."""

    def recorded(file: str, first: int, last: int) -> None:
        """Record three frames of each cycle, and an event after each frame."""
        with build(Path(file), first=first) as work:
            work.block("cell", after_event=first - 1)
            for number in range(first, last + 1):
                cycle = number // 3
                work.frame(cycle, image(number), number=number)
                work.event(number, number, f"event {number}", cycle=cycle)

    recorded("a.mem", 1, 31)
    recorded("b.mem", 10, 35)
    status, found = diff("--ignore", "ends")
    assert (status, found["frames"]["compared"], found["events"]["compared"]) == (0, 22, 22)
    recorded("b.mem", 11, 32)
    status, found = diff("--ignore", "ends")
    assert (status, found["frames"]["compared"], found["events"]["compared"]) == (0, 21, 21)


@pytest.mark.parametrize(
    ("first", "second", "compared"),
    [
        ((1, 10), (1, 5), 5),  # both begin with the cycle; one ends within it
        ((1, 10), (3, 7), 5),
        ((1, 150), (11, 160), 140),  # more frames than are searched for the common beginning
    ],
)
def test_recordings_of_a_paused_instance_are_compared_where_they_overlap(
    diff: Diff, first: tuple[int, int], second: tuple[int, int], compared: int
) -> None:
    for file, (begin, end) in (("a.mem", first), ("b.mem", second)):
        with build(Path(file), first=begin) as work:
            work.block("cell")
            for number in range(begin, end + 1):
                work.frame(1, image(number), number=number)
    status, found = diff("--ignore", "ends")
    assert (status, found["frames"]["compared"]) == (0, compared)


def test_differing_elements_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    counting("a.mem")

    def change(work: Build, number: int) -> bool:
        if number == 7:
            work.frame(7, image(9, 7 / 4))
        return number == 7

    counting("b.mem", change)
    assert main(["diff", "a.mem", "b.mem"]) == 1
    out = capsys.readouterr().out
    assert "    row/3: 7 -> 9" in out.splitlines()
    assert "[1, 2" not in out


def test_differing_layouts(diff: Diff) -> None:
    """Registers with the same name and type are compared at any offset; the others are reported."""
    other = Layout("DB1", 1, 8, False, (
        Register("speed", "REAL", (), 0, None, 4, 1),
        Register("count", "DINT", (), 4, None, 4, 1),
    ))  # fmt: skip
    counting("a.mem", last=3)
    with build(Path("b.mem")) as work:
        work.block("cell", other)
        for number in range(1, 4):
            work.frame(number, image(number, number / 4)[2:6] + bytes(4))
    status, found = diff()
    assert (status, found["missing"], found["registers"]) == (1, ["count", "on", "row"], {})
    assert diff("--only", "cell/speed")[0] == 0


def test_timing(diff: Diff) -> None:
    counting("a.mem")
    with build(Path("b.mem")) as work:
        work.block("cell")
        for number in range(1, 51):
            late_ns = 2_000_000 if number == 50 else 0
            frame: dict[str, Any] = {
                "number": number,
                "cycle": number,
                "source_ns": 1_700_000_000_000_000_000 + number * 20_000_000,
            }
            work.frame(number + 100, image(number, number / 4), late_ns=late_ns, **frame)
    status, found = diff()
    assert status == 0
    assert found["timing_ms"]["median"] == 0
    assert found["timing_ms"]["max"] == 2.0


def test_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    plain(Path("a.mem"))
    for wrong in (["--ignore", "everything"], ["--tolerance", "-1"], ["--tolerance", "x"]):
        with pytest.raises(SystemExit) as status:
            main(["diff", "a.mem", "a.mem", *wrong])
        assert status.value.code == 2
    capsys.readouterr()
    assert main(["diff", "a.mem", "no.mem"]) == 1
    assert capsys.readouterr().err == "no.mem: No such file or directory\n"
