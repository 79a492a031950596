"""Read, GetLayouts and GetStatus over real sockets."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Any

import grpc
import msgspec
import pytest

from shmio.endpoints.grpc.shmio_v1 import selection, service
from shmio.segment import Activity, Quality, Report, Segment
from shmio.segment.injection_list import InjectionEntry, encode
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.endpoints.grpc.shmio_v1.harness import read, stub, values
from tests.unit.endpoints.harness import LAYOUT, TIMEOUT_S, WRITABLE, Endpoint, image, refusal, serve

Status = grpc.StatusCode


def test_registers_of_every_form_in_one_call(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.5, -2.0, True, b"\1\2", -7))
        answer = await read(
            served, "cell/axis", "running", "CELL://inputs/1", "cell/long/599..600", "cell/*s/out", "cell/name"
        )
        (table,), (update,) = answer.tables, answer.updates
        assert (table.source, table.hash, update.table, update.whole) == ("cell", LAYOUT.hash, table.number, True)
        assert values(table.registers, update.values) == {
            "axis/position": 1.5,
            "axis/speed": -2.0,
            "running": True,
            "inputs/1": 2,
            "long/599": 0,
            "long/600": 0,
            "inputs": [1, 2],
            "bits": [False] * 10,
            "name": "",
        }
        assert (update.frame, update.cycle, update.quality, update.reason) == (1, 1, wire.QUALITY_GOOD, "")
        assert update.provenance == wire.PROVENANCE_LIVE
        assert update.source_ns > 0 < update.age_ns

    serve(segment, test)


def test_a_table_that_the_client_has_is_not_sent_again(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.5))
        first = await read(served, "cell/axis")
        (number,) = [table.number for table in first.tables]
        again = await read(served, "cell/axis", tables=[number])
        assert not again.tables
        assert again.updates[0].table == number
        assert (await read(served, "cell/running", tables=[number])).tables

    serve(segment, test)


def test_a_source_without_a_frame(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        (update,) = (await read(served, "cell/axis")).updates
        assert (update.quality, update.reason) == (wire.QUALITY_BAD, "no data yet")
        served.writer.publish(image(), cycle=1, source_ns=0, quality=Quality.BAD, reason="not connected")
        (update,) = (await read(served, "cell/axis")).updates
        assert (update.quality, update.reason) == (wire.QUALITY_BAD, "not connected")
        assert not update.HasField("values")

    serve(segment, test)


def test_bad_values_have_the_last_value_and_the_reason(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.writer.publish(image(2.5), cycle=3, quality=Quality.BAD, reason="cable out")
        answer = await read(served, "cell/axis/position")
        (update,) = answer.updates
        assert (update.quality, update.reason) == (wire.QUALITY_BAD, "cable out")
        assert values(answer.tables[0].registers, update.values) == {"axis/position": 2.5}

    serve(segment, test)


def test_stale_values_are_bad(soon_stale: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.writer.publish(image(2.5), cycle=3, asked_ns=0)
        (update,) = (await read(served, "cell/axis")).updates
        assert update.quality == wire.QUALITY_BAD
        assert update.reason.startswith("stale: ")

    serve(soon_stale, test)


def test_undecodable_bytes_are_marked_as_invalid(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        wrong = bytearray(image())
        wrong[17] = 200  # the length of a STRING[8]
        served.publish(bytes(wrong))
        answer = await read(served, "cell/axis/speed", "cell/name")
        (update,) = answer.updates
        assert list(update.invalid.registers) == [1]
        assert values(answer.tables[0].registers, update.values)["name"] == ""

    serve(segment, test)


def test_injected_registers_are_marked_and_have_their_originals(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        block = segment.blocks["cell"]
        ranges = ((0, 4, 0xFF), (8, 1, 1 << 3))
        block.injections.write(encode([msgspec.json.encode(InjectionEntry(7, "out", 0, False, "x", 0, 1, ranges))]))
        served.writer.publish(image(1.0, 2.0), cycle=1, effective=image(9.0, 2.0, True))
        answer = await read(served, "cell/axis", "cell/running", "cell/step", originals=True)
        registers, update = answer.tables[0].registers, answer.updates[0]
        assert values(registers, update.values)["axis/position"] == 9.0
        assert values(registers, update.originals) == {
            "axis/position": 1.0,
            "axis/speed": 2.0,
            "running": False,
            "step": 0,
        }
        assert [registers[place].path for place in update.injected.registers] == ["axis/position", "running"]
        answer = await read(served, "cell/axis")
        assert not answer.updates[0].HasField("originals")

    serve(segment, test)


@pytest.mark.parametrize(
    ("patterns", "code", "message"),
    [
        ((), Status.INVALID_ARGUMENT, "no pattern is given"),
        (("cell/nothing",), Status.NOT_FOUND, "no such register"),
        (("cell/x*",), Status.NOT_FOUND, "cell/x*: source 'cell' has no such register"),
        (("other/x",), Status.NOT_FOUND, "no source 'other' and no register 'other/x' in source 'cell'"),
        (("cell/axis/position/in",), Status.NOT_FOUND, "leave out /in"),
        (("cell/inputs/0..2",), Status.NOT_FOUND, "outside"),
        (("cell/inputs/1..0",), Status.NOT_FOUND, "write the lower index first"),
        (("cell/step/0..1",), Status.NOT_FOUND, "the place of an array's last index"),
        (("cell/%",), Status.NOT_FOUND, "hexadecimal"),
        (("cell/" + "a" * 20_000,), Status.NOT_FOUND, "at most"),
        (("cell/*" + "a" * 2_000,), Status.NOT_FOUND, "at most"),
        (("SIMLOG://step",), Status.NOT_FOUND, "SIMLOG://step: clients can only subscribe to this topic"),
        (("cell/axis",) * 257, Status.INVALID_ARGUMENT, "257 patterns are given, but at most 256"),
    ],
)
def test_invalid_reads_are_refused_with_the_reason(
    segment: Segment, patterns: tuple[str, ...], code: Any, message: str
) -> None:
    async def test(served: Endpoint) -> None:
        found, text = await refusal(read(served, *patterns))
        assert found is code
        assert message in text

    serve(segment, test)


def test_a_read_of_too_many_values_is_refused(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(served: Endpoint) -> None:
        monkeypatch.setattr(selection, "MAX_ELEMENTS", 600)
        assert (await refusal(read(served, "cell")))[0] is Status.INVALID_ARGUMENT
        assert (await refusal(read(served, "cell/long", "cell/axis")))[0] is Status.INVALID_ARGUMENT
        monkeypatch.setattr(selection, "MAX_MATCHES", 20)
        assert "patterns with stars" in (await refusal(read(served, "*s", "*p", "ax*")))[1]
        monkeypatch.setattr(selection, "MAX_ALL_ELEMENTS", 599)
        code, text = await refusal(read(served, "cell/long"))
        assert code is Status.RESOURCE_EXHAUSTED
        assert "at most 599 are allowed" in text
        assert (await read(served, "cell/axis")).tables

    serve(segment, test)


def test_get_layouts(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "PART_REGISTERS", 4)

    async def test(served: Endpoint) -> None:
        parts = [part async for part in stub(served).GetLayouts(wire.GetLayoutsRequest(), timeout=TIMEOUT_S)]
        assert [(part.source, len(part.registers), part.last) for part in parts] == [
            ("cell", 4, False),
            ("cell", 4, False),
            ("cell", 1, True),
        ]
        assert {(part.name, part.number, part.size, part.big_endian, part.hash) for part in parts} == {
            ("DB1", 1, LAYOUT.size, True, LAYOUT.hash)
        }
        assert tuple(parts[0].writable) == WRITABLE
        found = [register for part in parts for register in part.registers]
        for there, here in zip(found, LAYOUT.registers, strict=True):
            assert (there.path, there.type, there.offset, there.size, there.count) == (
                here.path,
                here.type,
                here.offset,
                here.size,
                here.count,
            )
            assert (there.bit if there.HasField("bit") else None) == here.bit
            assert [(bounds.low, bounds.high) for bounds in there.dims] == list(here.dims)
        often = wire.GetLayoutsRequest(
            sources=["cell"] * 1000
        )  # a small request must not cause an answer of a million parts
        assert [part async for part in stub(served).GetLayouts(often, timeout=TIMEOUT_S)] == parts
        call = stub(served).GetLayouts(wire.GetLayoutsRequest(sources=["cell", "x"]), timeout=TIMEOUT_S)
        with pytest.raises(grpc.aio.AioRpcError, match="unknown source 'x'; valid: cell"):
            _ = [part async for part in call]

    serve(segment, test)


def test_get_status_reads_the_process_table(instance: str, segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        slot = segment.processes.find("cell")
        slot.report = Report(4711, Activity.RUNNING, 1, (5, 2, 0, 1, 900, 50_000), "well")
        served.publish(image())
        status = await stub(served).GetStatus(wire.GetStatusRequest(), timeout=TIMEOUT_S)
        assert (status.instance, status.mode, status.segment) == (instance, "live", f"shmio-{instance}")
        assert status.HasField("supervisor")
        process = next(process for process in status.processes if process.name == "cell")
        assert (process.name, process.kind, process.source.quality, process.source.cycle) == (
            "cell",
            "source",
            "good",
            1,
        )
        assert process.source.overruns == 2

    with Segment.open(instance, writable=True) as opened:  # another mapping, as a process does not see its own locks
        serve(opened, test)


def test_hostile_requests_are_refused_without_further_effect(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.0))
        for method in ("Read", "Subscribe", "GetLayouts", "GetStatus"):
            for message in (b"\xff\xff\xff", b"\x0a\xff\xff\xff\xff\x0f", b"\x0a\x02\xff\xfe", bytes(1000)):
                raw: Any = served.channel.unary_stream(f"/shmio.v1.Shmio/{method}")
                call = raw(message, timeout=TIMEOUT_S)
                with suppress(grpc.aio.AioRpcError):  # some of these are valid messages of some calls
                    while await asyncio.wait_for(call.read(), TIMEOUT_S) is not grpc.aio.EOF:
                        pass
        deep = wire.ReadRequest(patterns=["/".join("a" * 3000), "*" * 1025, "**/" * 300 + "x", "cell/\0", "cell//"])
        for pattern in deep.patterns:
            assert (await refusal(read(served, pattern)))[0] is Status.NOT_FOUND
        assert (await read(served, "cell/axis")).updates[0].quality == wire.QUALITY_GOOD

    serve(segment, test)
