"""A local program's view of an instance."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import shmio
from shmio.errors import NotRunningError, PathError, QualityError, SegmentError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.document import load_layout
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout, Register
from shmio.local.attach import Attachment
from shmio.segment import BlockSpec, BlockWriter, ProcessSpec, Quality, Segment

LAYOUT = Layout(
    "DB1",
    1,
    10,
    False,
    (
        Register("axis/position", "REAL", (), 0, None, 4, 1),
        Register("counts", "INT", ((1, 2),), 4, None, 4, 2),
        Register("on", "BOOL", (), 8, 0, 1, 1),
    ),
)


def image(position: float, first: int = 0, second: int = 0, on: bool = False) -> bytes:
    return struct.pack(">fhhBx", position, first, second, on)


@pytest.fixture
def writer(instance: str) -> Iterator[BlockWriter]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, 60_000_000_000, 1 << 20)
    with Segment.create(instance, [block], [ProcessSpec("cell", "source")]) as segment:
        yield segment.writer("cell")
        segment.unlink()


@pytest.fixture
def cell(instance: str, writer: BlockWriter) -> Iterator[Attachment]:
    with shmio.attach(instance) as cell:
        yield cell


def calls_of(cell: Attachment) -> list[Callable[[], object]]:
    """Return a call of each method that needs a running instance."""
    return [
        cell.layouts, cell.get, cell.real_sources, cell.injections, cell.lift_all, cell.replay, cell.step,
        cell.play, cell.pause, cell.release, cell.snapshots,
        lambda: cell.set({"cell/on": True}),
        lambda: cell.inject("cell/on"),
        lambda: cell.declare([{"name": "x", "target": "cell/on", "operation": "set", "value": 1}]),
        lambda: cell.lift("cell", 1),
        lambda: cell.save_snapshot("a"),
        lambda: cell.restore_snapshot("a"),
        lambda: cell.delete_snapshot("a"),
    ]  # fmt: skip


def test_every_method_reports_a_stopped_instance(instance: str, writer: BlockWriter) -> None:
    with shmio.attach(instance, writable=True) as cell:
        Path(f"/dev/shm/shmio-{instance}").unlink()
        for call in calls_of(cell):
            with pytest.raises(NotRunningError, match="has stopped"):
                call()


@pytest.mark.parametrize("stepped", [False, True])
def test_every_method_reports_a_closed_attachment(instance: str, writer: BlockWriter, stepped: bool) -> None:
    """The object that moves time exists only if the program has moved time before."""
    cell = shmio.attach(instance, writable=True)
    if stepped:
        cell.pause()
    cell.close()
    for call in calls_of(cell):
        with pytest.raises(SegmentError, match="detached"):
            call()


def test_a_program_reads_only_the_layouts_that_it_needs(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading all layouts of a large cell would take long."""
    read: list[int] = []

    def counting(data: bytes, digest: bytes) -> Layout:
        read.append(len(data))
        return load_layout(data, digest)

    monkeypatch.setattr("shmio.segment.segment.load_layout", counting)
    blocks = [BlockSpec(name, LAYOUT, 20_000_000, 60_000_000_000, 1 << 20) for name in ("one", "two", "three")]
    with Segment.create(instance, blocks, []) as segment:
        segment.writer("two").publish(image(1.5), cycle=1)
        read.clear()
        with shmio.attach(instance) as cell:
            assert (cell.sources, read) == (["one", "two", "three"], [])
            assert len(cell.get("two/on", "two/counts", "two/counts/2")) == 3
            assert (cell["two/axis/position"], cell.read("two/counts/1").value, read) == (1.5, 0, [])
            with cell.subscribe("two/axis") as updates:
                assert next(updates).source == "two"
            assert len(read) == 1
            assert [*cell.layouts("one", "two")] == ["one", "two"]
            three = cell.layouts()["three"]
            assert (three, three.hash, len(read)) == (LAYOUT, LAYOUT.hash, 2)
        segment.unlink()


def test_a_program_that_reads_many_registers_reads_their_layout_once(instance: str) -> None:
    members = " ".join(f"m{number} : Int := {number};" for number in range(20))
    text = f"DATA_BLOCK DB1 STRUCT {members} END_STRUCT; BEGIN END_DATA_BLOCK"
    (layout,) = compile_sources([Source("x.db", text.encode())]).layouts
    with Segment.create(instance, [BlockSpec("one", layout, 20_000_000, 60_000_000_000, 1 << 20)], []) as segment:
        segment.writer("one").publish(initial_frame(layout)[0], cycle=1)
        with shmio.attach(instance) as cell:
            for _ in range(2):
                assert [cell[f"m{number}"] for number in range(20)] == [*range(20)]
            assert cell.block().layout == layout
            with pytest.raises(PathError, match="m20"):
                cell["m20"]
        segment.unlink()


def test_values_by_path(cell: Attachment, writer: BlockWriter) -> None:
    writer.publish(image(1.5, -3, 4, on=True), cycle=1)
    assert cell["cell/axis/position"] == 1.5
    assert cell["axis/position/out"] == 1.5
    assert cell["cell/counts"] == [-3, 4]
    assert cell["cell/counts/2"] == 4
    assert cell["CELL://on"] is True


def test_value_without_good_quality_is_refused(cell: Attachment, writer: BlockWriter) -> None:
    with pytest.raises(QualityError, match="no data yet"):
        cell["cell/on"]
    with pytest.raises(QualityError, match="no data yet"):
        cell.frame()
    writer.publish(image(2.5), cycle=1, quality=Quality.BAD, reason="cable out")
    with pytest.raises(QualityError, match=r"cell/axis/position: cable out"):
        cell["cell/axis/position"]
    now = cell.read("cell/axis/position")
    assert (now.value, now.quality, now.reason, now.provenance) == (2.5, Quality.BAD, "cable out", "live")
    assert now.age_s is not None
    assert now.age_s >= 0


@pytest.mark.parametrize(
    "path", ["cell/nothing", "press/on", "cell/counts/3", "cell/axis", "cell/on/in", "model/clock"]
)
def test_missing_path_is_refused(cell: Attachment, path: str) -> None:
    with pytest.raises(PathError):
        cell.read(path)


def test_a_frame_is_a_copy_and_a_numpy_record(cell: Attachment, writer: BlockWriter) -> None:
    writer.publish(image(1.5, 7, 8), cycle=12)
    view = cell.frame("cell")
    writer.publish(image(9.0), cycle=13)
    assert (view.cycle, view["axis/position"], view.quality, view.reason) == (12, 1.5, Quality.GOOD, "")
    assert view.array["axis/position"][0] == 1.5
    assert view.array["counts"].tolist() == [[7, 8]]
    assert cell.frame().cycle == 13
    with pytest.raises(PathError, match="unknown source 'press'; valid: cell"):
        cell.frame("press")


def test_a_stream_has_every_frame_from_its_start_on(cell: Attachment, writer: BlockWriter) -> None:
    writer.publish(image(0), cycle=0)
    stream = cell.stream("cell", timeout_s=0)
    for cycle in range(1, 20):
        writer.publish(image(cycle), cycle=cycle)
    assert [(view.cycle, view["axis/position"], view.missed) for view in stream] == [(n, n, 0) for n in range(1, 20)]


def test_stream_counts_missed_frames(cell: Attachment, writer: BlockWriter) -> None:
    slots = cell.block().ring.slot_count
    stream = cell.stream(timeout_s=0)
    total = slots + 100
    for cycle in range(1, total + 1):
        writer.publish(image(0), cycle=cycle)
    views = list(stream)
    assert views[0].missed == views[0].cycle - 1 == total - slots
    assert [view.missed for view in views[1:]] == [0] * (len(views) - 1)
    assert views[-1].cycle == total


def test_wait_returns_the_next_frame(cell: Attachment, writer: BlockWriter) -> None:
    assert cell.wait(timeout_s=0) is None
    writer.publish(image(1), cycle=1)
    view = cell.frame()
    assert cell.wait(after=view, timeout_s=0) is None
    writer.publish(image(2), cycle=2)
    writer.publish(image(3), cycle=3)
    newer = cell.wait(after=view, timeout_s=10)
    assert newer is not None
    assert newer.cycle == 3


def test_attachment_is_not_current_after_the_instance_has_stopped(instance: str) -> None:
    with Segment.create(instance, [], []) as segment, shmio.attach(instance) as cell:
        assert cell.current
        segment.unlink()
        assert not cell.current


def test_attaching_to_a_stopped_instance_names_the_remedy(instance: str) -> None:
    with pytest.raises(NotRunningError, match="shmio-supervisor up"):
        shmio.attach(instance)


def test_an_unknown_attribute_of_the_package_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="nonsense"):
        shmio.nonsense  # noqa: B018


def test_a_value_that_was_never_read_is_none(cell: Attachment, writer: BlockWriter) -> None:
    writer.publish(image(0), cycle=1, quality=Quality.BAD, reason="absent", source_ns=0)
    now = cell.read("cell/axis/position")
    assert (now.value, now.source_time, now.quality) == (None, None, Quality.BAD)


def test_view_accepts_paths_with_and_without_the_source(cell: Attachment, writer: BlockWriter) -> None:
    writer.publish(image(3.5), cycle=1)
    view = cell.frame()
    assert view["cell/axis/position"] == view["axis/position"] == 3.5


def test_closed_attachment_refuses_reads(instance: str, writer: BlockWriter) -> None:
    cell = shmio.attach(instance)
    cell.close()
    with pytest.raises(SegmentError, match="detached"):
        cell["cell/on"]
