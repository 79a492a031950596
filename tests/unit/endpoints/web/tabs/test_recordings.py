from __future__ import annotations

import base64
import fcntl
import math
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.sync.connection import Connection

from shmio.endpoints.web.tabs import recordings as tab
from shmio.recording.format.records import Record, Records
from shmio.segment import Provenance, Quality, Segment
from tests.unit.endpoints.web.tabs.test_plots import Batch, decoded
from tests.unit.endpoints.web.test_page import pages, said
from tests.unit.recording.build import PERIOD_NS, START_NS, build, image, plain

WIDE = 4000


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "dumps").mkdir()
    return tmp_path / "dumps"


@pytest.fixture
def browser(segment: Segment, folder: Path) -> Iterator[Connection]:
    with pages(segment, recordings=folder) as server, server.open() as browser:
        yield browser


def result(browser: Connection, call: str, **given: Any) -> Any:
    found = said(browser, f"recordings.{call}", **given)
    assert "error" not in found, found
    return found["result"]


def error(browser: Connection, call: str, **given: Any) -> str:
    return str(said(browser, f"recordings.{call}", **given)["error"])


def listed(browser: Connection, name: str) -> dict[str, Any]:
    """Return the row of a file, with its details."""
    while True:
        [row] = [one for one in result(browser, "files")["files"] if one["name"] == name]
        if row["known"]:
            return dict(row)


def plot(browser: Connection, name: str, *paths: str, columns: int = WIDE, **given: Any) -> tuple[list[Any], list[Any]]:
    """Return the history of each register as (times, values, marks), and the events."""
    number = result(browser, "plot", name=name, paths=paths, columns=columns, **given)["number"]
    course: list[list[Batch]] = [[] for _ in paths]
    events: list[dict[str, Any]] = []
    shares = [0.0]
    while (part := result(browser, "more", number=number)) is not None:
        for batch in filter(None, map(base64.b64decode, part["batches"])):
            found = decoded(batch, 1)
            course[found.number].append(found)
        events += part["events"]
        shares.append(part["share"])
    assert shares == sorted(shares)
    joined = [
        (
            [time for one in batches for time in one.times],
            [value for one in batches for value in one.values[0]],
            [mark for one in batches for mark in one.marks[0]],
        )
        for batches in course
    ]
    return joined, events


def moment(frame: int) -> float:
    return (START_NS + frame * PERIOD_NS) / 1e9


def test_list_has_what_each_file_is(browser: Connection, folder: Path) -> None:
    plain(folder / "closed.mem")
    (folder / "cut.mem").write_bytes((folder / "closed.mem").read_bytes()[:-700])
    shutil.copy(folder / "cut.mem", folder / "growing.mem")
    (folder / "other.mem").write_bytes(b"no recording")
    (folder / "note.txt").write_text("none")
    with (folder / "growing.mem").open("r+b") as recorder:
        fcntl.flock(recorder, fcntl.LOCK_EX)
        rows = {name: listed(browser, f"{name}.mem") for name in ("closed", "cut", "growing", "other")}
        assert len(result(browser, "files")["files"]) == 4
    assert (rows["closed"]["closed"], rows["closed"]["writing"]) == (True, False)
    assert rows["closed"]["sources"] == ["cell"]
    assert (rows["closed"]["begin_s"], rows["closed"]["end_s"]) == (moment(1), moment(100))
    assert (rows["cut"]["closed"], rows["cut"]["writing"]) == (False, False)
    assert (rows["growing"]["closed"], rows["growing"]["writing"]) == (False, True)
    assert "not a recording" in rows["other"]["problem"]


def test_instance_without_recorder_lists_nothing(segment: Segment) -> None:
    with pages(segment) as server, server.open() as browser:
        assert result(browser, "files") == {"folder": None, "files": []}
        assert "no recorder" in error(browser, "describe", name="x.mem")


@pytest.mark.parametrize(
    "name", ["../secret.mem", "/etc/passwd", "a/b.mem", ".hidden.mem", "x", "..", "a\0.mem", "x.mem/"]
)
@pytest.mark.parametrize("call", ["describe", "registers", "plot", "verify"])
def test_only_names_of_recordings_are_accepted(browser: Connection, folder: Path, call: str, name: str) -> None:
    plain(folder.parent / "secret.mem")
    given = {"paths": ["cell/count"], "columns": 10} if call == "plot" else {}
    assert "not the name of a recording" in error(browser, call, name=name, **given)


def test_links_and_other_kinds_of_files_are_not_opened(browser: Connection, folder: Path) -> None:
    plain(folder.parent / "secret.mem")
    (folder / "link.mem").symlink_to(folder.parent / "secret.mem")
    os.mkfifo(folder / "fifo.mem")
    (folder / "folder.mem").mkdir()
    assert result(browser, "files")["files"] == []
    for name in ("link", "fifo", "folder"):
        given = {"name": f"{name}.mem", "paths": ["cell/count"], "columns": 10}
        assert f"{name}.mem" in error(browser, "plot", **given)
        assert f"{name}.mem" in error(browser, "describe", name=f"{name}.mem")


def test_description_has_the_commands_that_play_it(browser: Connection, folder: Path) -> None:
    plain(folder / "a b.mem")
    found = result(browser, "describe", name="a b.mem")
    assert (found["closed"], found["damage"], found["blocks"][0]["frames"]) == (True, [], 100)
    for commands in found["replay"].values():
        assert commands.endswith(f"--mode replay --from '{folder}/a b.mem'")


def test_file_that_disappears_is_an_error_and_no_more(browser: Connection, folder: Path) -> None:
    file = plain(folder / "a.mem")
    number = result(browser, "plot", name="a.mem", paths=["cell/count"], columns=10)["number"]
    file.unlink()
    while result(browser, "more", number=number) is not None:  # it is open
        pass
    assert "a.mem: No such file" in error(browser, "plot", name="a.mem", paths=["cell/count"], columns=10)
    assert result(browser, "files")["files"] == []


def test_plot_has_each_frame_if_there_is_room(browser: Connection, folder: Path) -> None:
    plain(folder / "a.mem")
    (count, on), _ = plot(browser, "a.mem", "cell/count", "cell/on")
    assert count[0] == [moment(number) for number in range(1, 101)]
    assert count[1] == list(range(1, 101))
    assert on[1] == [number % 2 for number in range(1, 101)]
    assert set(count[2]) == {Provenance.LIVE}


def test_narrow_plot_has_the_least_and_the_greatest_value(browser: Connection, folder: Path) -> None:
    with build(folder / "a.mem") as work:
        work.block("cell")
        for number in range(1, 2001):
            work.frame(number, image({777: 9, 1300: -9}.get(number, 1)))
            if number % 100 == 0:
                work.chunk()
    ((times, values, _),), _ = plot(browser, "a.mem", "cell/count", columns=4)
    assert len(values) < 25
    assert (max(values), min(values)) == (9, -9)
    assert times[values.index(9)] == moment(777)


def test_zoomed_plot_reads_only_its_chunks(browser: Connection, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain(folder / "a.mem", last=1000)
    read: set[int] = set()
    unpacked = Records.unpacked

    def noted(self: Records, record: Record) -> bytes:
        read.add(record.at)
        return unpacked(self, record)

    monkeypatch.setattr(Records, "unpacked", noted)
    window: dict[str, Any] = {"from_s": moment(505) - 0.001, "to_s": moment(507) + 0.001}
    ((times, values, _),), _ = plot(browser, "a.mem", "cell/count", **window)
    assert values == [504, 505, 506, 507, 508]  # and the frames on both sides, so that the line goes to the edges
    assert times[1] == moment(505)
    assert len(read) <= 3


def test_gaps_bad_quality_and_injections_are_seen(browser: Connection, folder: Path) -> None:
    with build(folder / "a.mem") as work:
        work.block("cell")
        for number in range(1, 61):
            if number in (20, 21):
                work.frame(number, image(number), quality=Quality.BAD, reason="no answer")
            elif number in (30, 31):
                work.frame(number, image(number), effective=image(1000))
            elif number == 40:
                work.gap(40, 40)
            else:
                work.frame(number, image(number))
    (count, speed), _ = plot(browser, "a.mem", "cell/count", "cell/speed")
    at = dict(zip(count[0], zip(count[1], count[2], strict=True), strict=True))
    assert math.isnan(at[moment(20)][0])
    assert math.isnan(at[moment(21)][0])
    assert at[moment(30)] == (1000, Provenance.INJECTED)
    assert at[moment(32)] == (32, Provenance.LIVE)
    assert Provenance.INJECTED not in speed[2]
    missing = [time for time, value in zip(count[0], count[1], strict=True) if math.isnan(value)][2:]
    assert len(missing) == 1
    assert moment(39) < missing[0] < moment(41)


def test_events_are_marks_with_their_text(browser: Connection, folder: Path) -> None:
    with build(folder / "a.mem") as work:
        work.block("cell")
        for number in range(1, 61):
            work.frame(number, image(number))
        for number in range(1, 31):
            work.event(number, 2 * number, f"event {number}")
    _, events = plot(browser, "a.mem", "cell/count")
    assert [(one["time_s"], one["text"]) for one in events][:2] == [
        (moment(2), "good event 1"),
        (moment(4), "good event 2"),
    ]
    _, few = plot(browser, "a.mem", "cell/count", columns=3)
    assert len(few) <= 4
    assert sum(one.get("count", 1) for one in few) == 30


def test_damage_costs_only_its_chunk(browser: Connection, folder: Path) -> None:
    file = plain(folder / "a.mem", last=1000)
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 4] = b"\xff\xff\xff\xff"
    file.write_bytes(data)
    number = result(browser, "plot", name="a.mem", paths=["cell/count"], columns=9)["number"]
    parts = iter(lambda: result(browser, "more", number=number), None)
    assert "lost after" in [*parts][-1]["damage"][0]
    ((_, values, _),), _ = plot(browser, "a.mem", "cell/count")
    good = [value for value in values if not math.isnan(value)]
    assert 950 <= len(good) < 1000
    assert len(values) > len(good)  # the missing frames are a gap
    number = result(browser, "verify", name="a.mem")
    last = None
    while (part := result(browser, "more", number=number)) is not None:
        last = part
    assert last is not None
    assert last["damage"]
    assert last["chunks"] == 99


def test_hostile_bytes_are_answered(browser: Connection, folder: Path) -> None:
    random = np.random.default_rng(7)
    whole = plain(folder / "whole.mem").read_bytes()
    for turn in range(60):
        data = bytearray(whole)
        for at in random.integers(0, len(data), 12):
            data[at] = random.integers(0, 256)
        name = f"{turn}.mem"
        (folder / name).write_bytes(data)
        for call, more in (("describe", {}), ("plot", {"paths": ["cell/count"], "columns": 50}), ("verify", {})):
            found = said(browser, f"recordings.{call}", name=name, **more)
            assert "the server failed" not in found.get("error", "")
            number = found.get("result") if call == "verify" else (found.get("result") or {}).get("number")
            while number is not None:
                part = said(browser, "recordings.more", number=number)
                assert "the server failed" not in part.get("error", "")
                if part.get("result") is None:
                    break


def test_work_of_a_page_is_bounded_and_can_be_stopped(browser: Connection, folder: Path) -> None:
    plain(folder / "a.mem")
    numbers = [result(browser, "verify", name="a.mem") for _ in range(tab.MAX_WORKS)]
    assert "at most 4" in error(browser, "verify", name="a.mem")
    result(browser, "stop", number=numbers[0])
    assert "stopped" in error(browser, "more", number=numbers[0])
    result(browser, "verify", name="a.mem")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"paths": ["cell/nothing"]}, "nothing"),
        ({"paths": ["cell/row"]}, "array"),
        ({"paths": ["cell/*"]}, "several"),
        ({"paths": ["cell/count/in"]}, "/in"),
        ({"paths": ["cell/count"] * 33}, "malformed"),
        ({"paths": [], "columns": 0}, "malformed"),
        ({"paths": [], "from_s": -1}, "malformed"),
    ],
)
def test_wrong_plot_is_answered(browser: Connection, folder: Path, given: dict[str, Any], message: str) -> None:
    plain(folder / "a.mem")
    assert message in error(browser, "plot", **{"name": "a.mem", "columns": 10} | given)


def test_search_finds_registers(browser: Connection, folder: Path) -> None:
    plain(folder / "a.mem")
    assert [one["path"] for one in result(browser, "registers", name="a.mem", filter="O")] == [
        "cell/count",
        "cell/on",
        "cell/row",
    ]


def test_instance_that_plays_nothing_says_so(browser: Connection) -> None:
    assert result(browser, "replays")["replays"] == []


def test_replays_need_their_role(segment: Segment) -> None:
    with pages(segment, roles=("read", "write", "inject")) as server, server.open() as browser:
        assert "needs the role control" in error(browser, "replay", paused=True)
    with pages(segment, roles=("control",)) as server, pytest.raises(Exception, match="403"):
        server.open()
    with pages(segment, roles=("read", "control")) as server, server.open() as browser:
        assert "plays no recording" in error(browser, "replay", paused=True)
