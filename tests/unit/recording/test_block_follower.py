"""A block follower reads the same entries in the same order, one at a time or in runs."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.fabric.messages import Entry, decode_entries
from shmio.layout.model import Layout, Register
from shmio.recording.block_follower import BlockFollower
from shmio.recording.format.encoding import BlockPosition, Gap, Reason
from shmio.segment import Attributes, BlockSpec, BlockWriter, Event, EventKind, Frame, Quality, Record, Segment

LAYOUT = Layout("DB1", 1, 4, False, (Register("count", "INT", (), 0, None, 2, 1),))


def follower(segment: Segment) -> BlockFollower:
    return BlockFollower(segment.blocks["cell"], 1, BlockPosition(), Reason.NOT_RUNNING, segment.header.started_utc_ns)


def publish(writer: BlockWriter, action: str, cycle: int) -> None:
    if action == "event":
        writer.event(Record(EventKind.NOTED, f"at {cycle}"))
    elif action == "flood":  # the ring overwrites what was not read
        for _ in range(writer.block.ring.slot_count + 3):
            writer.publish(bytes(4), cycle=cycle)
    else:
        writer.publish(bytes(4), cycle=cycle, quality=Quality.BAD if action == "bad" else Quality.GOOD)


def in_runs(of: BlockFollower, limit: int, *, growing: bool = False) -> Iterator[Entry]:
    """Yield all entries that are there, as the uplink of the fabric reads them.

    ``growing`` says that other threads add entries meanwhile.
    """
    while True:
        if run := of.pack(limit):
            yield from decode_entries(bytes(run), 0)
            assert growing or of.behind or not of.pack(limit)
            continue
        taken = [item for _, _, item in of.take(limit)]
        yield from taken
        if not taken:
            return


@given(
    st.lists(st.sampled_from(["good", "good", "good", "bad", "event", "flood", "read", "read one"]), max_size=40),
    st.integers(1, 5),
)
def test_packed_entries_are_those_that_take_returns(actions: list[str], limit: int) -> None:
    block = BlockSpec("cell", LAYOUT, 20_000_000, 500_000_000, 1 << 16, Attributes("s7", ()))
    with Segment.create(f"followed{os.getpid()}", [block], []) as segment:
        try:
            writer = segment.writer("cell")
            one, other = follower(segment), follower(segment)
            expected: list[Entry] = []
            found: list[Entry] = []
            for cycle, action in enumerate([*actions, "read"]):
                if action == "read one":
                    expected += [item for _, _, item in one.take(1)]
                    found += [item for _, _, item in other.take(1)]
                elif action == "read":
                    expected += [item for _, _, item in one.take(1 << 20)]
                    found += in_runs(other, limit)
                else:
                    publish(writer, action, cycle)
            assert found == expected
            assert other.last == one.last == segment.blocks["cell"].ring.head()
            frames = sum(gap.count for gap in found if isinstance(gap, Gap) and gap.what == "frames")
            assert frames + sum(hasattr(entry, "raw") for entry in found) == one.last
        finally:
            segment.unlink()


def test_good_frames_are_packed() -> None:
    block = BlockSpec("cell", LAYOUT, 20_000_000, 500_000_000, 1 << 16, Attributes("s7", ()))
    with Segment.private("followed", [block], []) as segment:
        writer, other = segment.writer("cell"), follower(segment)
        other.take(1)  # the event that the source has started
        for cycle in range(5):
            publish(writer, "good", cycle)
        assert [len(list(decode_entries(bytes(other.pack(3)), 0))) for _ in range(3)] == [3, 2, 0]


def test_a_gap_after_packed_frames_is_one_after_taken_frames() -> None:
    block = BlockSpec("cell", LAYOUT, 20_000_000, 500_000_000, 1 << 16, Attributes("s7", ()))
    with Segment.create(f"followed{os.getpid()}", [block], []) as segment:
        try:
            writer = segment.writer("cell")
            one, other = follower(segment), follower(segment)
            assert one.take(1)[0].item == other.take(1)[0].item  # the event that the source has started
            publish(writer, "good", 1)
            assert [item for _, _, item in one.take(1)] == list(decode_entries(bytes(other.pack(1)), 0))
            publish(writer, "flood", 2)
            taken, after_packed = one.take(1)[0], other.take(1)[0]
            assert isinstance(taken.item, Gap)
            assert (after_packed.log_ns, after_packed.item) == (taken.log_ns, taken.item)
        finally:
            segment.unlink()


@pytest.fixture
def interleaved() -> Iterator[None]:
    """Let threads take turns after a few instructions."""
    usual_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(usual_s)


@pytest.mark.usefixtures("interleaved")
@pytest.mark.parametrize(
    "read",
    [lambda of: in_runs(of, 4, growing=True), lambda of: [item for _, _, item in of.take(8)]],
    ids=["runs", "take"],
)
def test_events_of_other_threads_have_one_place_among_the_frames(
    read: Callable[[BlockFollower], Iterable[Entry]],
) -> None:
    """Each reader sees an event after the frames that were published before it, and before all others."""
    block = BlockSpec("cell", LAYOUT, 20_000_000, 500_000_000, 1 << 16, Attributes("s7", ()))
    with Segment.private("followed", [block], []) as segment:
        writer, of = segment.writer("cell"), follower(segment)
        last = {Frame: 0, Event: 0}

        def work(action: str) -> None:
            for _ in range(50):
                publish(writer, action, 1)

        for _ in range(20):
            threads = [threading.Thread(target=work, args=(action,)) for action in ("good", "event", "event")]
            for thread in threads:
                thread.start()
            while any(thread.is_alive() for thread in threads) or of.behind:
                for item in read(of):
                    assert isinstance(item, Frame | Event)
                    last[type(item)] += 1
                    frames, events = (item.number, item.event) if isinstance(item, Frame) else (item.frame, item.number)
                    assert (frames, events) == (last[Frame], last[Event])
        assert last == {Frame: 1000, Event: 2001}
