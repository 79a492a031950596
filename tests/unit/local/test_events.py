"""The events of a local instance: their fields, and what happens at losses, restarts and reloads."""

from __future__ import annotations

import gc
import json
import threading
from collections.abc import Iterator
from itertools import pairwise

import pytest

from shmio.errors import NotRunningError, PathError
from shmio.layout.model import Layout, Register
from shmio.local.attach import Attachment, attach
from shmio.local.events import MAX_PATHS
from shmio.model.event import EventKind
from shmio.model.values import Quality
from shmio.segment import BlockSpec, Segment
from shmio.segment import EventKind as Recorded
from shmio.segment.events import EVENT_DATA_SIZE, EVENT_SLOTS, Record

LAYOUT = Layout("DB1", 1, 4, False, (Register("a", "INT", (), 0, None, 2, 1), Register("b", "INT", (), 2, None, 2, 1)))
MANY = Layout("DB2", 2, 4096, False, tuple(Register(f"r{at}", "BYTE", (), at, None, 1, 1) for at in range(4096)))
LONG_NS = 3600 * 10**9
NOTE = Record(Recorded.NOTED, "here", 2, 5)


def spec(source: str, layout: Layout = LAYOUT) -> BlockSpec:
    return BlockSpec(source, layout, 20_000_000, LONG_NS, 1 << 16)


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    with Segment.create(instance, [spec("cell"), spec("press")], []) as segment:
        yield segment
        segment.unlink()


@pytest.fixture
def cell(segment: Segment) -> Iterator[Attachment]:
    with attach(segment.instance) as cell:
        yield cell


def test_the_kinds_are_those_of_the_segment() -> None:
    own = {EventKind.REMOVED, EventKind.OTHER}
    assert {kind.value for kind in EventKind} - own == {str(kind) for kind in Recorded}
    assert all(kind.value == kind.name.lower() for kind in EventKind)


def test_event_has_all_its_fields(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    writer.publish(bytes(4), cycle=3)
    with cell.events() as events:
        writer.cycle = 4
        number = writer.event(Record(Recorded.ACCEPTED, "", 3, 7, 0, 1, 2, 0, 2, b"\1\2"))
        writer.event(Record(Recorded.REFUSED, "read-only", 3, 7, 0, 1, 2, 0, 2))
        writer.event(Record(Recorded.QUALITY, "cable out"), quality=Quality.BAD)
        writer.event(NOTE)
        accepted, refused, quality, noted = (next(events) for _ in range(4))
    recorded = writer.block.events.read(number)
    assert recorded is not None
    assert (accepted.source, accepted.kind, accepted.number) == ("cell", "accepted", number)
    assert (accepted.frame, accepted.cycle, accepted.incarnation, accepted.missed) == (1, 4, writer.incarnation, 0)
    assert (accepted.clock_ns, accepted.utc_ns) == (recorded.clock_ns, recorded.utc_ns)
    assert (accepted.by, accepted.command, accepted.direction) == ("program 4", 7, "in")
    assert (accepted.paths, accepted.values) == (("cell/b",), {"cell/b": 0x102})
    assert (refused.kind, refused.text, refused.command) == (EventKind.REFUSED, "read-only", 7)
    assert (refused.paths, refused.values) == (("cell/b",), {})
    assert (quality.kind, quality.quality, quality.text, quality.by) == ("quality", Quality.BAD, "cable out", "")
    assert (noted.kind, noted.text, noted.by, noted.paths) == (EventKind.NOTED, "here", "program 3", ())


def test_event_says_who_caused_it(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    by, how = "web: anonymous (127.0.0.1)", b'{"direction":"out","ranges":[[0,2,255]]}'
    with cell.events() as events:
        writer.event(Record(Recorded.ACCEPTED, "", 0, 7, 0, 1, 2, 0, 2, b"\1\2", by=by))
        writer.event(Record(Recorded.WRITTEN, "", 0, 7, 0, 1, 2, 0, 2, by=by))
        writer.event(Record(Recorded.INJECTED, "n", 0, 9, 0, 1, 0, 0, len(how), how, 9, by))
        writer.event(Record(Recorded.LIFTED, "the injection's client has ended", 0, 9, 0, 1, injection=9))
        writer.event(Record(Recorded.NOTED, "here", 0, 10))
        found = [next(events) for _ in range(5)]
    assert [(event.by, event.text) for event in found] == [
        (by, ""),
        (by, ""),
        (by, "n"),
        (by, "the injection's client has ended"),
        ("program 1", "here"),
    ]
    assert (found[0].values, found[2].paths) == ({"cell/b": 0x102}, ("cell/a",))


def test_injection_from_before_the_stream_is_known(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    entry = {"id": 9, "direction": "in", "priority": 0, "keep": False, "name": "n", "writer": 0, "pid": 1}
    writer.block.injections.write(json.dumps([entry | {"ranges": [[0, 2, 255]]}]).encode())
    with cell.events("cell") as events:
        writer.event(Record(Recorded.LIFTED, "lifted", injection=9))
        lifted = next(events)
    assert (lifted.injection, lifted.direction, lifted.paths) == (9, "in", ("cell/a",))


def test_a_long_definition_of_an_injection_is_one_event(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    how = json.dumps({"direction": "out", "ranges": [[0, 1, 1]] * 80 + [[2, 2, 255]]}).encode()
    assert len(how) > 2 * EVENT_DATA_SIZE
    with cell.events("cell") as events:
        for at in range(0, len(how), EVENT_DATA_SIZE):
            part = how[at : at + EVENT_DATA_SIZE]
            writer.event(Record(Recorded.INJECTED, "n", 0, 4, 0, 1, at, 0, len(part), part, 4))
        writer.event(NOTE)
        laid = next(events)
        assert (laid.kind, laid.injection, laid.text, laid.direction) == ("injected", 4, "n", "out")
        assert laid.paths == ("cell/a.%X8", "cell/b")
        noted = next(events)
        assert (noted.kind, noted.missed) == ("noted", 0)


def test_an_event_names_a_bounded_number_of_registers(segment: Segment, cell: Attachment) -> None:
    segment.change(add=[spec("many", MANY)])
    writer = segment.writer("many")
    how = json.dumps({"direction": "out", "ranges": [[0, 4096, 255]]}).encode()
    with cell.events("many") as events:
        writer.event(Record(Recorded.INJECTED, "all", 0, 4, 0, 1, 0, 0, len(how), how, 4))
        assert len(next(events).paths) == MAX_PATHS


def test_the_outcome_of_many_items_names_a_bounded_number_of_registers(segment: Segment, cell: Attachment) -> None:
    segment.change(add=[spec("many", MANY)])
    writer = segment.writer("many")
    with cell.events("many") as events:
        for item in range(MAX_PATHS + 500):
            writer.event(Record(Recorded.ACCEPTED, "", 3, 7, item, 1, item, 0, 1, b"\1"))
            next(events)
        writer.event(Record(Recorded.WRITTEN, "", 3, 7, 0, MAX_PATHS + 500, 0, 0, 1))
        paths = next(events).paths
    assert paths == tuple(f"many/r{at}" for at in range(MAX_PATHS))
    assert not events._readers[0]._explainer._in_flight


def test_the_outcome_of_a_long_item_names_a_bounded_number_of_registers(segment: Segment, cell: Attachment) -> None:
    segment.change(add=[spec("many", MANY)])
    writer = segment.writer("many")
    with cell.events("many") as events:
        for at in range(0, 4096, EVENT_DATA_SIZE):
            writer.event(Record(Recorded.ACCEPTED, "", 3, 7, 0, 1, at, 0, EVENT_DATA_SIZE, bytes(EVENT_DATA_SIZE)))
            next(events)
        ((known,),) = (items.values() for items in events._readers[0]._explainer._in_flight.values())
        assert len(known) == MAX_PATHS
        assert not any(place.valued for place in known)
        writer.event(Record(Recorded.WRITTEN, "", 3, 7, 0, 1, 0, 0, 4096))
        assert len(next(events).paths) == MAX_PATHS


def test_command_whose_outcome_is_lost_is_forgotten(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    with cell.events("cell") as events:
        writer.event(Record(Recorded.ACCEPTED, "", 3, 7, 0, 1, 2, 0, 2, b"\1\2"))
        next(events)
        in_flight = events._readers[0]._explainer._in_flight
        assert in_flight
        for _ in range(EVENT_SLOTS + 100):
            writer.event(NOTE)
        assert next(events).missed
        assert not in_flight


def test_command_of_an_earlier_process_is_forgotten(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    with cell.events("cell") as events:
        writer.event(Record(Recorded.ACCEPTED, "", 3, 7, 0, 1, 2, 0, 2, b"\1\2"))
        segment.writer("cell")
        assert [next(events).kind for _ in range(2)] == ["accepted", "started"]
        assert not events._readers[0]._explainer._in_flight


def test_an_injection_whose_end_is_lost_is_forgotten(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    how = json.dumps({"direction": "in", "ranges": [[0, 2, 255]]}).encode()
    entry = {"id": 9, "direction": "in", "priority": 0, "keep": False, "name": "n", "writer": 0, "pid": 1}
    with cell.events("cell") as events:
        for number in (7, 8, 9):
            writer.event(Record(Recorded.INJECTED, "n", 0, number, 0, 1, 0, 0, len(how), how, number))
            next(events)
        for _ in range(EVENT_SLOTS + 100):
            writer.event(NOTE)
        writer.event(Record(Recorded.LIFTED, "lifted", injection=8))
        writer.block.injections.write(json.dumps([entry | {"ranges": [[0, 2, 255]]}]).encode())
        newest = writer.block.events.head()
        assert next(events).missed
        while (event := next(events)).number < newest:
            pass
        assert (event.kind, event.injection, event.paths) == ("lifted", 8, ("cell/a",)), (
            "the event of its end is not lost, and names its register"
        )
        writer.event(NOTE)
        next(events)
        assert set(events._readers[0]._explainer._injections) == {9}


def test_event_of_an_unknown_kind_is_other(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    with cell.events("cell") as events:
        writer.event(NOTE._replace(kind=99))  # type: ignore[arg-type]
        assert next(events).kind is EventKind.OTHER


def test_events_that_the_ring_lost_are_counted(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    with cell.events("cell") as events:
        first = writer.event(NOTE)
        assert next(events).number == first
        for _ in range(EVENT_SLOTS + 100):
            writer.event(NOTE)
        event = next(events)
        assert event.missed >= 100
        assert event.number == first + 1 + event.missed
        rest = [next(events) for _ in range(first + EVENT_SLOTS + 100 - event.number)]
    assert {one.missed for one in rest} == {0}
    assert rest[-1].number == first + EVENT_SLOTS + 100


def test_sources_take_turns_and_each_is_in_order(segment: Segment, cell: Attachment) -> None:
    writers = [segment.writer(source) for source in ("cell", "press")]
    with cell.events("cell", "press", "cell") as events:
        for _ in range(4):
            for writer in writers:
                writer.event(NOTE)
        found = [next(events) for _ in range(8)]
    assert {one.source for one in found[:2]} == {"cell", "press"}
    for source in ("cell", "press"):
        assert all(new.number == old.number + 1 for old, new in pairwise([e for e in found if e.source == source]))


def test_restart_of_the_source_gives_stopped_and_started(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    with cell.events("cell") as events:
        writer.event(Record(Recorded.STOPPED, "told to"))
        again = segment.writer("cell")
        again.event(NOTE)
        found = [next(events) for _ in range(3)]
    assert [(one.kind, one.incarnation) for one in found] == [
        ("stopped", writer.incarnation),
        ("started", again.incarnation),
        ("noted", again.incarnation),
    ]
    assert again.incarnation == writer.incarnation + 1


def test_reload_continues_with_the_new_block_and_reports_a_removed_source(segment: Segment, cell: Attachment) -> None:
    for source in ("cell", "press"):
        segment.writer(source)
    with cell.events("cell", "press") as events:
        old = segment.writer("cell")
        old.event(NOTE._replace(text="last words"))
        segment.change(add=[spec("cell")], retire=["cell", "press"])
        segment.writer("cell").event(NOTE._replace(text="new"))
        found = [next(events) for _ in range(5)]
        own = [(one.kind, one.text if one.kind == "noted" else "") for one in found if one.source == "cell"]
        assert own == [("started", ""), ("noted", "last words"), ("started", ""), ("noted", "new")]
        (gone,) = [one for one in found if one.source == "press"]
        assert (gone.kind, gone.number, gone.quality) == (EventKind.REMOVED, 0, Quality.BAD)
        assert gone.text == f"source 'press' was removed from instance {segment.instance!r} by a reload"


def test_incomplete_reload_repeats_no_event(segment: Segment, cell: Attachment) -> None:
    segment.writer("cell").event(NOTE)
    with cell.events("cell") as events:
        blocks, old = events._blocks, events._readers[0].block
        segment.change(retire=["cell"])
        events._blocks = lambda: {"cell": old}
        assert events._take() is None
        events._blocks = blocks
        assert next(events).kind is EventKind.REMOVED


def test_an_unknown_source_is_refused_at_once(cell: Attachment) -> None:
    with pytest.raises(PathError, match="unknown source 'nix'"):
        cell.events("cell", "nix")


def test_another_thread_may_close_the_stream(segment: Segment, cell: Attachment) -> None:
    events = cell.events()
    threading.Timer(0.05, events.close).start()
    assert list(events) == []
    assert list(events) == []


def test_closing_the_attachment_ends_the_stream(segment: Segment) -> None:
    with attach(segment.instance) as cell:
        events = cell.events()
    assert list(events) == []


def test_stopped_instance_ends_the_stream(instance: str) -> None:
    with Segment.create(instance, [spec("cell")], []) as segment, attach(instance) as cell:
        events = cell.events()
        segment.unlink()
        with pytest.raises(NotRunningError):
            next(events)


def test_an_iterator_that_is_dropped_leaves_no_thread(segment: Segment, cell: Attachment) -> None:
    events = cell.events("cell")
    segment.writer("cell")
    next(events)
    assert relays()
    del events
    gc.collect()
    assert not relays()


def relays() -> list[str]:
    """Return the names of the threads that wake iterators."""
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("following-")]
