"""What goes to injections, and what programs see of it: chains of them, and the stream of what was diverted."""

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
from shmio.segment import EventKind, Segment
from shmio.segment.standing_injections import StandingInjection, encode
from tests.unit.connectors import test_injections as test_injector
from tests.unit.connectors.test_injections import LAYOUT, Rig

segment = test_injector.segment
GUEST = 0
"""The command queue of the only program from outside."""


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


def beneath(rig: Rig, number: int, until: EventKind) -> list[tuple[int, bytes]]:
    """(offset, data) of all that is diverted to an injection until an event of this kind."""
    found = []
    while (event := rig.events.next(20)) is None or event.kind != until:
        assert event is not None
        if event.kind == EventKind.DIVERTED and event.injection == number:
            found.append((event.offset, event.data))
    return found


SPEED = LAYOUT.registers[LAYOUT.by_path["speed"]].offset


def test_what_an_inner_injection_gives_goes_to_the_one_further_out(rig: Rig) -> None:
    inner = rig.client.inject(["speed", "axis"])
    rig.client.shadow(inner, {"speed": 5})
    outer = rig.other.inject(["speed", "position"])
    assert beneath(rig, inner, EventKind.INJECTED) == []
    assert beneath(rig, outer, EventKind.INJECTED) == [(SPEED, b"\5\0")], "what it finds there"
    rig.client.shadow(inner, {"speed": 6, "axis/1": 7})
    assert beneath(rig, outer, EventKind.SHADOWED) == [(SPEED, b"\6\0")]
    assert (rig.value("speed"), rig.value("axis/1")) == (5, 7), "consumers hold the outer one's value"
    rig.other.shadow(outer, {"speed": 8})
    assert rig.value("speed") == 8
    rig.other.lift(outer)
    assert rig.value("speed") == 6


def test_one_that_is_laid_beneath_another_finds_what_is_there(rig: Rig) -> None:
    rig.client.write({"speed": 3})
    rig.sees({"speed": 3})
    outer = rig.client.inject(["speed"], priority=1)
    rig.client.shadow(outer, {"speed": 100})
    inner = rig.other.inject(["speed"])
    assert beneath(rig, outer, EventKind.INJECTED) == []
    assert beneath(rig, outer, EventKind.INJECTED) == [(SPEED, b"\3\0")], "not the outer one's own value"
    innermost = rig.other.inject(["speed"], priority=-1)
    rig.other.shadow(innermost, {"speed": 4})
    rig.other.lift(inner)
    found = beneath(rig, outer, EventKind.LIFTED)
    assert found[-1] == (SPEED, b"\4\0")
    rig.other.lift(innermost)
    assert beneath(rig, outer, EventKind.LIFTED) == [], "it is the device's again"
    assert rig.value("speed") == 100


def test_what_a_declared_one_computes_goes_to_the_one_further_out(rig: Rig, local: Attachment) -> None:
    rig.client.write({"speed": 3})
    rig.sees({"speed": 3})
    with local.inject("cell/speed", "cell/position", priority=1) as outer:
        stream = outer.diverted(timeout_s=20)
        drift = msgspec.convert(
            {"name": "drift", "target": "cell/speed", "operation": "offset", "value": 100}, Declaration
        )
        declared = rig.client.declare(drift)
        assert next(stream).values == {"speed": 103}, "from the cycle on in which it is active"
        rig.client.write({"speed": 4})
        assert next(stream).values == {"speed": 104}
        inner = rig.other.inject(["speed"], priority=-1)
        rig.other.shadow(inner, {"speed": 7})
        assert any(one.values == {"speed": 107} for one in stream), "what it makes of what an inner one gives"
        rig.client.lift(declared)
        assert any(one.values == {"speed": 7} for one in stream)


def test_what_a_declared_one_computes_is_told_again_when_it_is_declared_again(rig: Rig, local: Attachment) -> None:
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


def test_what_others_give_is_told_when_a_declared_one_between_becomes_inactive(rig: Rig, local: Attachment) -> None:
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


def test_a_program_gets_what_others_write_command_by_command(rig: Rig, local: Attachment) -> None:
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
    assert list(shadow.diverted()) == [], "it has an end when the shadow is lifted"


def test_whole_arrays_and_what_is_longer_than_an_event(rig: Rig, local: Attachment) -> None:
    with local.inject("cell/lamps/in") as shadow:
        rig.client.write({"lamps": [True] * 10})
        rig.client.write({"lamps/0": False})
        stream = shadow.diverted(timeout_s=20)
        assert next(stream).values == {"lamps": [True] * 10}
        assert next(stream).values == {"lamps/0": False}


def test_a_program_is_told_how_much_it_missed(rig: Rig, local: Attachment) -> None:
    with local.inject("cell/speed/in") as shadow:
        stream = shadow.diverted(timeout_s=20)
        rig.client.write({"speed": 1})
        assert next(stream).missed == 0
        head = rig.block.events.head()
        while rig.block.events.head() < head + rig.block.events.ring.slot_count:
            rig.client.shadow(1, {"speed": 1})  # there is no such injection
        rig.client.write({"speed": 2})
        one = next(stream)
        assert one.values == {"speed": 2}
        assert one.missed > 0


def test_all_injections_are_lifted_at_once_whoever_laid_them(rig: Rig, local: Attachment) -> None:
    numbers = {rig.client.inject(["speed"]), rig.other.inject(["axis"], keep=True)}
    kept = local.inject("cell/lamps", keep=True)
    lifted = local.lift_all()
    assert {one.number for one in lifted} == numbers | {kept.number}
    assert {one.source for one in lifted} == {"cell"}
    assert local.injections() == []
    assert local.lift_all() == []


def test_a_campaign_ends_although_its_reader_has_missed_the_end(rig: Rig, local: Attachment) -> None:
    with local.declare([{"name": "stuck", "target": "cell/speed", "operation": "set", "value": 5}]) as campaign:
        local.lift_all()
        head = rig.block.events.head()
        while rig.block.events.head() <= head + rig.block.events.ring.slot_count:
            rig.client.shadow(9999, {"speed": 1})  # there is no such injection
        waiting = threading.Timer(20, campaign.end)  # so that a failure does not wait for ever
        waiting.start()
        happened = list(campaign)
        assert waiting.is_alive(), "it has ended by itself"
        waiting.cancel()
        waiting.join()
    assert happened == []


def test_what_cannot_be_lifted_is_named(rig: Rig, local: Attachment) -> None:
    one = StandingInjection(5, "out", 0, keep=True, name="", writer=0, pid=0, ranges=())
    rig.block.standing.write(encode([msgspec.json.encode(one)]))  # of which the source knows nothing
    with pytest.raises(CommandError, match="1 of 1 injections were not lifted: cell: there is no injection 5"):
        local.lift_all()
    rig.block.standing.write(encode([]))


def test_a_program_follows_what_is_written_toward_a_source(rig: Rig, local: Attachment) -> None:
    stream = local.written("cell/speed", "cell/lamps/2/in", timeout_s=20)
    rig.client.write({"speed": 20, "axis/1": 1})
    rig.client.write({"axis/1": 2})
    rig.other.write({"lamps": [True] * 10})
    with local.inject("cell/speed/in") as shadow:
        rig.client.write({"speed": 30})  # it does not get that far
        shadow.set({"cell/speed": 31})
    rig.client.write({"speed": 20})
    found = [next(stream) for _ in range(4)]
    assert [one.values for one in found] == [{"speed": 20}, {"lamps/2": True}, {"speed": 31}, {"speed": 20}]
    assert [one.writer for one in found] == [4, 5, GUEST, 4]
    assert list(local.written("cell", timeout_s=0.01)) == []


def test_what_cannot_be_followed(rig: Rig, local: Attachment) -> None:
    for wrong in ("cell/nothing", "cell/speed/out", "nobody/x"):
        with pytest.raises(PathError):
            local.written(wrong)
