"""Events over real sockets: what is sent, what a slow client loses, and what a reload does."""

from __future__ import annotations

import asyncio
import re
import struct
from typing import Any

import grpc
import pytest

from shmio.client import Client, Event, EventKind
from shmio.endpoints.grpc.shmio_v1 import events as events_module
from shmio.endpoints.grpc.shmio_v1.events import EventLog, EventLogs, EventsCall
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.errors import EndpointError, PathError, RemoteError, SegmentError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.local.events import EventReader
from shmio.messages import event_from_wire, event_to_wire
from shmio.model.values import Quality
from shmio.segment import Attributes, Block, BlockSpec, Segment
from shmio.segment import EventKind as Recorded
from shmio.segment.events import EVENT_SLOTS, Record
from shmio.wire import shmio_v1_pb2 as wire
from shmio.wire.shmio_v1_pb2_grpc import ShmioStub
from tests.unit.client.both import BOTH, Connect
from tests.unit.endpoints.grpc.shmio_v1.harness import stub
from tests.unit.endpoints.grpc.shmio_v1.test_injections import with_client
from tests.unit.endpoints.harness import STALE_NS, TIMEOUT_S, WRITER, Endpoint, refusal, serve
from tests.unit.endpoints.plant import Plant

Status = grpc.StatusCode
NOTE = Record(Recorded.NOTED, "here", 2, 5)
OTHER = Layout("DB1", 1, 4, False, (Register("axis/position", "DINT", (), 0, None, 4, 1),))


class Stream:
    """The events of one call, one by one."""

    def __init__(self, served: Endpoint, *sources: str, channel: grpc.aio.Channel | None = None) -> None:
        calls: Any = ShmioStub(channel or served.channel)  # type: ignore[no-untyped-call]
        self.call = calls.Events(wire.EventsRequest(sources=sources), timeout=TIMEOUT_S)
        self._waiting: list[Any] = []

    async def begin(self) -> list[str]:
        """Wait until the endpoint follows the sources. Return their names."""
        return list((await asyncio.wait_for(self.call.read(), TIMEOUT_S)).sources)

    async def next(self) -> Any:
        while not self._waiting:
            message = await asyncio.wait_for(self.call.read(), TIMEOUT_S)
            assert message is not grpc.aio.EOF
            self._waiting = list(message.events)
        return self._waiting.pop(0)


def reload(served: Endpoint, layout: Layout | None) -> None:
    """Replace the source's block or remove it, as a reload of the configuration does."""
    block = [BlockSpec("cell", layout, 20_000_000, STALE_NS, 1 << 16, Attributes("test"))] if layout else []
    served.segment.change(block, ["cell"])
    served.feeds.pop("cell").stop()
    if layout:
        feed = served.feeds["cell"] = Feed(served.segment.blocks["cell"], WRITER, served.wake_ups, lambda *_: None)
        feed.start()
        served.writer = served.segment.writer("cell")
    served.service.on_sources_replaced(["cell"])


def test_what_a_program_does_is_seen_with_its_values(segment: Segment) -> None:
    def test(cell: Client, device: Plant, _: Endpoint) -> None:
        with cell.events("cell") as events:
            cell.write({"cell/step": 7, "cell/name": "ab"})
            accepted, other, written = (next(events) for _ in range(3))
            assert [one.kind for one in (accepted, other)] == [EventKind.ACCEPTED, "accepted"]
            assert {**accepted.values, **other.values} == {"cell/step": 7, "cell/name": "ab"}
            assert (accepted.direction, accepted.source) == ("in", "cell")
            assert re.fullmatch(r"grpc: anonymous \(ipv4:127\.0\.0\.1:[0-9]+\)", accepted.by)
            assert (written.kind, set(written.paths)) == ("written", {"cell/step", "cell/name"})
            assert {one.command for one in (other, written)} == {accepted.command}
            device.refusal = "broken"
            cell.write({"cell/running": True})
            assert next(events).values == {"cell/running": True}
            refused = next(events)
            assert (refused.kind, refused.text, refused.paths) == ("refused", "broken", ("cell/running",))
            with cell.inject("cell/axis/position", name="stuck") as shadow:
                laid = next(events)
                assert (laid.kind, laid.text, laid.injection) == ("injected", "stuck", shadow.number)
                assert (laid.paths, laid.direction) == (("cell/axis/position",), "out")
                assert laid.by == accepted.by
                shadow.set({"cell/axis/position": 2.5})
                given = next(events)
                while given.kind != "shadowed":
                    given = next(events)
                assert (given.values, given.direction) == ({"cell/axis/position": 2.5}, "out")
            lifted = next(events)
            while lifted.kind != "lifted":
                lifted = next(events)
            assert (lifted.injection, lifted.text) == (shadow.number, "lifted")
            assert {one.missed for one in (accepted, other, refused, laid, given, lifted)} == {0}

    with_client(segment, test)


def test_a_client_that_comes_later_gets_only_what_happens_then(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.writer.event(NOTE._replace(text="before"))
        one, other = Stream(served), Stream(served, "cell", "cell")
        assert await one.begin() == ["cell"]
        for text in ("a", "b"):
            served.writer.event(NOTE._replace(text=text))
        assert await other.begin() == ["cell"]
        served.writer.event(NOTE._replace(text="c"))
        assert [(await one.next()).text for _ in range(3)] == ["a", "b", "c"]
        assert (await other.next()).text in "abc"  # its call may have come before the notes
        one.call.cancel()
        other.call.cancel()

    serve(segment, test)


def test_a_restart_of_the_sources_process_is_told(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        stream = Stream(served)
        served.writer.event(Record(Recorded.STOPPED, "told to"))
        first = served.writer.incarnation
        await stream.begin()
        served.segment.writer("cell").event(NOTE)
        found = [await stream.next() for _ in range(2)]
        assert [(one.kind, one.incarnation) for one in found] == [
            (wire.Event.KIND_STARTED, first + 1),
            (wire.Event.KIND_NOTED, first + 1),
        ]
        stream.call.cancel()

    serve(segment, test)


def test_a_client_that_does_not_read_loses_the_oldest_and_holds_up_nobody(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events_module, "LOG_BYTES", 1 << 16)
    monkeypatch.setattr(events_module, "MESSAGE_BYTES", 1 << 12)

    async def test(served: Endpoint) -> None:
        small = [("grpc.http2.bdp_probe", 0), ("grpc.http2.lookahead_bytes", 1024)]  # gRPC itself buffers little
        channel = grpc.aio.insecure_channel(f"127.0.0.1:{served.port}", small)
        silent, stream = Stream(served, channel=channel), Stream(served, "cell")
        await silent.begin()
        await stream.begin()
        total, long = 4 * EVENT_SLOTS, "x" * 250
        first = served.writer.block.events.head()
        while (await stream.next()).number < first:
            pass
        for at in range(total):
            served.writer.event(NOTE._replace(text=long))
            if at % 8 == 0:
                found = await stream.next()
                while found.number < first + at + 1:
                    found = await stream.next()
        assert found.missed == 0
        seen, lost, last = -first, 0, 0
        while last < first + total:
            event = await silent.next()
            assert event.number == last + 1 + event.missed
            seen, lost, last = seen + 1, lost + event.missed, event.number
        assert seen + lost == total
        assert lost > 0
        stream.call.cancel()
        await channel.close()

    serve(segment, test)


def test_more_events_than_the_ring_holds_are_counted(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        first = served.writer.block.events.head()
        stream = Stream(served)
        await stream.begin()
        for _ in range(EVENT_SLOTS + 50):  # the event loop does nothing else meanwhile
            served.writer.event(NOTE)
        event = await stream.next()
        assert (event.missed >= 50, event.number) == (True, first + 1 + event.missed)
        for number in range(event.number + 1, first + EVENT_SLOTS + 51):
            event = await stream.next()
            assert (event.number, event.missed) == (number, 0)
        stream.call.cancel()

    serve(segment, test)


async def stream_over_a_reload(served: Endpoint, layout: Layout | None) -> Stream:
    """Begin a stream, publish the note "last words", and reload. The stream is not read meanwhile."""
    served.writer.event(NOTE)
    stream = Stream(served)
    await stream.begin()
    served.writer.event(NOTE._replace(text="last words"))
    reload(served, layout)
    return stream


def test_a_reload_goes_on_with_the_new_block(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        stream = await stream_over_a_reload(served, OTHER)
        served.writer.event(Record(Recorded.ACCEPTED, "", 4, 1, 0, 1, 0, 0, 4, (7).to_bytes(4, "big")))
        assert (await stream.next()).text == "last words"
        started, accepted = await stream.next(), await stream.next()
        assert (started.kind, started.number, started.missed) == (wire.Event.KIND_STARTED, 1, 0)
        assert event_from_wire(accepted).values == {"cell/axis/position": 7}
        stream.call.cancel()

    serve(segment, test)


def test_of_two_reloads_at_once_the_first_is_counted_as_missed(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.writer.event(NOTE)
        stream = Stream(served)
        await stream.begin()
        reload(served, OTHER)
        served.writer.event(NOTE)
        # The endpoint has not read on meanwhile: nothing was awaited.
        (call,) = served.service._shmio_v1._event_calls._open
        between = call._moved["cell"]
        assert between is not None
        between._read()
        reload(served, OTHER)
        served.writer.event(NOTE)
        started, noted = await stream.next(), await stream.next()
        assert (started.kind, started.missed, noted.text, noted.missed) == (wire.Event.KIND_STARTED, 2, "here", 0)
        stream.call.cancel()

    serve(segment, test)


def test_a_call_that_began_with_the_new_block_stays_there(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        reload(served, OTHER)
        stream = Stream(served)
        await stream.begin()
        (call,) = served.service._shmio_v1._event_calls._open
        call.on_sources_replaced(["cell"])
        assert not call._moved
        for _ in range(3):
            served.writer.event(NOTE)
            while (await stream.next()).kind != wire.Event.KIND_NOTED:
                pass
        reload(served, OTHER)
        found = await stream.next()
        assert (found.kind, found.missed) == (wire.Event.KIND_STARTED, 0)
        stream.call.cancel()

    serve(segment, test)


def test_a_source_that_a_reload_removes_is_told_once(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        stream = await stream_over_a_reload(served, None)
        assert (await stream.next()).text == "last words"
        gone = event_from_wire(await stream.next())
        assert (gone.kind, gone.source, gone.quality) == (EventKind.REMOVED, "cell", Quality.BAD)
        assert gone.text == f"source 'cell' was removed from instance {segment.instance!r} by a reload"
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(stream.call.read(), 0.05)

    serve(segment, test)


@pytest.mark.parametrize(
    ("sources", "status", "words"),
    [
        (["nix"], Status.NOT_FOUND, "unknown source 'nix'"),
        (["cell", "x" * 9999], Status.NOT_FOUND, "unknown source"),
        (["cell"] * 257, Status.INVALID_ARGUMENT, "at most 256"),
    ],
)
def test_what_cannot_be_followed_is_refused(segment: Segment, sources: list[str], status: Any, words: str) -> None:
    async def test(served: Endpoint) -> None:
        found, text = await refusal(stub(served).Events(wire.EventsRequest(sources=sources), timeout=TIMEOUT_S).read())
        assert (found, words in text, len(text) < 500) == (status, True, True)

    serve(segment, test)


def test_the_number_of_calls_is_bounded(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events_module, "MAX_CALLS", 1)

    async def test(served: Endpoint) -> None:
        stream = Stream(served)
        await stream.begin()
        found, text = await refusal(stub(served).Events(wire.EventsRequest(), timeout=TIMEOUT_S).read())
        assert (found, "1 calls of Events are open" in text) == (Status.RESOURCE_EXHAUSTED, True)
        stream.call.cancel()

        async def begins() -> bool:
            again = Stream(served)
            try:
                return await again.begin() == ["cell"]
            except grpc.aio.AioRpcError:
                return False
            finally:
                again.call.cancel()

        await served.until(begins)

    serve(segment, test)


def test_events_that_cannot_be_read_end_the_call(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(served: Endpoint) -> None:
        stream = Stream(served)
        await stream.begin()

        def fail(_: EventReader) -> Event:
            raise struct.error("damaged")

        monkeypatch.setattr(EventReader, "next", fail)
        served.writer.event(NOTE)
        found, text = await refusal(stream.call.read())
        assert (found, "can no longer be read" in text) == (Status.RESOURCE_EXHAUSTED, True)

    serve(segment, test)


def test_events_of_other_sources_come_before_the_failure(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    segment.change([BlockSpec("press", OTHER, 20_000_000, STALE_NS, 1 << 16, Attributes("test"))])

    async def test(served: Endpoint) -> None:
        press = Feed(served.segment.blocks["press"], WRITER, served.wake_ups, lambda *_: None)
        call = EventsCall({"press": press, **served.feeds}, EventLogs(served.wake_ups), "x", [])
        messages = call.messages()
        await anext(messages)
        served.segment.writer("press").event(NOTE)
        call._places["press"].log._read()
        failing = call._places["cell"].log
        monkeypatch.setattr(failing.reader, "next", lambda: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            failing._read()
        found = wire.EventsResponse.FromString(await anext(messages))
        assert [(one.source, one.kind) for one in found.events] == [
            ("press", wire.Event.KIND_STARTED),
            ("press", wire.Event.KIND_NOTED),
        ]
        with pytest.raises(EndpointError, match="source cell: its events can no longer be read"):
            await anext(messages)
        call.close()

    serve(segment, test)


def test_a_call_that_cannot_follow_all_follows_nothing(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    segment.change([BlockSpec("press", OTHER, 20_000_000, STALE_NS, 1 << 16, Attributes("test"))])

    async def test(served: Endpoint) -> None:
        press = Feed(served.segment.blocks["press"], WRITER, served.wake_ups, lambda *_: None)
        logs, join = EventLogs(served.wake_ups), EventLogs.join

        def fail(self: EventLogs, block: Block, *arguments: Any, **named: Any) -> EventLog:
            if block.source == "press":
                raise SegmentError("damaged")
            return join(self, block, *arguments, **named)

        monkeypatch.setattr(EventLogs, "join", fail)
        with pytest.raises(SegmentError):
            EventsCall({**served.feeds, "press": press}, logs, "x", [])
        assert not logs._logs

    serve(segment, test)


def test_nothing_is_followed_while_nobody_listens(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        stream = Stream(served)
        await stream.begin()
        calls = served.service._shmio_v1._event_calls
        assert calls._logs._logs
        stream.call.cancel()

        async def over() -> bool:
            await asyncio.sleep(0)
            return not (calls._open or calls._logs._logs)

        await served.until(over)

    serve(segment, test)


@BOTH
def test_a_client_closes_it(segment: Segment, connects: Connect) -> None:
    async def test(served: Endpoint) -> None:
        async with connects(f"127.0.0.1:{served.port}") as cell, await cell.events() as events:
            served.writer.event(NOTE)
            while (await anext(events)).kind != "noted":
                pass
            waiting = asyncio.create_task(anext(events))
            asyncio.get_running_loop().call_later(0.05, events.close)
            with pytest.raises(StopAsyncIteration):
                await waiting
            with pytest.raises(PathError, match="unknown source 'nix'"):
                await cell.events("nix")
            with pytest.raises(ValueRangeError, match="at most 256"):
                await cell.events(*map(str, range(257)))
            again = await cell.events()
            await cell.close()
            assert [event async for event in again] == []

    serve(segment, test)


EVENT = Event(
    "cell", EventKind.DIVERTED, 2, 3, 4, 5, 6, -7, Quality.UNCERTAIN, "name", 1 << 63, 1 << 62, "grpc", "in",
    ("cell/a", "cell/b", "cell/c"),
    {"cell/a": [True, None], "cell/b": None, "cell/c": (1 << 64) - 1}, 9,
)  # fmt: skip


@pytest.mark.parametrize("kind", EventKind)
@pytest.mark.parametrize("direction", ["", "in", "out"])
def test_an_event_is_the_same_behind_the_wire(kind: EventKind, direction: str) -> None:
    event = Event(
        **{name: getattr(EVENT, name) for name in EVENT.__struct_fields__} | {"kind": kind, "direction": direction}
    )
    data = event_to_wire(event).SerializeToString()
    assert event_from_wire(wire.Event.FromString(data)) == event


def test_a_kind_of_a_later_version_is_some_other() -> None:
    found = wire.Event.FromString(b"\x10\x7b")
    assert (found.kind, event_from_wire(found).kind) == (123, EventKind.OTHER)


def test_an_endpoint_that_is_older_says_so(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events_module.EventCalls, "handlers", lambda _: {})

    def test(cell: Client, _: Plant, __: Endpoint) -> None:
        with pytest.raises(RemoteError, match="older"):
            cell.events()
        assert cell.sources == ["cell"]

    with_client(segment, test)
