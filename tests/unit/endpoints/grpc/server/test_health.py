"""The health service, with a standard client, and with a watcher that does not read its stream."""

from __future__ import annotations

import asyncio
from typing import Any

import grpc
from grpc_health.v1 import health_pb2 as wire
from grpc_health.v1 import health_pb2_grpc

from shmio.endpoints.grpc.server.server import Server
from shmio.segment import Segment
from tests.unit.endpoints import http2
from tests.unit.endpoints.harness import LOOPBACK, TIMEOUT_S, Endpoint, refusal, serve
from tests.unit.endpoints.rude import HEALTH

UNKNOWN, SERVING, NOT_SERVING = 3, 1, 2
CELL = wire.HealthCheckRequest(service="source.cell")
NO_WINDOW = http2.frame(http2.SETTINGS, 0, 0, b"\0\4\0\0\0\0")
"""SETTINGS_INITIAL_WINDOW_SIZE 0 (RFC 9113, 6.5.2): the server may not send any byte of a message."""


async def told(watch: Any) -> int:
    return int((await asyncio.wait_for(watch.read(), TIMEOUT_S)).status)


def test_watchers_receive_changes_and_the_end(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        server = Server(served.service.calls)
        [port] = await server.start([LOOPBACK])
        async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
            stub: Any = health_pb2_grpc.HealthStub(channel)
            status, text = await refusal(stub.Check(CELL, timeout=TIMEOUT_S))
            assert (status, text) == (grpc.StatusCode.NOT_FOUND, "'source.cell': no such service")
            watch, overall = (
                stub.Watch(request, timeout=TIMEOUT_S) for request in (CELL, wire.HealthCheckRequest(service=""))
            )
            assert (await told(watch), await told(overall)) == (UNKNOWN, SERVING)
            for good, shown in ((True, SERVING), (False, NOT_SERVING), (True, SERVING)):
                await server.set_source("cell", good)
                assert await told(watch) == shown
            stopping = asyncio.create_task(server.stop())
            assert (await told(watch), await told(overall)) == (NOT_SERVING, NOT_SERVING)
            await stopping
            await server.set_source("cell", True)

    serve(segment, test)


def test_a_watcher_that_does_not_read_delays_no_other(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        server = Server(served.service.calls)
        [port] = await server.start([LOOPBACK])
        await server.set_source("cell", True)
        connection = await http2.Connection.open(port)
        await connection.send(NO_WINDOW + http2.call(HEALTH + "Watch", CELL.SerializeToString()))

        async def watched() -> bool:
            await asyncio.sleep(0)
            return len(server.calls) == 1

        await served.until(watched)
        async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel, asyncio.timeout(TIMEOUT_S):
            stub: Any = health_pb2_grpc.HealthStub(channel)
            for good, shown in ((False, NOT_SERVING), (True, SERVING)):
                await server.set_source("cell", good)
                assert (await stub.Check(CELL)).status == shown
            await server.stop()
        await connection.drop(reset=True)

    serve(segment, test)
