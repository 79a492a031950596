"""Inject, list and lift over real sockets, by the Python clients and with the generated code only."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterable, Callable, Iterable
from typing import Any

import grpc
import numpy as np
import pytest

from shmio.client import Client, Column, Piece, Provenance, connect, connect_aio
from shmio.errors import CommandError, PathError, RemoteError, ValueRangeError
from shmio.segment import Segment
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.client.both import BOTH, Connect
from tests.unit.endpoints.grpc.services.test_publish import with_plant
from tests.unit.endpoints.grpc.shmio_v1.harness import stub
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint
from tests.unit.endpoints.plant import Plant

Status = grpc.StatusCode


def with_client(segment: Segment, test: Callable[[Client, Plant, Endpoint], None]) -> None:
    async def run(served: Endpoint, device: Plant) -> None:
        def call() -> None:
            with connect(f"127.0.0.1:{served.port}", timeout_s=TIMEOUT_S) as cell:
                test(cell, device, served)

        await asyncio.to_thread(call)

    with_plant(segment, run)


def drain(shadow: Iterable[Any]) -> None:
    for _ in shadow:
        pass


async def drain_aio(shadow: AsyncIterable[Any]) -> None:
    async for _ in shadow:
        pass


async def converse(call: Any, requests: list[wire.InjectRequest]) -> None:
    for request in requests:
        await call.write(request)
    if not requests:
        await call.done_writing()
    while await call.read() is not grpc.aio.EOF:
        pass


def seen(cell: Client, path: str, value: object) -> None:
    """Wait until consumers see this value."""
    for update in cell.subscribe(path):
        if update[path] == value:
            return


def test_consumers_see_the_given_values_and_the_originals_after_the_end(segment: Segment) -> None:
    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        struct.pack_into(">f", device.memory, 0, 1.5)
        seen(cell, "cell/axis/position", 1.5)
        with cell.inject("cell/axis", "cell/running", name="drift") as shadow:
            assert cell["cell/axis/position"] == 1.5  # held until the client gives a value
            (outcome,) = shadow.set({"cell/axis/position": 9.0})
            assert (outcome.kind, outcome.done) == ("shadowed", True)
            found = cell.read("cell/axis", originals=True).of("cell/axis/position")
            assert found["cell/axis/position"] == 9.0
            assert found.original("cell/axis/position") == 1.5
            assert found.provenance_of("cell/axis/speed") is Provenance.INJECTED
            shadow.set(arrays={Column.FLOAT: np.array([4.0, 5.0]), Column.BOOL: ([0], [True])})
            found = cell.read("cell").of("cell/running")
            assert [found[path] for path in ("axis/position", "axis/speed", "running")] == [4.0, 5.0, True]
            (one,) = cell.injections()
            assert (one.source, one.number, one.direction, one.name) == ("cell", shadow.number, "out", "drift")
            assert one.ranges == ((0, 8, 0xFF), (8, 1, 1 << 3))
        assert cell.injections() == []
        assert cell.read("cell/running").of("cell/running").provenance_of("cell/running") is Provenance.LIVE

    with_client(segment, test)


def test_originals_are_streamed(segment: Segment) -> None:
    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        struct.pack_into(">f", device.memory, 0, 1.5)
        seen(cell, "cell/axis/position", 1.5)
        with cell.inject("cell/axis/position", originals=True) as shadow:
            update = next(shadow)
            assert update["cell/axis/position"] == 1.5
            shadow.send({"cell/axis/position": 100.0})
            seen(cell, "cell/axis/position", 100.0)
            struct.pack_into(">f", device.memory, 0, 2.5)
            update = next(shadow)
            assert (update.changed, update["cell/axis/position"]) == (["cell/axis/position"], 2.5)
            assert cell["cell/axis/position"] == 100.0

    with_client(segment, test)


def test_the_originals_of_an_outer_injection_are_the_inner_ones_values(segment: Segment) -> None:
    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        struct.pack_into(">f", device.memory, 0, 1.5)
        seen(cell, "cell/axis/position", 1.5)
        with (
            cell.inject("cell/axis/position", priority=5, originals=True) as outer,
            cell.inject("cell/axis/position") as inner,
        ):
            inner.set({"cell/axis/position": 7.0})
            while next(outer)["cell/axis/position"] != 7.0:
                pass
            outer.set({"cell/axis/position": 8.0})
            assert cell["cell/axis/position"] == 8.0
            inner.close()
            while next(outer)["cell/axis/position"] != 1.5:
                pass

    with_client(segment, test)


def test_on_in_writes_are_streamed_and_given_values_reach_the_device(segment: Segment) -> None:
    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        with cell.inject("cell/step/in", "cell/name/in", originals=True) as shadow:
            assert [one.kind for one in cell.write({"cell/step": 5, "cell/axis/position": 2.0})] == ["taken", "written"]
            update = next(shadow)
            assert update.changed == ["cell/step"]
            assert update["cell/step"] == 5
            cell.write({"cell/step": 5})  # an equal write is reported again
            assert next(shadow).changed == ["cell/step"]
            assert device.memory[12:14] == b"\0\0"
            (outcome,) = shadow.set({"cell/step": 6})
            assert outcome.kind == "written"
            assert device.memory[12:14] == b"\0\6"
            cell.write({"cell/name": "ab"})
            assert next(shadow)["cell/name"] == "ab"

    with_client(segment, test)


def test_a_dead_clients_injection_is_lifted(segment: Segment) -> None:
    def test(cell: Client, _: Plant, served: Endpoint) -> None:
        with connect(f"127.0.0.1:{served.port}") as other:
            other.inject("cell/axis").set({"cell/axis/position": 3.0})
            kept = other.inject("cell/step", keep=True, name="kept")
            kept.set({"cell/step": 4})
        for update in cell.subscribe("cell"):
            if not update.table.injected[update.table.place("axis/position")]:
                break
        assert cell["cell/step"] == 4
        (one,) = cell.injections()
        assert (one.name, one.keep) == ("kept", True)
        cell.lift("cell", one.number)
        assert cell.injections() == []
        with pytest.raises(PathError, match="there is no injection"):
            cell.lift("cell", one.number)

    with_client(segment, test)


def test_lift_all_ends_the_streams_of_all(segment: Segment) -> None:
    def test(cell: Client, _: Plant, __: Endpoint) -> None:
        shadows = [cell.inject(path, originals=True) for path in ("cell/axis", "cell/step", "cell/running/in")]
        lifted = cell.lift_all()
        assert {one.number for one in lifted} == {shadow.number for shadow in shadows}
        assert cell.injections() == []
        for shadow in shadows:
            with pytest.raises(RemoteError, match="another program has lifted it"):
                drain(shadow)
            with pytest.raises(RemoteError, match="another program has lifted it"):
                shadow.set({"cell/axis/position": 1.0})
            shadow.close()
        assert cell.lift_all() == []

    with_client(segment, test)


def test_an_injection_ends_when_its_time_is_over(segment: Segment) -> None:
    def test(cell: Client, _: Plant, __: Endpoint) -> None:
        with cell.inject("cell/axis", for_s=0.05, originals=True) as shadow:
            drain(shadow)
            assert cell.injections() == []
            with pytest.raises(CommandError, match="has ended"):
                shadow.set({"cell/axis/position": 1.0})

    with_client(segment, test)


def test_invalid_injections_and_values_are_refused(segment: Segment) -> None:
    def test(cell: Client, _: Plant, __: Endpoint) -> None:
        with pytest.raises(PathError, match="no such register"):
            cell.inject("cell/nothing")
        with pytest.raises(PathError, match="not both"):
            cell.inject("cell/axis/in", "cell/step/out")
        with pytest.raises(CommandError, match="not writable"):
            cell.inject("cell/secret/in")
        with pytest.raises(ValueRangeError, match="no pattern"):
            cell.inject()
        with pytest.raises(ValueRangeError, match="for_s"):
            cell.inject("cell/axis", for_s=-1)
        with pytest.raises(ValueRangeError, match="stays until somebody lifts it"):
            cell.inject("cell/axis", for_s=1, keep=True)
        with pytest.raises(ValueRangeError, match="name"):
            cell.inject("cell/axis", name="x" * 300)
        with cell.inject("cell/axis", "cell/inputs/1") as shadow:
            (outcome,) = shadow.set({"cell/step": 1})
            assert outcome.kind == "rejected"
            assert "not covered" in outcome.text
            (outcome,) = shadow.set({"cell/axis/position": "x"})
            assert outcome.kind == "rejected"
            with pytest.raises(ValueRangeError, match="3 values were given for 2 elements"):
                shadow.set(arrays={Column.FLOAT: [1.0, 2.0, 3.0]})
            (outcome,) = shadow.set(arrays={Column.INT32: ([7], [1])})
            assert "has no slot 7" in outcome.text
            shadow.set({"cell/axis/position": 2.0}, arrays={Column.INT32: [9]})
            assert (cell["cell/axis/position"], cell["cell/inputs/1"]) == (2.0, 9)
        with cell.inject("cell/axis", originals=True) as shadow:
            shadow.send({"cell/axis/position": "x"})
            with pytest.raises(ValueRangeError):
                drain(shadow)
        assert cell.injections() == []

    with_client(segment, test)


def test_invalid_messages_are_refused(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        lay = wire.InjectRequest(lay=wire.Lay(patterns=["cell/axis"], quiet=True))
        wrong: list[list[wire.InjectRequest]] = [
            [],
            [wire.InjectRequest()],
            [wire.InjectRequest(shadow=wire.Shadow())],
            [lay, lay],
            [lay, wire.InjectRequest(shadow=wire.Shadow())],
            [wire.InjectRequest(lay=wire.Lay(patterns=["cell/axis"], lifetime_ms=1 << 60))],
            [wire.InjectRequest(lay=wire.Lay(patterns=["cell/long"] * 300))],
        ]
        for requests in wrong:
            call = stub(served).Inject(timeout=TIMEOUT_S)
            with pytest.raises(grpc.aio.AioRpcError) as caught:
                await converse(call, requests)
            assert caught.value.code() is Status.INVALID_ARGUMENT, requests
        listed: Any = await stub(served).ListInjections(wire.ListInjectionsRequest(), timeout=TIMEOUT_S)
        assert not listed.injections

    with_plant(segment, test)


@BOTH
def test_both_clients_give_values_and_read_originals(segment: Segment, connects: Connect) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        async with connects(f"127.0.0.1:{served.port}") as cell:
            async with await cell.inject("cell/axis", originals=True) as shadow:
                assert (await anext(shadow))["cell/axis/position"] == 0.0
                assert (await shadow.set({"cell/axis/position": 2.0}))[0].done
                assert (await cell.read("cell/axis"))["cell/axis/position"] == 2.0
                await shadow.send({"cell/axis/position": 3.0})
                (one,) = await cell.injections()
                await cell.lift("cell", one.number)
                with pytest.raises(RemoteError, match="another program has lifted it"):
                    await drain_aio(shadow)
                with pytest.raises(RemoteError, match="another program has lifted it"):
                    await shadow.set({"cell/axis/position": 2.0})
            assert [one.kind for one in await cell.write({"cell/step": 3})] == ["written"]
            assert device.memory[13] == 3
            assert await cell.lift_all() == []
            with pytest.raises(PathError):
                await cell.inject("cell/nothing")

    with_plant(segment, test)


def test_bytes_and_bits_by_ranges(segment: Segment) -> None:
    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        device.memory[26:30] = b"\1\2\3\4"
        seen(cell, "cell/long/4", 4)
        with cell.inject(ranges=[(26, 3), (10, 1, 0x0F)], source="cell", originals=True) as shadow:
            assert shadow.table.ranges == ((26, 3, 0xFF), (10, 1, 0x0F))
            assert shadow.table.registers == ()
            first = next(shadow)
            assert [tuple(piece) for piece in first.pieces] == [(26, b"\1\2\3", 0xFF), (10, b"\0", 0x0F)]
            (one,) = cell.injections()
            assert one.ranges == ((10, 1, 0x0F), (26, 3, 0xFF))
            (outcome,) = shadow.set(raw=[(27, b"\x22\x33"), Piece(10, b"\xff")])
            assert outcome.kind == "shadowed"
            assert cell["cell/long"][:4].tolist() == [1, 0x22, 0x33, 4]
            assert cell["cell/inputs/0"] == 0x0F
            device.memory[10:12] = b"\xa5\1"
            device.memory[28] = 9
            pieces: dict[int, bytes] = {}
            while set(pieces) != {28, 10}:
                pieces |= dict(_pieces(next(shadow)))
            assert pieces == {28: b"\x09", 10: b"\x05"}
            (outcome,) = shadow.set(raw=[(10, b"\0", 1)])
            assert outcome.done
            assert cell["cell/inputs/0"] == 0xAE
            for wrong in ((25, b"\0"), (28, b"\0\0"), (10, b"\0", 0x10), (10, b"\0", 0x1FF), (5000, b"\0"), (26, b"")):
                (outcome,) = shadow.set(raw=[wrong])
                assert (outcome.kind, "does not cover all" in outcome.text) == ("rejected", True)
        assert cell["cell/inputs/0"] == 0xA5

    with_client(segment, test)


def _pieces(update: Any) -> list[tuple[int, bytes]]:
    return [(piece.offset, piece.data) for piece in update.pieces]


def test_ranges_on_in_together_with_registers(segment: Segment) -> None:
    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        with cell.inject("cell/step/in", ranges=[(26, 600)], originals=True) as shadow:
            assert (shadow.table.direction, shadow.table.ranges) == ("in", ((26, 600, 0xFF),))
            cell.write({"cell/long/3": 7, "cell/step": 5})
            update = next(shadow)
            assert (_pieces(update), update.changed, update["cell/step"]) == ([(28, b"\7")], ["cell/step"], 5)
            ends = shadow.set({"cell/step": 6}, raw=[(26, bytes(range(200)))])
            assert [one.kind for one in ends] == ["written", "written"]
            assert device.memory[26:226] == bytes(range(200))
            assert device.memory[13] == 6

    with_client(segment, test)


def test_a_whole_section_of_a_block(segment: Segment) -> None:
    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        device.memory[13] = 3
        seen(cell, "cell/step", 3)
        size = segment.blocks["cell"].layout.size
        with cell.inject(ranges=[(0, size)], source="cell", originals=True) as shadow:
            (piece,) = next(shadow).pieces
            assert (piece.offset, piece.data) == (0, bytes(device.memory))
            image = bytearray(piece.data)
            image[13] = 4
            assert shadow.set(raw=[(0, bytes(image))])[0].done
            assert cell["cell/step"] == 4

    with_client(segment, test)


def test_invalid_ranges_are_refused(segment: Segment) -> None:
    def test(cell: Client, _: Plant, __: Endpoint) -> None:
        for ranges, message in (
            ([(0, 0)], "at least one byte"),
            ([(600, 29)], "within the block of"),
            ([(1 << 31, 1 << 31)], "within the block of"),
            ([(0, 1, 0x100)], "has more than 8 bits"),
            ([(0, 1)] * 300, "at most 256 are allowed"),
        ):
            with pytest.raises(ValueRangeError, match=message):
                cell.inject(ranges=ranges, source="cell")
        with pytest.raises(PathError, match="is not a source's name"):
            cell.inject(ranges=[(0, 1)], source="cell/step")
        with pytest.raises(PathError, match="needed for ranges without a pattern"):
            cell.inject(ranges=[(0, 1)])
        with pytest.raises(CommandError, match="not writable"):
            cell.inject(ranges=[(626, 1)], source="cell/in")
        assert cell.injections() == []

    with_client(segment, test)


def test_too_many_pieces_are_refused_before_any_is_checked(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        call = stub(served).Inject(timeout=TIMEOUT_S)
        lay = wire.Lay(source="cell", ranges=[wire.Range(offset=26, size=600)], quiet=True)
        await call.write(wire.InjectRequest(lay=lay))
        shadow = wire.Shadow(sequence=1, pieces=[wire.Piece(offset=26, data=b"x")] * 4097)
        await call.write(wire.InjectRequest(shadow=shadow))
        while not (answers := (await asyncio.wait_for(call.read(), TIMEOUT_S)).answers):
            pass
        assert answers[0].outcome.reason.startswith("pieces: the message has 4097, but at most 4096")
        call.cancel()

    with_plant(segment, test)


def test_originals_include_the_effect_of_an_inner_declared_injection(segment: Segment) -> None:
    """After the declared injection is lifted, the original is the source's value."""

    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        struct.pack_into(">f", device.memory, 0, 1.5)
        offset = {"name": "x", "target": "cell/axis/position", "operation": "offset", "value": 5}
        with cell.declare([offset]) as campaign, cell.inject("cell/axis/position", originals=True) as shadow:
            while next(shadow)["cell/axis/position"] != 6.5:
                pass
            struct.pack_into(">f", device.memory, 0, 2.5)
            while next(shadow)["cell/axis/position"] != 7.5:
                pass
            cell.lift("cell", campaign.declared[0].number)
            while next(shadow)["cell/axis/position"] != 2.5:
                pass

    with_client(segment, test)


def test_missed_events_end_only_streams_that_need_every_event(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        async with connect_aio(f"127.0.0.1:{served.port}") as cell:
            outward, inward = await cell.inject("cell/axis"), await cell.inject("cell/step/in", originals=True)
            served.feeds["cell"].commands.followers.fail("3 events of source cell were missed")
            with pytest.raises(RemoteError, match="3 events of source cell were missed"):
                await drain_aio(inward)
            (one,) = await cell.injections()
            assert one.number == outward.number
            await outward.close()

    with_plant(segment, test)
