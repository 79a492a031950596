"""A server that nobody can stop from outside."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import grpc
import pytest

from shmio.config import Address, UnixAddress
from shmio.endpoints.grpc import server as module
from shmio.endpoints.grpc.access import Door, Keys
from shmio.endpoints.grpc.doors import Listener
from shmio.endpoints.grpc.server import Server
from shmio.segment import Segment
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from tests.unit.endpoints import http2
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, image, serve, value
from tests.unit.endpoints.rude import CALLS

NO_TEXT = http2.headers("/?").replace(b"/?", b"/\xff")
"""Of a call whose name is not UTF-8."""


async def known(channel: grpc.aio.Channel) -> bool:
    stub: Any = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
    topic = await stub.GetTopic(TopicDescriptor(path="cell/step"), timeout=TIMEOUT_S, wait_for_ready=True)
    return bool(topic.msgType == "int")


def told(caplog: pytest.LogCaptureFixture, times: int) -> Callable[[], Awaitable[bool]]:
    """Whether it has begun to listen anew as often as that."""

    async def said() -> bool:
        await asyncio.sleep(0)
        return sum("listens anew" in record.getMessage() for record in caplog.records) == times

    return said


def fresh(target: str) -> grpc.aio.Channel:
    """A connection of its own, tried again at once."""
    options = [("grpc.use_local_subchannel_pool", 1), ("grpc.max_reconnect_backoff_ms", 100)]
    return grpc.aio.insecure_channel(target, options)


def test_a_call_whose_name_is_no_text_stops_nobody(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        stream = served.subscribe("cell/step")
        assert await value(stream) == "1"
        for number in range(2, 5):
            connection = await http2.Connection.open(served.port)
            await connection.send(NO_TEXT)
            await served.until(told(caplog, number - 1))
            await connection.drop(reset=True)
            served.publish(image(step=number))
            assert await value(stream) == str(number), "what is open goes on"
            async with fresh(f"127.0.0.1:{served.port}") as channel:
                assert await known(channel)
            assert served.server.alive
        stream.cancel()

    serve(segment, test)
    caplog.clear()  # what gRPC has logged holds the exceptions, and these the connections


def test_on_a_unix_socket_neither(segment: Segment, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "s"

    async def test(served: Endpoint) -> None:
        server = Server(served.service)
        await server.start([Listener(UnixAddress(str(file)), Door(Keys()))])
        served.publish(image(step=1))
        before = fresh(f"unix:{quote(str(file))}")
        stub: Any = SimlogAPIStub(before)  # type: ignore[no-untyped-call]
        stream = stub.Subscribe(TopicDescriptor(path="cell/step"), timeout=TIMEOUT_S)
        assert await value(stream) == "1"
        for times in (1, 2):
            _, writer = await asyncio.open_unix_connection(file)
            writer.write(http2.PREFACE + http2.frame(http2.SETTINGS, 0, 0, b"") + NO_TEXT)
            await served.until(told(caplog, times))
            writer.close()
            async with fresh(f"unix:{quote(str(file))}") as channel:
                assert await known(channel)
        served.publish(image(step=2))
        assert await value(stream) == "2"
        await server.stop()
        assert os.listdir(tmp_path) == []  # noqa: PTH208
        with pytest.raises(grpc.aio.AioRpcError):  # it was open all the time
            await stream.read()
        await before.close()

    serve(segment, test)
    caplog.clear()


def test_headers_that_are_no_text_leave_nothing_in_the_log(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
    field = b"\0\1x\2\xff\xfe"

    async def test(served: Endpoint) -> None:
        connection = await http2.Connection.open(served.port)
        block = http2.headers(CALLS[0].method)[9:] + field
        await connection.send(http2.frame(http2.HEADERS, http2.END_HEADERS, 1, block))
        await connection.send(http2.frame(http2.DATA, http2.END_STREAM, 1, http2.message(CALLS[0].request)))
        await connection.until_end(1)
        await connection.drop(reset=True)

    serve(segment, test)
    assert not [record for record in caplog.records if record.exc_info]


def test_it_listens_anew_only_when_the_one_before_has_closed(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """However late a busy machine lets it close: gRPC ends in a segmentation fault when it finds the port taken."""
    looks: list[bool] = []
    taken = module.taken

    def busy(address: Address | UnixAddress) -> bool:
        looks.append(len(looks) < 5 or taken(address))
        return looks[-1]

    monkeypatch.setattr(module, "taken", busy)

    async def test(served: Endpoint) -> None:
        connection = await http2.Connection.open(served.port)
        await connection.send(NO_TEXT)
        await served.until(told(caplog, 1))
        await connection.drop(reset=True)
        async with fresh(f"127.0.0.1:{served.port}") as channel:
            assert await known(channel)
        assert looks[:5] == [True] * 5
        assert looks[-1] is False
        assert served.server.alive

    serve(segment, test)
    caplog.clear()


def test_an_address_is_taken_as_long_as_somebody_listens_there(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = Address(*listener.getsockname())
        assert module.taken(address)
        with socket.create_connection(listener.getsockname()):
            accepted, _ = listener.accept()
    with accepted:
        assert not module.taken(address), "a connection that is left from it does not count"
    file = UnixAddress(str(tmp_path / "s"))
    assert not module.taken(file)
    with socket.socket(socket.AF_UNIX) as local:
        local.bind(file.path)
        local.listen()
        assert module.taken(file)
    assert not module.taken(file)
