"""Values diverted to injections: through chains of injections, and to programs as a stream."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import msgspec
import pytest

import shmio
from shmio.config import Declaration
from shmio.connectors.injection_layers import Owner
from shmio.errors import CommandError, PathError
from shmio.layout.values.codec import Value
from shmio.local.attach import Attachment
from shmio.local.injection import lift_all
from shmio.local.writer import SourceWriter
from shmio.segment import EventKind, Segment
from shmio.segment.injection_list import InjectionEntry, encode
from tests.unit.connectors import test_injections as test_injector
from tests.unit.connectors.test_injections import LAYOUT, Rig

segment = test_injector.segment
GUEST = 0
"""Number of the command queue of the only program outside the instance."""


@pytest.fixture
def rig(segment: Segment) -> Iterator[Rig]:
    rig = Rig(segment)
    rig.owners[GUEST] = Owner(GUEST, 300)
    yield rig
    rig.stop()


@pytest.fixture
def local(rig: Rig) -> Iterator[Attachment]:
    with shmio.attach(rig.segment.instance, writable=True) as local:
        yield local


def diverted_to(rig: Rig, number: int, until: EventKind) -> list[tuple[int, bytes]]:
    """Return (offset, data) of the writes diverted to an injection before the next event of a kind."""
    found = []
    while (event := rig.events.next(20)) is None or event.kind != until:
        assert event is not None
        if event.kind == EventKind.DIVERTED and event.injection == number:
            found.append((event.offset, event.data))
    return found


SPEED = LAYOUT.registers[LAYOUT.by_path["speed"]].offset


def test_values_of_an_inner_injection_go_to_the_outer_one(rig: Rig) -> None:
    inner = rig.client.inject(["speed", "axis"])
    rig.client.shadow(inner, {"speed": 5})
    outer = rig.other.inject(["speed", "position"])
    assert diverted_to(rig, inner, EventKind.INJECTED) == []
    assert diverted_to(rig, outer, EventKind.INJECTED) == [(SPEED, b"\5\0")], "the value at the time of the injection"
    rig.client.shadow(inner, {"speed": 6, "axis/1": 7})
    assert diverted_to(rig, outer, EventKind.SHADOWED) == [(SPEED, b"\6\0")]
    assert (rig.value("speed"), rig.value("axis/1")) == (5, 7), "consumers see the outer injection's value"
    rig.other.shadow(outer, {"speed": 8})
    assert rig.value("speed") == 8
    rig.other.lift(outer)
    assert rig.value("speed") == 6


def test_injection_below_another_starts_with_the_current_value(rig: Rig) -> None:
    rig.client.write({"speed": 3})
    rig.sees({"speed": 3})
    outer = rig.client.inject(["speed"], priority=1)
    rig.client.shadow(outer, {"speed": 100})
    inner = rig.other.inject(["speed"])
    assert diverted_to(rig, outer, EventKind.INJECTED) == []
    assert diverted_to(rig, outer, EventKind.INJECTED) == [(SPEED, b"\3\0")], (
        "the value below, not the outer injection's own"
    )
    innermost = rig.other.inject(["speed"], priority=-1)
    rig.other.shadow(innermost, {"speed": 4})
    rig.other.lift(inner)
    found = diverted_to(rig, outer, EventKind.LIFTED)
    assert found[-1] == (SPEED, b"\4\0")
    rig.other.lift(innermost)
    assert diverted_to(rig, outer, EventKind.LIFTED) == [], "the value below comes from the device again"
    assert rig.value("speed") == 100


def test_values_of_a_declared_injection_go_to_the_outer_one(rig: Rig, local: Attachment) -> None:
    rig.client.write({"speed": 3})
    rig.sees({"speed": 3})
    with local.inject("cell/speed", "cell/position", priority=1) as outer:
        stream = outer.diverted(timeout_s=20)
        drift = msgspec.convert(
            {"name": "drift", "target": "cell/speed", "operation": "offset", "value": 100}, Declaration
        )
        declared = rig.client.declare(drift)
        assert next(stream).values == {"speed": 103}, "from its first active cycle on"
        rig.client.write({"speed": 4})
        assert next(stream).values == {"speed": 104}
        inner = rig.other.inject(["speed"], priority=-1)
        rig.other.shadow(inner, {"speed": 7})
        assert any(one.values == {"speed": 107} for one in stream), "the value of the inner injection plus the offset"
        rig.client.lift(declared)
        assert any(one.values == {"speed": 7} for one in stream)


def test_values_of_a_redeclared_injection_are_diverted_again(rig: Rig, local: Attachment) -> None:
    rig.client.write({"speed": 3})
    rig.sees({"speed": 3})
    with local.inject("cell/speed", priority=1) as outer:
        stream = outer.diverted(timeout_s=20)
        drift = msgspec.convert(
            {"name": "drift", "target": "cell/speed", "operation": "offset", "value": 100}, Declaration
        )
        for _ in range(2):
            declared = rig.client.declare(drift)
            assert any(one.values == {"speed": 103} for one in stream)
            rig.client.lift(declared)
            rig.event(EventKind.LIFTED)


def test_inner_value_is_diverted_when_a_declared_injection_becomes_inactive(rig: Rig, local: Attachment) -> None:
    drift = {"name": "drift", "target": "cell/speed", "operation": "offset", "value": 100, "when": "cell/axis/1 > 0"}
    rig.client.declare(msgspec.convert(drift, Declaration))
    inner = rig.other.inject(["speed"], priority=-1)
    rig.other.shadow(inner, {"speed": 7})
    with local.inject("cell/speed", priority=1) as outer:
        stream = outer.diverted(timeout_s=20)
        assert next(stream).values == {"speed": 7}
        rig.client.write({"axis/1": 1})
        assert next(stream).values == {"speed": 107}
        rig.client.write({"axis/1": 0})
        assert next(stream).values == {"speed": 7}


def test_program_gets_diverted_writes_command_by_command(rig: Rig, local: Attachment) -> None:
    with local.inject("cell/speed/in", "cell/axis/in", "cell/lamps/2/in") as shadow:
        lamps = [place in (2, 3) for place in range(10)]
        rig.client.write({"speed": 20})
        rig.client.write({"axis/1": 1, "axis/2": 2, "lamps": lamps})
        rig.client.write({"speed": 20})
        stream = shadow.diverted(timeout_s=20)
        written: list[dict[str, Value]] = [dict(next(stream).values) for _ in range(3)]
        assert written == [{"speed": 20}, {"axis/1": 1, "axis/2": 2, "lamps/2": True}, {"speed": 20}]
        shadow.set({"cell/speed": 21})
        rig.sees({"speed": 21})
        rig.client.write({"speed": 22})
        one = next(shadow.diverted(timeout_s=20))
        assert (one.values, one.writer, one.missed) == ({"speed": 22}, 4, 0)
        assert one.clock_ns > 0
        assert list(shadow.diverted(timeout_s=0.01)) == []
    assert list(shadow.diverted()) == [], "the stream ends when the shadow is lifted"


def test_whole_arrays_and_single_elements_are_diverted(rig: Rig, local: Attachment) -> None:
    with local.inject("cell/lamps/in") as shadow:
        rig.client.write({"lamps": [True] * 10})
        rig.client.write({"lamps/0": False})
        stream = shadow.diverted(timeout_s=20)
        assert next(stream).values == {"lamps": [True] * 10}
        assert next(stream).values == {"lamps/0": False}


def test_stream_of_diverted_values_counts_missed_events(rig: Rig, local: Attachment) -> None:
    with local.inject("cell/speed/in") as shadow:
        stream = shadow.diverted(timeout_s=20)
        rig.client.write({"speed": 1})
        assert next(stream).missed == 0
        head = rig.block.events.head()
        while rig.block.events.head() < head + rig.block.events.ring.slot_count:
            rig.client.shadow(1, {"speed": 1})  # refused: there is no such injection
        rig.client.write({"speed": 2})
        one = next(stream)
        assert one.values == {"speed": 2}
        assert one.missed > 0


def test_lift_all_lifts_the_injections_of_all_clients(rig: Rig, local: Attachment) -> None:
    numbers = {rig.client.inject(["speed"]), rig.other.inject(["axis"], keep=True)}
    kept = local.inject("cell/lamps", keep=True)
    lifted = local.lift_all()
    assert {one.number for one in lifted} == numbers | {kept.number}
    assert {one.source for one in lifted} == {"cell"}
    assert local.injections() == []
    assert local.lift_all() == []


def test_an_injection_whose_block_a_reload_has_retired_is_lifted(rig: Rig) -> None:
    """The list of the retired block still has it, but nobody answers there."""
    number = rig.client.inject(["speed"])
    rig.stop()
    rig.segment.change(retire=["cell"])
    assert [one.number for one in rig.block.injections.read()] == [number]
    lift_all([(SourceWriter(rig.block, GUEST), number)])


def test_campaign_ends_even_if_its_reader_missed_the_end(rig: Rig, local: Attachment) -> None:
    with local.declare([{"name": "stuck", "target": "cell/speed", "operation": "set", "value": 5}]) as campaign:
        local.lift_all()
        head = rig.block.events.head()
        while rig.block.events.head() <= head + rig.block.events.ring.slot_count:
            rig.client.shadow(9999, {"speed": 1})  # refused: there is no such injection
        waiting = threading.Timer(20, campaign.end)  # so that a failing test ends
        waiting.start()
        happened = list(campaign)
        assert waiting.is_alive(), "the campaign has ended by itself"
        waiting.cancel()
        waiting.join()
    assert happened == []


def test_injection_that_cannot_be_lifted_is_named(rig: Rig, local: Attachment) -> None:
    one = InjectionEntry(5, "out", 0, keep=True, name="", writer=0, pid=0, ranges=())
    rig.block.injections.write(encode([msgspec.json.encode(one)]))  # the source does not know this injection
    with pytest.raises(CommandError, match="1 of 1 injections were not lifted: cell: there is no injection 5"):
        local.lift_all()
    rig.block.injections.write(encode([]))


def test_program_follows_writes_toward_a_source(rig: Rig, local: Attachment) -> None:
    stream = local.written("cell/speed", "cell/lamps/2/in", timeout_s=20)
    rig.client.write({"speed": 20, "axis/1": 1})
    rig.client.write({"axis/1": 2})
    rig.other.write({"lamps": [True] * 10})
    with local.inject("cell/speed/in") as shadow:
        rig.client.write({"speed": 30})  # the injection takes it
        shadow.set({"cell/speed": 31})
    rig.client.write({"speed": 20})
    found = [next(stream) for _ in range(4)]
    assert [one.values for one in found] == [{"speed": 20}, {"lamps/2": True}, {"speed": 31}, {"speed": 20}]
    assert [one.writer for one in found] == [4, 5, GUEST, 4]
    assert list(local.written("cell", timeout_s=0.01)) == []


def test_following_an_invalid_path_is_refused(rig: Rig, local: Attachment) -> None:
    for wrong in ("cell/nothing", "cell/speed/out", "nobody/x"):
        with pytest.raises(PathError):
            local.written(wrong)
