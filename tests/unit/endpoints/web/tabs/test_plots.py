from __future__ import annotations

import base64
import json
import math
import socket
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.connection import Connection

from shmio.endpoints.web import page, signals
from shmio.endpoints.web.tabs import plots
from shmio.recorder.file_output import Output, create
from shmio.recorder.instance_follower import FROM_THE_FIRST, InstanceFollower
from shmio.recorder.recorder import Recorder
from shmio.recording.format.encoding import SUPERVISED
from shmio.segment import BlockWriter, Provenance, Quality, Segment
from shmio.testing.cell import until
from tests.unit.endpoints.harness import LAYOUT
from tests.unit.endpoints.web.harness import TIMEOUT_S, processes, spec
from tests.unit.endpoints.web.test_page import Pages, pages, said
from tests.unit.recorder.test_recorder_rotation import series, tend

POSITION = "cell/axis/position"


@dataclass
class Batch:
    number: int
    before: float
    times: list[float]
    values: list[list[float]]
    marks: list[list[int]]


def decoded(message: bytes, registers: int) -> Batch:
    number, rows, before = struct.unpack_from("<IId", message)
    columns = struct.unpack_from(f"<{(1 + registers) * rows}d", message, 16)
    marks = message[16 + 8 * len(columns) :]
    assert len(marks) == registers * rows
    cut = [list(columns[rows * index : rows * (index + 1)]) for index in range(1 + registers)]
    return Batch(number, before, cut[0], cut[1:], [list(marks[rows * i : rows * (i + 1)]) for i in range(registers)])


def batches(browser: Connection, registers: int = 1) -> Iterator[Batch]:
    """Yield the batches that a page receives."""
    while True:
        message = browser.recv(TIMEOUT_S)
        if isinstance(message, bytes):
            yield decoded(message, registers)


def course(browser: Connection, count: int, registers: int = 1) -> tuple[list[float], list[list[float]], list[int]]:
    """Return a number of samples: their times, values and the marks of the first register; a gap is a NaN."""
    times: list[float] = []
    values: list[list[float]] = [[] for _ in range(registers)]
    marks: list[int] = []
    for batch in batches(browser, registers):
        if times and batch.before != times[-1]:
            times.append(math.nan)
        times += batch.times
        marks += batch.marks[0]
        for column, new in zip(values, batch.values, strict=True):
            column.extend(new)
        if len(marks) >= count:
            return times, values, marks
    raise AssertionError


def image(position: float) -> bytes:
    return struct.pack(">f", position) + bytes(LAYOUT.size - 4)


def publish(writer: BlockWriter, positions: Sequence[float], first: int = 1, **more: Any) -> None:
    for cycle, position in enumerate(positions, first):
        writer.publish(image(position), cycle=cycle, **({"quality": Quality.GOOD} | more))


def follow(server: Pages, browser: Connection, *paths: str) -> dict[str, Any]:
    return dict(said(browser, "plots.follow", source="cell", paths=paths)["result"])


def test_course_has_the_past_and_each_new_frame(segment: Segment) -> None:
    writer = segment.writer("cell")
    publish(writer, [1, 2, 3])
    with pages(segment) as server, server.open() as browser:
        found = follow(server, browser, POSITION, "cell/step")
        assert [signal["path"] for signal in found["signals"]] == [POSITION, "cell/step"]
        publish(writer, range(4, 401), 4)
        times, values, marks = course(browser, 400, 2)
        assert not any(map(math.isnan, times))  # no gap
        assert values[0] == list(range(1, 401))
        assert values[1] == [0] * 400
        assert times == sorted(times)
        assert set(marks) == {Provenance.LIVE}


def test_second_page_gets_the_past_and_then_the_same(segment: Segment) -> None:
    writer = segment.writer("cell")
    with pages(segment) as server, server.open() as one, server.open() as two:
        number = follow(server, one, POSITION)["number"]
        publish(writer, [1, 2])
        assert course(one, 2)[1] == [[1, 2]]
        assert follow(server, two, POSITION)["number"] == number
        publish(writer, [3], 3)
        assert course(one, 1)[1] == [[3]]
        assert course(two, 3)[1] == [[1, 2, 3]]


def test_bad_quality_is_a_gap_and_provenance_a_mark(segment: Segment) -> None:
    writer = segment.writer("cell")
    publish(writer, [1])
    publish(writer, [1], 2, quality=Quality.BAD, reason="a test")
    publish(writer, [2], 3, provenance=Provenance.SIMULATED)
    with pages(segment) as server, server.open() as browser:
        follow(server, browser, POSITION)
        _, values, marks = course(browser, 3)
        assert [values[0][0], values[0][2]] == [1, 2]
        assert math.isnan(values[0][1])
        assert marks == [Provenance.LIVE, Provenance.LIVE, Provenance.SIMULATED]


def test_altered_values_are_marked_and_others_are_not(segment: Segment) -> None:
    writer = segment.writer("cell")
    writer.publish(image(1), cycle=1, effective=image(5), quality=Quality.GOOD)
    with pages(segment) as server, server.open() as browser:
        follow(server, browser, POSITION, "cell/step")
        batch = next(batches(browser, 2))
        assert batch.values == [[5], [0]]
        assert batch.marks == [[Provenance.INJECTED], [Provenance.LIVE]]


def test_frames_that_are_skipped_are_a_gap(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "MAX_BEHIND", 5)
    block = segment.blocks["cell"]
    feed = signals.Feed(7, block, [block.layout.registers[0]], 0)
    writer = segment.writer("cell")
    publish(writer, [1])
    (first,) = feed.read()
    publish(writer, range(2, 40), 2)
    (second,) = feed.read()
    publish(writer, [40], 40)
    (third,) = feed.read()
    assert decoded(first, 1).values == [[1]]
    assert decoded(second, 1).values == [[35, 36, 37, 38, 39]]
    assert math.isnan(decoded(second, 1).before)
    assert decoded(third, 1).before == decoded(second, 1).times[-1]


def test_long_past_comes_at_equal_distances(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "MAX_HISTORY", 10)
    writer = segment.writer("cell")
    publish(writer, range(1, 301))
    with pages(segment) as server, server.open() as browser:
        follow(server, browser, POSITION)
        found = course(browser, 7)[1][0]
        assert found[-1] == 300
        assert len(found) <= 10
        assert len({later - earlier for earlier, later in pairwise(found)}) == 1


def test_page_that_stalls_gets_the_newest_data(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that does not read for 20 batches of 180 kB gets a few of them, a gap, and the newest."""
    monkeypatch.setattr(page, "MAX_BATCHES", 4)
    bursts, frames = 20, 100
    paths = [f"cell/long/{number}" for number in range(1, 201)]
    writer = segment.writer("cell")
    with pages(segment) as server, server.open(max_queue=1, sock=small(server)) as stalled, server.open() as other:
        for browser in (stalled, other):
            follow(server, browser, *paths)
        for burst in range(bursts):
            publish(writer, [0] * frames, 1 + frames * burst)
            course(other, frames, len(paths))  # nothing is late for the other page
        publish(writer, [0], 1 + frames * bursts)
        newest = next(batches(other, len(paths))).times[-1]
        received, gaps, last = 0, 0, math.nan
        for batch in batches(stalled, len(paths)):
            received += len(batch.times)
            gaps += batch.before != last
            last = batch.times[-1]
            if last == newest:
                break
        assert received < frames * bursts / 2
        assert gaps > 1  # the first is the beginning


def small(server: Pages) -> socket.socket:
    """Return a connection to the server whose client's kernel buffers less than a batch."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
    connection.connect(("127.0.0.1", server.port))
    return connection


def test_empty_list_ends_the_course(segment: Segment) -> None:
    writer = segment.writer("cell")
    with pages(segment) as server, server.open() as browser:
        follow(server, browser, POSITION)
        assert said(browser, "plots.follow", source="cell", paths=[])["result"] is None
        publish(writer, [1])
        follow(server, browser, "cell/step")
        assert next(batches(browser)).values == [[0]]


def test_reload_of_the_source_tells_the_page(segment: Segment) -> None:
    publish(segment.writer("cell"), [1])
    with pages(segment) as server, server.open() as browser:
        follow(server, browser, POSITION)
        segment.change(retire=["cell"])
        while True:
            message = browser.recv(TIMEOUT_S)
            if isinstance(message, str) and json.loads(message).get("topic") == "plots":
                assert json.loads(message)["data"] == []
                return


@pytest.mark.parametrize(
    ("paths", "error"),
    [
        (["cell/nothing"], "nothing"),
        (["cell/long"], "array"),
        (["other/x"], "other"),
        (["x"] * 201, "malformed"),
    ],
)
def test_wrong_request_is_answered(segment: Segment, paths: list[str], error: str) -> None:
    with pages(segment) as server, server.open() as browser:
        assert error in said(browser, "plots.follow", source="cell", paths=paths)["error"]


def test_number_of_registers_is_bounded(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "MAX_SIGNALS", 1)
    with pages(segment) as server, server.open() as browser:
        assert "at most 1" in said(browser, "plots.follow", source="cell", paths=[POSITION, "cell/step"])["error"]


def recorder(segment: Segment, folder: Path) -> Recorder:
    path, fd = create(folder, segment.instance)
    return Recorder(InstanceFollower(segment, FROM_THE_FIRST), Output(path, fd, limit_bytes=1 << 24), by=SUPERVISED)


def flush(work: Recorder) -> None:
    while work.run_once():
        pass
    work._writer.flush()
    work.output.flush()
    until(lambda: work.output.path.stat().st_size == work.output.written > 0, "the bytes in the file")


def recorded(browser: Connection, **given: Any) -> tuple[list[float], list[float]]:
    """Return times and values of a register's past."""
    found = said(browser, "plots.past", **{"source": "cell", "paths": [POSITION], "columns": 4000} | given)
    times, values = [], []
    for number in found["result"]:
        while (part := said(browser, "plots.more", number=number)["result"]) is not None:
            for batch in filter(None, map(base64.b64decode, part["batches"])):
                times += decoded(batch, 1).times
                values += decoded(batch, 1).values[0]
    return times, values


def test_past_comes_from_the_file_that_is_being_written(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plots, "RECORDED_S", 0.0)
    writer = segment.writer("cell")
    publish(writer, range(1, 101))
    work = recorder(segment, tmp_path)
    with pages(segment, recordings=tmp_path) as server, server.open() as browser:
        follow(server, browser, POSITION)
        times, (values,), _ = course(browser, 100)
        flush(work)
        assert recorded(browser, from_s=times[0], to_s=times[-1]) == (times, values)
        some_times, some = recorded(browser, from_s=times[40], to_s=times[60])
        assert set(times[40:61]) <= set(some_times)
        assert len(some) <= 100
        assert recorded(browser, from_s=times[0] - 9, to_s=times[0] - 8) == ([], [])
        missing = said(browser, "plots.past", source="cell", paths=["cell/x"], from_s=0, to_s=9e9, columns=9)
        assert "cell/x" in missing["error"]
    assert work.close()


def test_past_of_another_run_is_not_taken(segment: Segment, instance: str, tmp_path: Path) -> None:
    publish(segment.writer("cell"), range(1, 101))
    work = recorder(segment, tmp_path)
    flush(work)
    assert work.close()
    segment.unlink()
    with Segment.create(instance, [spec()], processes()) as other:
        with pages(other, recordings=tmp_path) as server, server.open() as browser:
            assert recorded(browser, from_s=0, to_s=9e9) == ([], [])
        other.unlink()


def test_past_goes_on_in_the_next_file(segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "RECORDED_S", 0.0)
    work = series(segment, tmp_path, rotate_mb=0.004, rotate_min=0)
    writer = segment.writer("cell")
    for turn in range(60):
        publish(writer, range(10 * turn, 10 * turn + 10), 10 * turn + 1)
        work.run_once()
        tend(work)
    assert work.close() == []
    assert len(list(tmp_path.glob("*.mem"))) > 10
    with pages(segment, recordings=tmp_path) as server, server.open() as browser:
        follow(server, browser, POSITION)
        times, (values,), _ = course(browser, 400)
        found_times, found = recorded(browser, from_s=times[50], to_s=times[350])
        assert found_times == sorted(found_times)
        live = dict(zip(times, values, strict=True))
        assert [live[time] for time in found_times if time in live] == [value for value in found if value >= values[0]]
        assert {259 + 10 * turn for turn in range(30)} <= set(found)  # the last frame of each turn
        assert not any(map(math.isnan, found))  # no gap between files
