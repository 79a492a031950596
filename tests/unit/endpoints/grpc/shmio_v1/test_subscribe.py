"""Subscribe over real sockets: values, quality, gaps, rates, reloads and refusals."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import grpc
import pytest

from shmio.endpoints.grpc.shmio_v1.subscribe import BATCH_UPDATES
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, Quality, Segment
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.endpoints.grpc.shmio_v1.harness import stub, subscribe, values
from tests.unit.endpoints.harness import LAYOUT, STALE_NS, TIMEOUT_S, WRITER, Endpoint, image, refusal, serve

Status = grpc.StatusCode
EVERY: Any = wire.MODE_EVERY_FRAME
FRAMES: Any = wire.FORMAT_FRAMES


async def streams(served: Endpoint, count: int) -> None:
    async def so_many() -> bool:
        await asyncio.sleep(0)
        return served.service.counters[0] == count

    await served.until(so_many)


def test_the_current_values_come_first_then_changes(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.0, 2.0, True))
        stream = subscribe(served, "cell/axis", "cell/running")
        table = await stream.next()
        assert [register.path for register in table.registers] == ["axis/position", "axis/speed", "running"]
        update = await stream.next()
        assert (update.table, update.frame, update.whole) == (table.number, 1, True)
        assert values(table.registers, update.values) == {"axis/position": 1.0, "axis/speed": 2.0, "running": True}
        served.publish(image(1.0, 2.0, True, step=7))  # of a register that was not requested
        served.publish(image(1.0, 2.5, True))
        update = await stream.next()
        assert (update.frame, update.whole) == (3, False)
        assert values(table.registers, update.values) == {"axis/speed": 2.5}

    serve(segment, test)


def test_a_source_without_a_frame(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        stream = subscribe(served, "cell/axis/position")
        await stream.next()
        served.writer.publish(image(), cycle=1, source_ns=0, quality=Quality.BAD, reason="not connected")
        update = await stream.next()
        assert (update.quality, update.reason, update.HasField("values")) == (wire.QUALITY_BAD, "not connected", False)
        served.publish(image())
        update = await stream.next()
        assert (update.quality, update.whole) == (wire.QUALITY_GOOD, True)
        assert values(stream.tables[update.table].registers, update.values) == {"axis/position": 0.0}

    serve(segment, test)


@pytest.mark.parametrize("mode", [wire.MODE_LATEST, wire.MODE_EVERY_FRAME])
def test_bad_quality_is_sent_with_its_reason_and_so_is_recovery(segment: Segment, mode: Any) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.0))
        stream = subscribe(served, "cell/axis/position", mode=mode)
        assert (await stream.update()).quality == wire.QUALITY_GOOD
        served.writer.publish(image(1.0), cycle=2, quality=Quality.BAD, reason="cable out")
        update = await stream.update()
        assert (update.quality, update.reason, update.HasField("values")) == (wire.QUALITY_BAD, "cable out", False)
        served.publish(image(1.0))
        update = await stream.update()
        assert (update.quality, update.reason) == (wire.QUALITY_GOOD, "")

    serve(segment, test)


@pytest.mark.parametrize("mode", [wire.MODE_LATEST, wire.MODE_EVERY_FRAME])
def test_staleness_is_sent(soon_stale: Segment, mode: Any) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.0))
        stream = subscribe(served, "cell/axis/position", mode=mode)
        while (update := await stream.update()).quality != wire.QUALITY_BAD:  # the first update may already be stale
            assert update.frame == 1
        assert update.frame == 1
        assert update.reason.startswith("stale: ")
        served.publish(image(1.0))
        update = await stream.update()
        assert (update.frame, update.quality) == (2, wire.QUALITY_GOOD)

    serve(soon_stale, test)


def test_a_client_that_reads_every_frame_is_a_reader(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.0))
        latest, every = subscribe(served, "cell"), subscribe(served, "cell", mode=EVERY)
        for stream in (latest, every):
            await stream.update()
        assert [(block.source, last) for block, last in served.service.readers] == [("cell", 1)]
        for _ in range(5):  # without a turn of the event loop, so that nothing is sent
            served.publish(image(2.0))
        assert [last for _, last in served.service.readers] == [1]
        while (await every.update()).frame < 6:
            pass
        assert [last for _, last in served.service.readers] == [6]
        every.call.cancel()

        async def gone() -> bool:
            await asyncio.sleep(0)
            return not list(served.service.readers)

        await served.until(gone)

    serve(segment, test)


def test_a_stream_that_is_behind_catches_up_in_slices(segment: Segment) -> None:
    """Other tasks run between the slices, even if the updates are small."""

    async def test(served: Endpoint) -> None:
        served.publish(image(step=0))
        stream = subscribe(served, "cell/step", mode=EVERY)
        await stream.values()
        most = BATCH_UPDATES + BATCH_UPDATES // 2
        for step in range(1, most + 1):
            served.publish(image(step=step))
        counts: list[int] = []
        while sum(counts) < most:
            message = await asyncio.wait_for(stream.call.read(), TIMEOUT_S)
            counts.append(len(message.updates))
            assert not any(update.missed for update in message.updates)
        assert max(counts) <= BATCH_UPDATES

    serve(segment, test)


def test_every_frame_comes_in_order(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(0))
        stream = subscribe(served, "cell/axis/position", mode=EVERY)
        assert (await stream.update()).frame == 1
        for i in range(1, 401):
            served.publish(image(i // 2))
        for i in range(1, 401):
            update = await stream.update()
            assert (update.frame, update.cycle, update.missed) == (i + 1, i + 1, 0)
            told = values(stream.tables[update.table].registers, update.values)
            assert told == ({"axis/position": i // 2} if i % 2 == 0 else {})

    serve(segment, test)


def test_gaps_are_counted_exactly(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        slots = segment.blocks["cell"].ring.slot_count
        served.publish(image(0))
        stream = subscribe(served, "cell/long", "cell/axis/position", mode=EVERY)
        last, missed, gaps = (await stream.update()).frame, 0, 0
        for i in range(3 * slots):  # without a turn of the event loop, so that nothing is read
            served.publish(image(i + 1))
        while last < 3 * slots + 1:
            update = await stream.update()
            gaps += update.missed > 0
            missed += update.missed
            assert update.frame == last + 1 + update.missed
            last = update.frame
            assert values(stream.tables[update.table].registers, update.values) == {"axis/position": last - 1}
        assert gaps == 1
        assert missed >= slots

    serve(segment, test)


def test_values_are_conflated_for_a_client_that_does_not_read(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(0))
        stream = subscribe(served, "cell/axis/position")
        await stream.update()
        for i in range(1, 101):
            served.publish(image(i))
        update = await stream.update()
        assert update.frame > 50
        while values(stream.tables[update.table].registers, update.values) != {"axis/position": 100.0}:
            update = await stream.update()

    serve(segment, test)


def test_the_rate_of_updates_is_limited(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(0))
        stream = subscribe(served, "cell/axis/position", max_rate_hz=0.001)
        fast = subscribe(served, "cell/axis/position")
        await stream.update()
        await fast.update()
        for i in range(1, 5):
            served.publish(image(i))
            await fast.update()
        waiting = asyncio.ensure_future(stream.update())
        served.publish(image(9))
        await fast.update()
        assert not waiting.done()
        waiting.cancel()

    serve(segment, test)


def test_with_a_rate_limit_the_newest_value_is_sent_when_due(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(0))
        stream = subscribe(served, "cell/axis/position", max_rate_hz=20)
        await stream.update()
        served.publish(image(1))
        served.publish(image(2))
        assert await stream.values() == {"axis/position": 2.0}

    serve(segment, test)


def test_numbers_within_the_dead_band_are_not_sent(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(0.0, 0.0))
        stream = subscribe(served, "cell/axis", "cell/running", deadband=1.0)
        assert (await stream.update()).whole
        for position in (0.5, 1.0, -1.0):
            served.publish(image(position, 0.0))
        served.publish(image(1.5, 0.25))  # compared with the value last sent, not with the one before
        assert await stream.values() == {"axis/position": 1.5}
        served.publish(image(0.75, 0.25, True))
        assert await stream.values() == {"running": True}
        served.publish(image(math.nan, 0.25, True))
        assert list(await stream.values()) == ["axis/position"]

    serve(segment, test)


def test_raw_frames(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.0, 2.0, True))
        stream = subscribe(served, "cell/axis", format=FRAMES, mode=EVERY)
        table = await stream.next()
        assert (table.size, table.hash, len(table.registers)) == (LAYOUT.size, LAYOUT.hash, 0)
        update = await stream.next()
        assert (update.image, update.original) == (image(1.0, 2.0, True), b"")
        served.writer.publish(image(1.0), cycle=2, effective=image(9.0))
        update = await stream.next()
        assert (update.image, update.original) == (image(9.0), image(1.0))

    serve(segment, test)


def test_streams_of_equal_patterns_share_table_and_bytes(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.0))
        many = [subscribe(served, "cell/axis", mode=EVERY) for _ in range(20)]
        assert len({(await stream.update()).table for stream in many}) == 1
        served.publish(image(2.0))
        assert len({(await stream.update()).SerializeToString(deterministic=True) for stream in many}) == 1
        await streams(served, 20)
        for stream in many:
            stream.call.cancel()
        await streams(served, 0)

    serve(segment, test)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": 2}, "mode 2, format 0"),
        ({"format": 7}, "mode 0, format 7"),
        ({"max_rate_hz": -1.0}, "max_rate_hz: -1.0 is not a number from 0 on"),
        ({"max_rate_hz": math.nan}, "max_rate_hz"),
        ({"max_rate_hz": 1e9}, "at most 1e+06"),
        ({"deadband": math.inf}, "deadband"),
        ({"deadband": 1.0, "mode": 1}, "only in the mode LATEST"),
        ({"max_rate_hz": 1.0, "mode": 1}, "only in the mode LATEST"),
        ({"deadband": 1.0, "format": 1}, "deadband is allowed only with the format VALUES"),
    ],
)
def test_invalid_options_are_refused(segment: Segment, options: dict[str, Any], message: str) -> None:
    async def test(served: Endpoint) -> None:
        code, text = await refusal(subscribe(served, "cell/axis", **options).call.read())
        assert code is Status.INVALID_ARGUMENT
        assert message in text

    serve(segment, test)


def test_the_number_of_streams_is_limited(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.shmio_v1.subscribe.MAX_STREAMS", 2)

    async def test(served: Endpoint) -> None:
        served.publish(image())
        open_ones = [subscribe(served, "cell/axis") for _ in range(2)]
        for stream in open_ones:
            await stream.update()
        code, text = await refusal(subscribe(served, "cell/axis").call.read())
        assert code is Status.RESOURCE_EXHAUSTED
        assert "one call can have many patterns" in text
        open_ones[0].call.cancel()
        await streams(served, 1)
        assert (await subscribe(served, "cell/axis").update()).whole

    serve(segment, test)


OTHER = Layout("DB1", 1, 4, False, (Register("axis/position", "DINT", (), 0, None, 4, 1),))
WITHOUT = Layout("DB1", 1, 4, False, (Register("speed", "DINT", (), 0, None, 4, 1),))


def reload(served: Endpoint, layout: Layout | None) -> None:
    """Replace the source's block or remove it, as a reload of the configuration does."""
    block = [BlockSpec("cell", layout, 20_000_000, STALE_NS, 1 << 16, Attributes())] if layout else []
    served.segment.change(block, ["cell"])
    old = served.feeds.pop("cell")
    old.stop()
    if layout:
        feed = served.feeds["cell"] = Feed(served.segment.blocks["cell"], WRITER, served.wake_ups, lambda *_: None)
        feed.start()
        served.writer = served.segment.writer("cell")
    served.service.on_sources_replaced(["cell"])


@pytest.mark.parametrize("mode", [wire.MODE_LATEST, wire.MODE_EVERY_FRAME])
def test_a_reload_sends_a_new_table_after_all_earlier_updates(segment: Segment, mode: Any) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.0))
        stream = subscribe(served, "cell/axis/position", mode=mode)
        first = (await stream.update()).table
        served.publish(image(2.0))
        reload(served, OTHER)
        served.writer.publish((7).to_bytes(4, "big"), cycle=1)
        assert await stream.values() == {"axis/position": 2.0}
        table = await stream.next()
        assert isinstance(table, wire.Table)
        assert table.number != first
        assert (table.hash, table.registers[0].type) == (OTHER.hash, "DINT")
        update = await stream.next()
        assert (update.table, update.frame, update.whole) == (table.number, 1, True)
        assert values(table.registers, update.values) == {"axis/position": 7}

    serve(segment, test)


@pytest.mark.parametrize("layout", [None, WITHOUT])
def test_registers_removed_by_a_reload_are_reported_and_can_return(segment: Segment, layout: Layout | None) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.0))
        stream = subscribe(served, "cell/axis/position")
        await stream.update()
        reload(served, layout)
        ended = await stream.next()
        assert isinstance(ended, wire.Ended)
        assert ended.source == "cell"
        assert ended.reason
        if layout is not None:
            reload(served, OTHER)
            served.writer.publish((7).to_bytes(4, "big"), cycle=1)
            assert isinstance(await stream.next(), wire.Table)
            assert await stream.values() == {"axis/position": 7}

    serve(segment, test)


def test_a_client_that_never_reads_delays_no_other(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(0))
        silent = stub(served).Subscribe(wire.SubscribeRequest(patterns=["cell"], mode=EVERY), timeout=TIMEOUT_S)
        await silent.initial_metadata()
        stream = subscribe(served, "cell/axis/position")
        await stream.update()
        for i in range(1, 301):
            served.publish(image(i))
            assert await stream.values() == {"axis/position": float(i)}
        silent.cancel()

    serve(segment, test)
