"""Reading recordings by ``shmio.open_dump``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import shmio
from shmio.errors import MissingLibraryError, PathError, RecordingError
from shmio.layout.model import Layout, Register
from shmio.recording.format.encoding import Gap, Reason, StepMark
from shmio.recording.format.records import Damage
from shmio.recording.reading.part import Part
from shmio.segment import Event, Frame, Quality
from tests.unit.recording.build import PERIOD_NS, START_NS, build, image, plain, varied


def at(number: int) -> int:
    """Return the log time of a frame."""
    return START_NS + number * PERIOD_NS


def cut_off(file: Path, to: Path) -> Path:
    """Copy a file without its index, its footer and the end of its last chunk."""
    data = file.read_bytes()
    with Part(file, None) as part:
        [*_, (chunk, _, _)] = part.found.chunks.between(0, at(10**6))
    to.write_bytes(data[: chunk.at + chunk.size - 5])
    return to


@pytest.mark.parametrize("closed", [True, False])
def test_frames_from_any_time_to_any_time(tmp_path: Path, closed: bool) -> None:
    file = plain(tmp_path / "a.mem", last=100)
    if not closed:
        file = cut_off(file, tmp_path / "b.mem")
    last = 100 if closed else 90
    with shmio.open_dump(file) as dump:
        assert (dump.closed, dump.sources, dump.instance) == (closed, ("cell",), "a50")
        [block] = dump.blocks
        assert (block.frames, block.begin_ns, block.end_ns) == (last, at(1), at(last))
        assert (dump.begin_ns, dump.end_ns) == (at(1), at(last))
        for first, to in ((1, last), (7, 33), (40, 40), (95, 200), (0, 0), (300, 400)):
            found = [(e.time_ns, e.item.number) for e in dump.frames("cell", at(first), at(to))]
            assert found == [(at(n), n) for n in range(max(1, first), min(to, last) + 1)]
        [entry] = dump.frames(None, at(50), at(50))
        assert entry.block is block
        assert block.value(entry.item, "speed") == block.value(entry.item, "cell/speed") == 25.0


def test_a_seek_reads_one_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with shmio.open_dump(plain(tmp_path / "a.mem", last=2000)) as dump:
        reads: list[int] = []
        records = dump._parts[0].reader.records
        original = records.read

        def read(at: int, size: int, *rest: int) -> bytes:
            reads.append(size)
            return original(at, size, *rest)

        monkeypatch.setattr(records, "read", read)
        assert next(dump.frames("cell", at(1234))).item.number == 1234
        assert len(reads) <= 3  # a chunk, its times and the layout
        reads.clear()
        latest = dump.latest("cell", at(777) + 5)
        assert latest is not None
        assert latest.item.number == 777
        assert len(reads) <= 2


def test_items_of_a_source_come_in_recorded_order(tmp_path: Path) -> None:
    with shmio.open_dump(varied(tmp_path / "a.mem")) as dump:
        entries = list(dump.items("cell"))
        assert {e.block.source for e in entries if e.block} == {"cell"}
        frames = [e.item.number for e in entries if isinstance(e.item, Frame)]
        assert frames == [n for n in range(1, 61) if n not in (31, 32, 33)]
        [gap] = [e.item for e in entries if isinstance(e.item, Gap)]
        assert (gap.first, gap.last) == (31, 33)
        position = [e.item for e in entries].index(gap)
        before, after = entries[position - 1].item, entries[position + 1].item
        assert isinstance(before, Event)
        assert isinstance(after, Frame)
        assert (before.frame, after.number) == (30, 34)
        assert [e.item.step for e in entries if isinstance(e.item, StepMark)] == list(range(51, 61))
        assert [e.item.text for e in entries if isinstance(e.item, Event)] == [f"event {n}" for n in range(1, 5)]
        assert not any(isinstance(e.item, Gap) for e in dump.items("press"))
        assert len(list(dump.items())) == len(entries) + 60
        later = list(dump.items("cell", at(34)))
        assert later == entries[-len(later) :]
        assert later[0].item == gap  # a gap has the time of the next message


def test_latest_returns_the_frame_at_a_time(tmp_path: Path) -> None:
    with shmio.open_dump(varied(tmp_path / "a.mem")) as dump:
        for time_ns, number in ((at(33) + 1, 30), (at(12), 12), (at(10**4), 60)):
            latest = dump.latest("cell", time_ns)
            assert latest is not None
            assert latest.item.number == number
        assert dump.latest("cell", at(1) - 1) is None


def test_the_next_change_and_the_next_event(tmp_path: Path) -> None:
    file = tmp_path / "a.mem"
    with build(file) as work:
        work.block("cell")
        work.event(1, 0, "begin")
        for number in range(1, 101):
            work.frame(number, image(number, speed=float(number // 40), on=number == 61))
            if number % 7 == 0:
                work.chunk()
            if number == 70:
                work.event(2, 70, "here")
    with shmio.open_dump(file) as dump:

        def change(path: str, after: int) -> int | None:
            found = dump.next_change(path, at(after))
            return found and found.item.number

        assert [change("speed", after) for after in (0, 1, 39, 40, 79, 80)] == [40, 40, 40, 80, 80, None]
        assert [change("on", after) for after in (0, 60, 61, 62)] == [61, 61, 62, None]
        assert change("row/3", 50) == 51
        assert change("row/1", 0) is None
        assert dump.next_change("speed", at(41), at(79)) is None
        first, second = dump.next_event(), dump.next_event("cell", at(0))
        assert first is not None
        assert second is not None
        assert (first.item.text, second.item.text) == ("begin", "here")
        assert dump.next_event("cell", at(70)) is None


def test_columns_have_the_same_values_as_frames(tmp_path: Path) -> None:
    with shmio.open_dump(varied(tmp_path / "a.mem")) as dump:
        columns = dump.columns(["cell/*"], at(5), at(50))
        frames = list(dump.frames("cell", at(5), at(50)))
        assert list(columns) == ["count", "speed", "on", "row"]
        assert columns.time_ns.tolist() == [e.time_ns for e in frames]
        for name in ("number", "cycle", "source_ns", "quality", "provenance"):
            assert getattr(columns, name).tolist() == [getattr(e.item, name) for e in frames]
        for path, values in columns.items():
            assert values.tolist() == [e.block.value(e.item, path) for e in frames if e.block]
        assert 1009 in columns["count"].tolist() + dump.columns("cell/count")["count"].tolist()
        raw = dump.columns("cell/count", raw=True)
        assert raw["count"].tolist() == raw.number.tolist()
        assert [columns[path].dtype.str for path in columns] == ["<i2", "<f4", "|b1", "<i2"]
        assert dump.columns("cell/row/3")["row/3"].tolist() == dump.columns("cell/count")["count"].tolist()
        empty = dump.columns("cell/row", at(10**5))
        assert (empty["row"].shape, len(empty.time_ns)) == ((0, 3), 0)


@pytest.mark.parametrize(
    ("paths", "message"),
    [
        (["count"], "not one of the 2 sources"),
        (["cell/nothing"], "no such register"),
        (["cell/count", "press/count"], "these registers belong to cell and press"),
        (["cell/count/in"], "leave out /in"),
        (["cell/x*"], "this recording has no such register"),
    ],
)
def test_invalid_registers_are_refused(tmp_path: Path, paths: list[str], message: str) -> None:
    with shmio.open_dump(varied(tmp_path / "a.mem")) as dump, pytest.raises(PathError, match=message):
        dump.columns(paths)


def test_a_source_must_be_named_and_known(tmp_path: Path) -> None:
    with shmio.open_dump(varied(tmp_path / "a.mem")) as dump:
        with pytest.raises(PathError, match="name one of them: cell, press"):
            next(dump.frames())
        with pytest.raises(PathError, match="unknown source 'pres'; did you mean 'press'"):
            next(dump.items(["cell", "pres"]))


def test_files_of_one_run_form_one_dump(tmp_path: Path) -> None:
    """The files may be in any order. Frames in two files appear once, and frames in no file are a gap."""
    files = [
        plain(tmp_path / "c.mem", 71, 100),
        plain(tmp_path / "a.mem", 1, 40),
        plain(tmp_path / "b.mem", 31, 60),
    ]
    with shmio.open_dump(files) as dump:
        assert [file.name for file in dump.files] == ["a.mem", "b.mem", "c.mem"]
        expected = [*range(1, 61), *range(71, 101)]
        assert [e.item.number for e in dump.frames()] == expected
        assert dump.columns("count")["count"].tolist() == expected
        assert [e.item for e in dump.items() if isinstance(e.item, Gap)] == [
            Gap("cell", 1, "frames", 61, 70, 10, Reason.ELSEWHERE, at(60), at(71))
        ]
        assert len(dump.blocks) == 1
        latest = dump.latest("cell", at(65))
        assert latest is not None
        assert latest.item.number == 60
        change = dump.next_change("count", at(60))
        assert change is not None
        assert change.item.number == 71
        assert [e.item.number for e in dump.frames(None, at(55), at(72))] == [55, 56, 57, 58, 59, 60, 71, 72]


def test_overlapping_files_are_read_in_the_order_of_time(tmp_path: Path) -> None:
    one = plain(tmp_path / "a.mem", 1, 200)
    with build(tmp_path / "b.mem") as work:
        work.block("press", section=2)
        for number in range(1, 201):
            work.frame(number, image(number), "press")
    with shmio.open_dump([tmp_path / "b.mem", one]) as dump:
        times = [e.time_ns for e in dump.items()]
        assert len(times) == 400
        assert times == sorted(times)


def test_columns_fill_the_gaps_of_one_recorder_from_another(tmp_path: Path) -> None:
    with build(tmp_path / "a.mem") as work:
        work.block("cell")
        for number in (*range(1, 150), *range(250, 401)):
            work.frame(number, image(number), effective=image(-number) if number == 7 else None)
    with shmio.open_dump([tmp_path / "a.mem", plain(tmp_path / "b.mem", 100, 300)]) as dump:
        columns = dump.columns("cell/count")
        assert columns.number.tolist() == [frame.number for _, _, frame in dump.frames()] == list(range(1, 401))
        assert columns["count"].tolist() == [-7 if number == 7 else number for number in range(1, 401)]
        assert columns.time_ns.tolist() == [at(number) for number in range(1, 401)]
        assert dump.columns("cell/count", at(5), at(8), raw=True)["count"].tolist() == [5, 6, 7, 8]


def test_files_that_overlap_only_briefly(tmp_path: Path) -> None:
    with build(tmp_path / "a.mem") as work:
        work.block("cell")
        for number in (*range(1, 20), *range(30, 41)):
            work.frame(number, image(number))
    with shmio.open_dump([tmp_path / "a.mem", plain(tmp_path / "b.mem", 15, 60)]) as dump:
        assert [frame.number for _, _, frame in dump.frames()] == list(range(1, 61))
        assert dump.columns("cell/count").number.tolist() == list(range(1, 61))
        assert not [entry for entry in dump.items() if isinstance(entry.item, Gap)]


def test_files_of_different_runs_are_refused(tmp_path: Path) -> None:
    with build(tmp_path / "b.mem", epoch="11" * 8) as work:
        work.block("cell")
        work.frame(1, image(1))
    with pytest.raises(RecordingError, match=r"b.mem and .*a.mem come from different runs"):
        shmio.open_dump([plain(tmp_path / "a.mem"), tmp_path / "b.mem"])
    with pytest.raises(RecordingError, match="a recording has 1 to"):
        shmio.open_dump([])


def test_a_changed_layout(tmp_path: Path) -> None:
    other = Layout("DB1", 1, 4, False, (Register("count", "DINT", (), 0, None, 4, 1),))
    with build(tmp_path / "a.mem") as work:
        work.block("cell")
        for number in range(1, 11):
            work.frame(number, image(number))
        work.block("cell", other, section=5)
        for number in range(11, 21):
            work.frame(number, number.to_bytes(4, "big"))
    with shmio.open_dump(tmp_path / "a.mem") as dump:
        assert [(block.section, block.layout.size) for block in dump.blocks] == [(1, 16), (5, 4)]
        assert len(list(dump.frames("cell"))) == 20
        with pytest.raises(RecordingError, match="a reload changed these registers"):
            dump.columns("count")
        assert dump.columns("count", at(11))["count"].tolist() == list(range(11, 21))
        assert dump.columns("speed")["speed"].tolist() == [0.0] * 10


def test_damage_is_reported_and_the_rest_is_read(tmp_path: Path) -> None:
    file = plain(tmp_path / "a.mem", last=100)
    data = bytearray(file.read_bytes())
    with Part(file, None) as part:
        chunks = [chunk for chunk, _, _ in part.found.chunks.between(0, at(1000))]
    data[chunks[4].at + 60] ^= 0xFF
    file.write_bytes(data)
    told: list[Damage] = []
    with shmio.open_dump(file, lambda _, damage: told.append(damage)) as dump:
        whole = [*range(1, 41), *range(51, 101)]
        assert [e.item.number for e in dump.frames("cell")] == whole
        assert dump.columns("count")["count"].tolist() == whole
    assert [(d.first, d.after_ns, d.before_ns) for d in told] == [(chunks[4].at, at(40), at(51))] * 2
    with shmio.open_dump(file) as dump:
        with pytest.raises(RecordingError, match="damaged"):
            list(dump.frames("cell"))
        with pytest.raises(RecordingError, match="damaged"):
            dump.columns("count")
        assert len(list(dump.frames("cell", at(60)))) == 41


@pytest.mark.parametrize("back", [3, 20, 60, 200, 400])
def test_a_damaged_index_is_not_used(tmp_path: Path, back: int) -> None:
    file = plain(tmp_path / "a.mem", last=100)
    data = bytearray(file.read_bytes())
    data[-back] ^= 0xFF
    file.write_bytes(data)
    with shmio.open_dump(file, lambda *_: None) as dump:
        assert dump.columns("count")["count"].tolist() == list(range(1, 101))
        assert [e.item.number for e in dump.frames("cell", at(31), at(33))] == [31, 32, 33]


def test_latest_in_overlapping_files(tmp_path: Path) -> None:
    """The file that was started later may have ended earlier."""
    with shmio.open_dump([plain(tmp_path / "a.mem", 1, 400), plain(tmp_path / "b.mem", 100, 200)]) as dump:
        for number in (50, 150, 200, 300, 400):
            latest = dump.latest("cell", at(number))
            assert latest is not None
            assert latest.item.number == number


KINDS: list[dict[str, Any]] = [
    {},
    {"reason": "so so", "quality": Quality.UNCERTAIN},
    {"reason": "too long an answer", "quality": Quality.BAD},
    {"effective": image(-1)},
]


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    runs=st.lists(
        st.tuples(
            st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3)), min_size=1, max_size=4), st.integers(1, 30)
        ),
        min_size=1,
        max_size=6,
    ),
    chunk=st.integers(1, 200),
)
def test_batches_equal_frames_for_any_order_of_messages(
    tmp_path: Path, runs: list[tuple[list[tuple[int, int]], int]], chunk: int
) -> None:
    """Batches have frames of equal patterns. The test therefore repeats patterns and then changes them."""
    sources = ["cell", "press", "saw"]
    numbers = dict.fromkeys(sources, 0)
    with build(tmp_path / "a.mem") as work:
        for section, source in enumerate(sources):
            work.block(source, section=section)
        for count, (place, kind) in enumerate(turn for pattern, times in runs for turn in pattern * times):
            source = sources[place]
            numbers[source] += 1
            work.frame(numbers[source], image(numbers[source]), source, **KINDS[kind])
            if count % chunk == chunk - 1:
                work.chunk()
    with shmio.open_dump(tmp_path / "a.mem") as dump:
        for source in dump.sources:
            frames = [entry.item for entry in dump.frames(source)]
            batches = [batch for _, batch in dump.batches(source)]
            assert [number for batch in batches for number in batch.head["number"].tolist()] == [
                f.number for f in frames
            ]
            assert [bytes(one) for batch in batches for one in batch.images] == [f.image for f in frames]
            reasons = [reason for batch in batches for reason in batch.reasons or [""] * len(batch)]
            assert reasons == [f.reason for f in frames]
            raw = [bytes(one) for _, batch in dump.batches(source, raw=True) for one in batch.images]
            assert raw == [f.raw for f in frames]
            assert len(frames) == numbers[source]


def test_arrow_tables_and_missing_libraries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with shmio.open_dump(varied(tmp_path / "a.mem")) as dump:
        columns = dump.columns("cell")
    table = columns.to_arrow()
    assert table.column_names[:6] == ["time", "source_time", "number", "cycle", "quality", "provenance"]
    assert [str(table.schema.field(name).type) for name in ("time", "count", "speed", "on", "row")] == [
        "timestamp[ns, tz=UTC]",
        "int16",
        "float",
        "bool",
        "fixed_size_list<item: int16>[3]",
    ]
    assert table["row"].to_pylist() == columns["row"].tolist()
    assert table["quality"].to_pylist()[5:8] == ["good", "bad", "good"]
    for name in ("pandas", "polars", "pyarrow"):
        monkeypatch.setitem(__import__("sys").modules, name, None)
    for convert, remedy in (
        (columns.to_pandas, r"pandas is not installed; run pip install 'shmio\[analysis\]'"),
        (columns.to_polars, r"polars is not installed; run pip install 'shmio\[analysis\]'"),
        (columns.to_arrow, r"pyarrow is not installed; run pip install 'shmio\[analysis\]'"),
    ):
        with pytest.raises(MissingLibraryError, match=remedy):
            convert()


def test_pandas_and_polars(tmp_path: Path) -> None:
    import pandas  # slow import
    import polars

    with shmio.open_dump(varied(tmp_path / "a.mem")) as dump:
        columns = dump.columns("cell")
    for table in (columns.to_pandas(), columns.to_polars()):
        names = list(table.columns)
        assert names[-6:] == ["count", "speed", "on", "row/1", "row/2", "row/3"]
        assert np.array_equal(table["row/3"].to_numpy(), columns["row"][:, 2])
    registers = Register("time", "INT", (), 0, None, 2, 1), Register("number", "INT", (), 2, None, 2, 1)
    with build(tmp_path / "names.mem") as work:
        work.block("cell", Layout("DB2", 2, 4, False, registers))
        work.frame(7, bytes((0, 1, 0, 2)))
    with shmio.open_dump(tmp_path / "names.mem") as dump:
        named = dump.columns("cell")
    for table in (named.to_pandas(), named.to_polars()):
        assert [table[name].to_numpy()[0] for name in ("number", "cell/number", "cell/time")] == [7, 2, 1]
    assert columns.to_pandas().index[0] == pandas.Timestamp(columns.time_ns[0], tz="UTC")
    assert columns.to_polars()["time"].dtype == polars.Datetime("ns", "UTC")
