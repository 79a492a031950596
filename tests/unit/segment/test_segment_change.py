"""A segment that changes while it is read: blocks are added, ended and replaced."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import shmio
from shmio.errors import NotRunningError, PathError, SegmentError
from shmio.layout.model import Layout, Register
from shmio.local.reading import View
from shmio.segment import Block, BlockSpec, ProcessSpec, Quality, Segment, _atomics, header, shm
from shmio.segment import segment as sections

OLD = Layout("DB1", 1, 2, False, (Register("count", "INT", (), 0, None, 2, 1),))
NEW = Layout(
    "DB1", 1, 6, False, (Register("speed", "REAL", (), 0, None, 4, 1), Register("count", "INT", (), 4, None, 2, 1))
)


def spec(source: str, layout: Layout = OLD) -> BlockSpec:
    return BlockSpec(source, layout, 20_000_000, 60_000_000_000, 1 << 16)


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    with Segment.create(instance, [spec("cell"), spec("press")], [ProcessSpec("cell", "source")]) as segment:
        yield segment
        segment.unlink()


def test_an_attached_reader_sees_a_new_source(segment: Segment) -> None:
    with shmio.attach(segment.instance) as reader:
        before = reader.block("cell")
        segment.change(add=[spec("robot")])
        segment.writer("robot").publish(b"\0\7", cycle=1)
        assert reader["robot/count"] == 7
        assert reader.sources == ["cell", "press", "robot"]
        assert reader.block("cell") is before, "an unchanged block stays the same object"


def test_the_frames_of_ended_blocks_can_still_be_read(segment: Segment) -> None:
    for layout, cycle in ((NEW, 1), (OLD, 2)):
        segment.writer("cell").publish(bytes(segment.blocks["cell"].layout.size), cycle=cycle)
        segment.change(add=[spec("cell", layout)], retire=["cell"])
    with Segment.open(segment.instance) as reader:
        first, second = reader.ended
        assert (first.source, first.layout, first.section) == ("cell", OLD, segment.ended[0].section)
        assert [block.ring.head() for block in (first, second, reader.blocks["cell"])] == [1, 1, 0]
        frames = [block.latest() for block in (first, second)]
        assert [frame.cycle for frame in frames if frame] == [1, 2]
        assert first.retired
        segment.change(retire=["press"])
        assert reader.ended == [first, second], "unchanged until the next refresh"
        assert reader.refresh()
        assert [block.source for block in reader.ended] == ["cell", "press", "cell"]


def test_a_stream_continues_with_the_new_layout(segment: Segment) -> None:
    old = segment.writer("cell")
    with shmio.attach(segment.instance) as reader:
        stream = reader.stream("cell", timeout_s=20)
        old.publish(struct.pack(">h", 1), cycle=1)
        assert next(stream)["count"] == 1
        old.publish(struct.pack(">h", 2), cycle=2)
        segment.change(add=[spec("cell", NEW)], retire=["cell"])
        new = segment.writer("cell")
        new.publish(struct.pack(">fh", 2.5, 3), cycle=3)
        views = [next(stream), next(stream)]
        assert [(view["count"], view.layout.size, view.missed) for view in views] == [(2, 2, 0), (3, 6, 0)]
        assert reader["cell/speed"] == 2.5


def test_a_reader_that_waits_for_a_removed_source_is_woken_with_an_error(segment: Segment) -> None:
    with shmio.attach(segment.instance) as reader:
        stream = reader.stream("press")
        problems: list[Exception] = []

        def wait() -> None:
            try:
                next(stream)
            except NotRunningError as error:
                problems.append(error)

        waiter = threading.Thread(target=wait)
        waiter.start()
        segment.change(retire=["press"])
        waiter.join(20)
        assert not waiter.is_alive()
        assert "source 'press' was removed" in str(problems[0])
        with pytest.raises(PathError, match="unknown source 'press'"):
            reader.block("press")


def test_a_change_cut_off_by_the_supervisors_death_is_completed(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = header._set_table_state

    def die(memory: memoryview, generation: int, count: int) -> None:
        whole(memory, generation, count)
        raise SystemExit

    with shmio.attach(segment.instance) as reader:
        held, other = reader.block("cell"), reader.block("press")
        waiter = threading.Thread(target=held.cursor().next)
        waiter.start()
        with monkeypatch.context() as patched:
            patched.setattr(header, "_set_table_state", die)
            with pytest.raises(SystemExit):
                segment.change(add=[spec("cell", NEW)], retire=["cell"])
        assert not held.retired, "the new block exists, and the old one has not been ended"
        with Segment.open(segment.instance, writable=True) as successor:
            successor.end_replaced()
            assert successor.blocks["cell"].layout == NEW
        waiter.join(20)
        assert not waiter.is_alive()
        assert (held.retired, other.retired, reader.block("cell").retired) == (True, False, False)
        assert reader.block("cell").layout == NEW


@pytest.mark.parametrize("calls", [1, 2, 3])
def test_the_successor_wakes_readers_wherever_the_supervisor_died(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, calls: int
) -> None:
    """The supervisor dies after it wrote the new block's entry, after it ended the old block, or before it first rang.

    All readers wait without a time-out.
    """
    steps = 0

    def dying(step: Callable[..., None], *, before: bool = False) -> Callable[..., None]:
        def take(*arguments: object) -> None:
            nonlocal steps
            steps += 1
            if not (before and steps == calls):
                step(*arguments)
            if steps == calls:
                raise SystemExit

        return take

    with shmio.attach(segment.instance) as reader:
        held = reader.block("cell")
        seen = held.ring.doorbell(), held.events.ring.doorbell(), held.commands.bell()
        waits = [
            lambda: held.ring.wait(seen[0], -1),
            lambda: held.events.ring.wait(seen[1], -1),
            lambda: held.commands.wait(seen[2]),
        ]
        waiters = [threading.Thread(target=wait, daemon=True) for wait in waits]
        for waiter in waiters:
            waiter.start()
        with monkeypatch.context() as patched:
            patched.setattr(header, "_set_table_state", dying(header._set_table_state))
            patched.setattr("shmio.segment.segment.wake", dying(sections.wake, before=True))
            with pytest.raises(SystemExit):
                segment.change(add=[spec("cell", NEW)], retire=["cell"])
        assert all(waiter.is_alive() for waiter in waiters)
        with Segment.open(segment.instance, writable=True) as successor:
            successor.end_replaced()
            successor.end_replaced()
        for waiter in waiters:
            waiter.join(20)
            assert not waiter.is_alive()
        assert held.retired


def test_a_partly_ended_block_is_ended_by_the_successor(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    """The flag of the block's own section must be set, too, because some readers look only at that flag."""
    store = _atomics.store64

    def die(memory: memoryview, offset: int, value: int) -> None:
        store(memory, offset, value)
        if offset != header.GENERATION_OFFSET and value & header._RETIRED:
            raise SystemExit

    with monkeypatch.context() as patched:
        patched.setattr(_atomics, "store64", die)
        with pytest.raises(SystemExit):
            segment.change(retire=["cell"])
    assert [entry.retired for entry in segment._sections() if entry.name == "cell"].count(True) == 1
    with Segment.open(segment.instance, writable=True) as successor:
        successor.end_replaced()
        assert list(successor.blocks) == ["press"]
        assert all(entry.retired for entry in successor._sections() if entry.name == "cell")


@pytest.mark.parametrize("timeout_s", [None, 3600.0])
def test_a_lost_ring_leaves_no_reader_waiting(
    segment: Segment, timeout_s: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader that waits long or for ever looks periodically, too."""
    monkeypatch.setattr("shmio.segment.segment.wake", lambda *_: None)
    with shmio.attach(segment.instance) as reader:
        held = reader.block("cell")
        waiter = threading.Thread(target=held.cursor().next, args=(timeout_s,), daemon=True)
        waiter.start()
        segment.change(retire=["cell"])
        waiter.join(20)
        assert not waiter.is_alive()


def test_a_referenced_block_is_marked_as_retired_and_keeps_its_last_frame(segment: Segment) -> None:
    segment.writer("press").publish(b"\0\5", cycle=1)
    with shmio.attach(segment.instance) as reader:
        held = reader.block("press")
        cursor = held.cursor(after=0)
        segment.change(retire=["press"])
        assert held.retired
        frames = list(cursor)
        assert [(frame.raw, frame.quality) for frame in frames] == [(b"\0\5", Quality.GOOD)]


def test_a_change_without_room_changes_nothing(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    size, generation = segment.shared.size, segment.generation

    def full(*_: object) -> None:
        raise SegmentError("no room")

    monkeypatch.setattr(shm.SharedObject, "allocate", full)
    with pytest.raises(SegmentError, match="no room"):
        segment.change(add=[spec("robot")], retire=["cell"])
    assert (segment.shared.size, segment.generation) == (size, generation)
    assert list(segment.blocks) == ["cell", "press"]
    assert not segment.blocks["cell"].retired


def test_the_number_of_changes_is_limited(segment: Segment) -> None:
    for _ in range(45):  # forty, if the blocks have a model channel
        segment.change(add=[spec("cell")], retire=["cell"])
    with pytest.raises(
        SegmentError,
        match=r"room for 0 more blocks, not for 1 .*; restart the instance with shmio-supervisor down",
    ):
        segment.change(add=[spec("cell")], retire=["cell"])
    with Segment.open(segment.instance) as late:
        assert sorted(late.blocks) == ["cell", "press"]


def test_readers_during_changes(segment: Segment) -> None:
    """A reader that opens or refreshes the segment sees only complete tables, although the segment grows."""
    stop = threading.Event()
    problems: list[BaseException] = []

    def read() -> None:
        try:
            with Segment.open(segment.instance) as reader:
                while not stop.is_set():
                    reader.refresh()
                    assert set(reader.blocks) >= {"cell"}
                    with Segment.open(segment.instance) as other:
                        assert set(other.blocks) >= {"cell"}
        except BaseException as error:  # noqa: BLE001
            problems.append(error)

    readers = [threading.Thread(target=read) for _ in range(3)]
    for reader in readers:
        reader.start()
    for turn in range(20):
        segment.change(add=[spec("cell", (OLD, NEW)[turn % 2])], retire=["cell"])
    stop.set()
    for reader in readers:
        reader.join()
    assert problems == []


def test_wait_continues_with_the_new_block(segment: Segment) -> None:
    old = segment.writer("cell")
    for cycle in range(1, 11):
        old.publish(b"\0\1", cycle=cycle)
    with shmio.attach(segment.instance) as reader:
        last = reader.frame("cell")
        segment.change(add=[spec("cell", NEW)], retire=["cell"])
        new = segment.writer("cell")
        new.publish(struct.pack(">fh", 0.5, 3), cycle=11)
        view = reader.wait("cell", after=last, timeout_s=20)
        assert view is not None
        assert (view["count"], view.cycle) == (3, 11)
        assert reader.wait("cell", after=view, timeout_s=0) is None


def test_the_new_block_wakes_a_waiting_reader(segment: Segment) -> None:
    segment.writer("cell").publish(b"\0\1", cycle=1)
    views: list[View | None] = []
    with shmio.attach(segment.instance) as reader:
        waiter = threading.Thread(target=lambda: views.append(reader.wait("cell", timeout_s=60)))
        waiter.start()
        segment.change(add=[spec("cell", NEW)], retire=["cell"])
        writer = segment.writer("cell")
        cycle = 1
        while waiter.is_alive():
            writer.publish(struct.pack(">fh", 0.5, 4), cycle=(cycle := cycle + 1))
            waiter.join(0.01)
    assert views
    assert views[0] is not None
    assert views[0]["count"] == 4


def test_a_refresh_waits_for_that_of_another_thread(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    with Segment.open(segment.instance) as reader:
        segment.change(add=[spec("robot")])
        reads, go_on, seen = threading.Event(), threading.Event(), list[set[str]]()
        read_block = sections.read_block

        def slow(*arguments: Any) -> Block:
            reads.set()
            go_on.wait()
            return read_block(*arguments)

        def look() -> None:
            reader.refresh()
            seen.append(set(reader.blocks))

        monkeypatch.setattr("shmio.segment.segment.read_block", slow)
        first, second = (threading.Thread(target=look) for _ in range(2))
        first.start()
        reads.wait()
        second.start()
        second.join(0.2)  # without a wait it would have finished by then
        go_on.set()
        first.join()
        second.join()
        assert seen == [{"cell", "press", "robot"}] * 2
