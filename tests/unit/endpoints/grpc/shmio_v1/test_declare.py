"""Declare over real sockets: how a campaign creates injections, its events, and how it ends."""

from __future__ import annotations

import asyncio
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import grpc
import pytest

from shmio.client import Client, InjectionEvent, connect
from shmio.errors import CommandError, ValueRangeError
from shmio.injection import Program
from shmio.local.reading import View
from shmio.segment import EventKind, Segment
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.client.both import BOTH, Connect
from tests.unit.endpoints.grpc.services.test_publish import with_plant
from tests.unit.endpoints.grpc.shmio_v1.harness import stub
from tests.unit.endpoints.grpc.shmio_v1.test_injections import seen, with_client
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, refusal
from tests.unit.endpoints.plant import Plant
from tests.unit.endpoints.rude import NOISE

Status = grpc.StatusCode

OFFSET = {"name": "drift", "target": "cell/axis/position", "operation": "offset", "value": 2.5}
EVERY_OPERATION: list[dict[str, Any]] = [
    OFFSET,
    {"name": "set", "target": "cell/name", "operation": "set", "value": "ab"},
    {"name": "list", "target": "cell/inputs", "operation": "set", "value": [1, 2], "priority": -3},
    {"name": "scale", "target": ["cell/axis/speed", "cell/step"], "operation": "scale", "value": 3, "start_s": 1e6},
    {"name": "clamp", "target": "cell/step", "operation": "clamp", "max": 7.5, "end_s": 1e8, "probability": 0.5},
    {"name": "noise", "target": "cell/axis", "operation": "noise", "amplitude": 0.5, "distribution": "gaussian"},
    {"name": "choice", "target": "cell/step", "operation": "random", "values": [1, "2", 3], "seed": 2**62},
    {"name": "range", "target": "cell/step", "operation": "random", "min": -1.0, "max": 1.0},
    {"name": "freeze", "target": "cell/running", "operation": "freeze", "when": "cell/step > 5", "times": 2},
    {"name": "delay", "target": "cell/step", "operation": "delay", "delay_ms": 100.0},
    {"name": "cycles", "target": "cell/step/in", "operation": "delay", "delay_cycles": 3},
    {"name": "drop", "target": "cell/step/in", "operation": "drop", "when": "cell/running", "for_s": 0.5},
    {"name": "flip", "target": "cell/inputs/1", "operation": "flip", "bits": [0, 7]},
    {"name": "any-bit", "target": "cell/inputs/0", "operation": "flip"},
]


def until(campaign: Iterator[InjectionEvent], what: str) -> InjectionEvent:
    return next(one for one in campaign if one.what == what)


def test_every_operation_is_laid_as_declared(segment: Segment) -> None:
    def test(cell: Client, _: Plant, __: Endpoint) -> None:
        with cell.declare(EVERY_OPERATION) as campaign:
            assert [one.name for one in campaign.declared] == [one["name"] for one in EVERY_OPERATION]
            present = {one.number: one for one in cell.injections("cell")}
            for one, table in zip(campaign.declared, EVERY_OPERATION, strict=True):
                running = present[one.number].running
                assert running is not None
                assert running.declaration == table | {"seed": one.seed}
                assert running.seed == one.seed
                assert present[one.number].direction == ("in" if str(table["target"]).endswith("/in") else "out")
            injected = {one.number for one in campaign.declared}
            while injected:
                if (happened := next(campaign)).what == "injected":
                    injected.remove(happened.number)
        assert cell.injections() == []

    with_client(segment, test)


def test_originals_can_be_read_under_a_declared_injection(segment: Segment) -> None:
    def test(cell: Client, device: Plant, served: Endpoint) -> None:
        struct.pack_into(">f", device.memory, 0, 1.5)
        with cell.declare([OFFSET]):
            seen(cell, "cell/axis/position", 4.0)
            update = cell.read("cell/axis/*", originals=True).of("cell/axis/position")
            assert (update["axis/position"], update.original("axis/position")) == (4.0, 1.5)
            with cell.subscribe("cell", frames=True) as frames:
                both = next(frames)
            assert [struct.unpack_from(">f", image) for image in (both.image, both.raw)] == [(4.0,), (1.5,)]
            block = served.segment.blocks["cell"]
            frame = block.latest()
            assert frame is not None
            view = View(block, frame)
            assert (view["axis/position"], view.original("axis/position")) == (4.0, 1.5)

    with_client(segment, test)


def test_the_campaigns_events_say_what_happens_and_when(segment: Segment) -> None:
    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        struct.pack_into(">f", device.memory, 0, 1.5)
        with cell.declare([OFFSET | {"when": "cell/step > 5"}]) as campaign:
            (laid,) = campaign.declared
            injected = next(campaign)
            assert (injected.what, injected.source, injected.number) == ("injected", "cell", laid.number)
            device.memory[13] = 7
            activated = next(campaign)
            assert (activated.what, activated.run) == ("activated", 1)
            seen(cell, "cell/axis/position", 4.0)
            device.memory[13] = 0
            deactivated = next(campaign)
            assert (deactivated.what, deactivated.run, deactivated.text) == ("deactivated", 1, "")
            assert injected.frame <= activated.frame < deactivated.frame
            events = segment.blocks["cell"].events
            ours = [event for at in range(1, events.head() + 1) if (event := events.read(at)) and event.injection]
            assert [(one.what, one.clock_ns, one.utc_ns, one.cycle) for one in (injected, activated, deactivated)] == [
                (str(EventKind(event.kind)), event.clock_ns, event.utc_ns, event.cycle) for event in ours
            ]
            first = segment.blocks["cell"].read(activated.frame)
            assert first is not None
            assert struct.unpack_from(">f", first.image)[0] == 4.0
            cell.lift("cell", laid.number)
            lifted = next(campaign)
            assert (lifted.what, lifted.text) == ("lifted", "lifted")
            assert list(campaign) == []

    with_client(segment, test)


def test_a_campaign_ends_when_all_its_injections_are_over(segment: Segment) -> None:
    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        once = {"when": "cell/running", "times": 1}
        campaign = cell.declare([OFFSET | once, OFFSET | once | {"name": "other", "target": "cell/axis/speed"}])
        device.memory[8] = 8
        until(campaign, "activated")
        device.memory[8] = 0
        told = [(one.what, one.text) for one in campaign]
        assert told.count(("lifted", "over")) == 2
        assert cell.injections() == []
        campaign.close()

    with_client(segment, test)


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        (
            {"target": "cell/nothing"},
            ValueRangeError,
            r"injection\[1\]\.target: cell/nothing: DB1 has no such register",
        ),
        ({"target": "cell/name"}, ValueRangeError, r"injection\[1\]\.target: cell/name is STRING\[8\]"),
        ({"when": "cell/step >"}, ValueRangeError, r"injection\[1\]\.when: at character 12"),
        ({"end_s": 0.0}, ValueRangeError, r"injection\[1\]\.end_s"),
        ({"name": "drift"}, ValueRangeError, r"injection\[1\]\.name: 'drift' is already the name of injection\[0\]"),
        ({"probability": 2.0}, ValueRangeError, r"injection\[1\]\.probability"),
        ({"value": "x"}, ValueRangeError, r"injection\[1\]\.value: expected a number"),
        ({"value": None}, ValueRangeError, r"injection\[1\]\.value: this key is needed"),
        ({"amplitude": 1.0}, ValueRangeError, r"injection\[1\]\.amplitude: operation 'offset' has no such key"),
        ({"operation": "explode"}, ValueRangeError, r"injection\[1\]\.operation: unknown operation 'explode'"),
        ({"times": -1}, ValueRangeError, r"injection\[1\]"),
        ({"target": "cell/secret/in"}, CommandError, "not writable"),
    ],
)
def test_one_invalid_declaration_refuses_all(
    segment: Segment, wrong: dict[str, Any], error: type[Exception], message: str
) -> None:
    def test(cell: Client, _: Plant, __: Endpoint) -> None:
        with pytest.raises(error, match=message):
            cell.declare([OFFSET, OFFSET | {"name": "wrong"} | wrong])
        assert cell.injections() == []

    with_client(segment, test)


def test_a_dead_clients_injections_are_lifted_unless_kept(segment: Segment) -> None:
    def test(cell: Client, _: Plant, served: Endpoint) -> None:
        with connect(f"127.0.0.1:{served.port}", timeout_s=TIMEOUT_S) as other:
            other.declare([OFFSET])
            with other.declare([OFFSET | {"name": "kept"}], keep=True) as kept:
                pass
        (laid,) = kept.declared
        for _update in cell.subscribe("cell/axis", every_frame=True):
            if [one.number for one in cell.injections()] == [laid.number]:
                break
        cell.lift("cell", laid.number)
        assert cell.injections() == []

    with_client(segment, test)


def test_lift_all_lifts_a_campaign_and_its_events_say_so(segment: Segment) -> None:
    def test(cell: Client, _: Plant, __: Endpoint) -> None:
        with cell.declare([OFFSET, OFFSET | {"name": "second"}]) as campaign:
            assert len(cell.lift_all()) == 2
            assert [one.what for one in campaign if one.what != "activated"] == ["injected"] * 2 + ["lifted"] * 2

    with_client(segment, test)


def test_invalid_declarations_are_refused(segment: Segment) -> None:
    def declaration(**fields: Any) -> wire.Declaration:
        return wire.Declaration(name="x", targets=["cell/step"], **fields)

    wrong = [
        [],
        [wire.Declaration()],
        [declaration()],
        [declaration(set=wire.Value())],
        [declaration(noise=wire.Noise())],
        [declaration(noise=wire.Noise(amplitude=1, distribution=7))],  # type: ignore[arg-type]
        [declaration(clamp=wire.Clamp())],
        [declaration(random=wire.Random())],
        [declaration(delay=wire.Delay())],
        [declaration(flip=wire.Flip(bits=[99]))],
        [declaration(drop=wire.Drop(), seed=2**64 - 1)],
        [declaration(drop=wire.Drop(), when="\n")],
        [wire.Declaration(name="a/b", targets=["cell/step"], drop=wire.Drop())],
        [declaration(set=wire.Value(integer=1))] * 300,
    ]

    async def test(served: Endpoint, _: Plant) -> None:
        for declarations in wrong:
            call = stub(served).Declare(wire.DeclareRequest(declarations=declarations), timeout=TIMEOUT_S)
            assert (await refusal(call.read()))[0] is Status.INVALID_ARGUMENT, declarations
        listed: Any = await stub(served).ListInjections(wire.ListInjectionsRequest(), timeout=TIMEOUT_S)
        assert not listed.injections

    with_plant(segment, test)


def test_too_many_declarations_are_refused_before_any_is_checked(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        call = stub(served).Declare(wire.DeclareRequest(declarations=[wire.Declaration()] * 257), timeout=TIMEOUT_S)
        code, text = await refusal(call.read())
        assert (code, text) == (Status.INVALID_ARGUMENT, "257 injections are declared, but at most 256 are allowed")

    with_plant(segment, test)


def test_compilation_stops_when_its_client_has_left(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, over = threading.Event(), threading.Event()

    def slow(_: object, __: object, wanted: Callable[[], bool]) -> list[Program]:
        begun.set()
        until_s = time.monotonic() + TIMEOUT_S
        while wanted():
            assert time.monotonic() < until_s, "the compilation continues though its client has left"
            time.sleep(0.01)
        over.set()
        raise CommandError("no client waits for it any more")

    async def test(served: Endpoint, _: Plant) -> None:
        first = stub(served).Declare(wire.DeclareRequest(declarations=[NOISE]), timeout=TIMEOUT_S)
        assert await asyncio.to_thread(begun.wait, TIMEOUT_S)
        first.cancel()
        assert await asyncio.to_thread(over.wait, 2 * TIMEOUT_S)
        monkeypatch.undo()
        second = stub(served).Declare(wire.DeclareRequest(declarations=[NOISE]), timeout=TIMEOUT_S)
        assert (await second.read()).declared.injections, "the next call is served"
        second.cancel()

    monkeypatch.setattr("shmio.endpoints.grpc.shmio_v1.declare.compile_declarations", slow)
    with_plant(segment, test)


@BOTH
def test_both_clients_receive_the_campaigns_events(segment: Segment, connects: Connect) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        async with connects(f"127.0.0.1:{served.port}") as cell:
            async with await cell.declare([OFFSET]) as campaign:
                assert (await anext(campaign)).what == "injected"
                assert (await anext(campaign)).what == "activated"
                (one,) = await cell.injections()
                assert one.running is not None
                assert one.running.state == "active"
                waiting = asyncio.ensure_future(anext(campaign))
                await cell.lift("cell", one.number)
                assert (await waiting).what in ("deactivated", "lifted")
            assert await cell.injections() == []
            with pytest.raises(ValueRangeError):
                await cell.declare([OFFSET | {"target": "cell/nothing"}])

    with_plant(segment, test)
