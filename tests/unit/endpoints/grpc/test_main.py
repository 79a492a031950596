"""The endpoint's process, without its supervisor."""

from __future__ import annotations

import asyncio
import itertools
import logging
import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import grpc
import pytest

from shmio.endpoints.grpc.__main__ import _follow, _take_anew, run
from shmio.segment import Segment
from shmio.segment.processes import COUNTERS
from shmio.testing.ports import reserved_port
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as SimlogV2Stub
from tests.unit.endpoints.harness import TIMEOUT_S

STREAMS = 20


def test_no_call_starts_between_new_feeds_and_the_move_of_open_calls() -> None:
    done: list[str] = []

    class ReloadedFeeds:
        async def follow(self) -> list[str]:
            await asyncio.to_thread(lambda: None)
            asyncio.get_running_loop().call_soon(done.append, "call")
            done.append("feeds")
            return ["cell"]

    async def test() -> None:
        feeds: Any = ReloadedFeeds()
        services: Any = SimpleNamespace(on_sources_replaced=lambda sources: done.append(f"move {sources}"))
        worker: Any = SimpleNamespace(log=logging.getLogger("test"))
        await asyncio.create_task(_follow(worker, feeds, services))
        await asyncio.sleep(0)

    asyncio.run(test())
    assert done == ["feeds", "move ['cell']", "call"]


def test_the_heartbeat_continues_while_layouts_are_read(
    segment: Segment, instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a heartbeat, the supervisor would kill the endpoint during a reload of large layouts."""
    begun, going_on = threading.Event(), threading.Event()
    stops: list[Callable[[], object]] = []
    beats: list[object] = []

    def report(counters: object) -> None:
        if begun.is_set():
            beats.append(counters)
        if len(beats) == 3:
            going_on.set()
            stops[0]()

    with Segment.open(instance, writable=True) as opened:
        refresh = opened.refresh

        def slow() -> bool:
            begun.set()
            assert going_on.wait(TIMEOUT_S)
            return refresh()

        monkeypatch.setattr(opened, "refresh", slow)
        worker: Any = SimpleNamespace(
            on_stop=stops.append,
            config={"listen": ["127.0.0.1:0"]},
            slot=opened.processes.find("grpc"),
            before=opened.processes.find("grpc").report,
            segment=opened,
            log=logging.getLogger("test"),
            running=lambda: None,
            report=report,
            report_readers=lambda readers: None,
        )
        run(worker)
    assert len(beats) >= 3


def test_a_stop_with_open_streams_leaves_no_traceback(
    segment: Segment, instance: str, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    """The streams are of both versions, and one client is still publishing."""
    stops: list[Callable[[], object]] = []
    ends: queue.SimpleQueue[grpc.StatusCode] = queue.SimpleQueue()
    over = threading.Event()

    def report(counters: tuple[int, ...]) -> None:
        known = dict(zip(COUNTERS["grpc"], counters, strict=True))
        if known["streams"] == 2 * STREAMS:
            stops[0]()

    def publishing() -> Iterator[v1.PubRequest]:
        yield v1.PubRequest(topic=v1.TopicDescriptor(path="cell/secret"))
        over.wait(TIMEOUT_S)

    def read(stream: Any) -> None:
        try:
            for _ in stream:
                pass
        except grpc.RpcError:
            ends.put(stream.code())

    with Segment.open(instance, writable=True) as opened, reserved_port() as address, ExitStack() as stack:
        channel = stack.enter_context(grpc.insecure_channel(str(address)))
        first: Any = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        second: Any = SimlogV2Stub(channel)  # type: ignore[no-untyped-call]

        def begin() -> None:
            for number in range(STREAMS):
                streams = (
                    first.Subscribe(v1.TopicDescriptor(path="cell/step" + number % 2 * "/in"), timeout=TIMEOUT_S),
                    second.CreateSubscriber(v2.Subscriber(name="test", uuid=str(number)), timeout=TIMEOUT_S),
                )
                for stream in streams:
                    threading.Thread(target=read, args=(stream,)).start()
            first.Publish.future(publishing(), timeout=TIMEOUT_S)

        worker: Any = SimpleNamespace(
            on_stop=stops.append,
            config={"listen": [str(address)]},
            slot=opened.processes.find("grpc"),
            before=opened.processes.find("grpc").report,
            segment=opened,
            log=logging.getLogger("test"),
            running=begin,
            report=report,
            report_readers=lambda readers: None,
        )
        run(worker)
        over.set()
        codes = [ends.get(timeout=TIMEOUT_S) for _ in range(2 * STREAMS)]
    assert set(codes) <= {grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED}
    assert "Traceback" not in capfd.readouterr().err
    assert [record.message for record in caplog.records if record.levelno >= logging.ERROR] == []


class Turn(asyncio.Lock):
    """A lock that signals when a task waits for it."""

    def __init__(self) -> None:
        super().__init__()
        self.waited_for = asyncio.Event()

    async def acquire(self) -> Literal[True]:
        if self.locked():
            self.waited_for.set()
        return await super().acquire()


def test_of_two_concurrent_reloads_the_later_one_applies(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second reload starts while the first reads its file. A token that the second removes must not return."""
    begun, going_on = threading.Event(), threading.Event()
    numbers = itertools.count()
    taken: list[int] = []

    def load(_: Path) -> SimpleNamespace:
        number = next(numbers)
        if not number:
            begun.set()
            assert going_on.wait(TIMEOUT_S)
        return SimpleNamespace(grpc=SimpleNamespace(number=number, token=[], guarded=True))

    async def test() -> None:
        worker: Any = SimpleNamespace(log=logging.getLogger("test"))
        listeners: Any = SimpleNamespace(take=lambda grpc: taken.append(grpc.number))
        server: Any = SimpleNamespace(calls=SimpleNamespace(review=lambda: 0))
        turn = Turn()
        first = asyncio.create_task(_take_anew(worker, Path("x"), listeners, server, turn))
        assert await asyncio.to_thread(begun.wait, TIMEOUT_S)
        second = asyncio.create_task(_take_anew(worker, Path("x"), listeners, server, turn))
        waits = asyncio.create_task(turn.waited_for.wait())
        await asyncio.wait((second, waits), return_when=asyncio.FIRST_COMPLETED)  # without the lock it would be done
        going_on.set()
        await asyncio.gather(first, second)
        waits.cancel()

    monkeypatch.setattr("shmio.endpoints.grpc.__main__.load", load)
    asyncio.run(test())
    assert taken == [0, 1]
