"""Limits on open calls, and messages that cannot be decoded."""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import Any

import grpc
import pytest

from shmio.endpoints.grpc.server.access import NEEDS, client_of
from shmio.endpoints.grpc.server.call_guard import LINES, CallLimits, Refusals, check_version, cygrpc
from shmio.errors import EndpointError
from shmio.segment import Segment
from shmio.wire import simlog_v1_pb2 as wire
from tests.unit.endpoints import http2
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, image, refusal, serve, value

GET = "/simulation.server.SimlogAPI/GetTopic"
STEP = wire.TopicDescriptor(path="cell/step")


class Another:
    """A client with its own connection."""

    def __init__(self, served: Endpoint) -> None:
        self._channel = grpc.aio.insecure_channel(f"127.0.0.1:{served.port}", [("grpc.use_local_subchannel_pool", 1)])
        self._subscribe = self._channel.unary_stream(
            "/simulation.server.SimlogAPI/Subscribe", wire.TopicDescriptor.SerializeToString, wire.ROSMessage.FromString
        )
        self.streams: list[Any] = []

    async def open(self, count: int) -> None:
        """Open streams one after another."""
        for _ in range(count):
            stream = self._subscribe(STEP, timeout=TIMEOUT_S)
            self.streams.append(stream)
            await stream.initial_metadata()

    async def refused(self) -> str:
        stream = self._subscribe(STEP, timeout=TIMEOUT_S)
        told, message = await refusal(stream.read())
        assert told is grpc.StatusCode.RESOURCE_EXHAUSTED
        return message

    async def close(self) -> None:
        for stream in self.streams:
            stream.cancel()
        await self._channel.close()


def test_connections_beyond_the_limit_are_closed_and_open_ones_continue(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image())
        polite = Another(served)
        await polite.open(1)
        assert await value(polite.streams[0])
        idle = [await http2.Connection.open(served.port) for _ in range(2)]
        for _ in range(3):
            reader, writer = await asyncio.open_connection("127.0.0.1", served.port)
            with suppress(ConnectionResetError):
                async with asyncio.timeout(TIMEOUT_S):
                    assert await reader.read() == b"", "it gets no greeting"
            writer.close()
            with suppress(ConnectionResetError):
                await writer.wait_closed()
        await polite.open(1)
        assert await value(polite.streams[1]), "open streams continue"
        await idle[0].drop(reset=True)

        async def room() -> bool:
            reader, writer = await asyncio.open_connection("127.0.0.1", served.port)
            writer.write(http2.PREFACE + http2.frame(http2.SETTINGS, 0, 0, b""))
            try:
                async with asyncio.timeout(TIMEOUT_S):
                    return bool(await reader.read(1))
            except ConnectionResetError:
                return False
            finally:
                writer.transport.abort()

        await served.until(room)
        await idle[1].drop(reset=True)
        await polite.close()

    serve(segment, test, CallLimits(connections=3))


async def until_calls(served: Endpoint, count: int) -> None:
    async def reached() -> bool:
        await asyncio.sleep(0)
        return len(served.server.calls) == count

    await served.until(reached)


def test_one_client_cannot_take_all_calls_and_their_total_is_limited(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        clients = [Another(served) for _ in range(3)]
        greedy, other, last = clients
        await greedy.open(8)
        assert await greedy.refused() == (
            "this client has 8 calls open, and the last 4 of 12 calls are for clients with fewer than 2; use SimlogAPI "
            "version 2 (one stream for all topics)"
        )
        await other.open(2)
        assert "this client has 2 calls open" in await other.refused()
        await last.open(2)
        extra = Another(served)
        assert await extra.refused() == "12 calls are open, which is the maximum; try again when others have ended"
        assert served.server.calls.refusals.count == 3
        served.publish(image(step=2))
        assert [await value(stream) for stream in (*other.streams, *last.streams)] == ["1"] * 4
        assert [await value(stream) for stream in (*other.streams, *last.streams)] == ["2"] * 4
        greedy.streams.pop().cancel()
        await until_calls(served, 11)
        await extra.open(1)
        for client in (*clients, extra):
            await client.close()
        await until_calls(served, 0)

    serve(segment, test, CallLimits(calls=12, reserve=4, share=2))


def test_the_limits_hold_as_documented(segment: Segment) -> None:
    """The limits are those of docs/reference/grpc-access.md.

    The endpoint has 4,096 calls, of which one client leaves 1,024 to others.
    """

    async def test(served: Endpoint) -> None:
        method, request = "/simulation.server.SimlogAPI/Subscribe", STEP.SerializeToString()
        greedy, *others = [await http2.Connection.open(served.port) for _ in range(17)]
        reading = asyncio.create_task(greedy.reader.read())
        calls = [http2.call(method, request, 2 * number + 1) for number in range(3073)]
        await greedy.send(b"".join(calls[:3072]))  # in one burst, of which no call is lost
        await until_calls(served, 3072)
        await greedy.send(calls[3072])
        await refused(served, 1)
        for number, other in enumerate(others, start=1):
            await other.send(b"".join(calls[:64]))
            await until_calls(served, 3072 + 64 * number)
        extra = Another(served)
        assert (await extra.refused()).startswith("4096 calls are open")
        await extra.close()
        for connection in (greedy, *others):
            await connection.drop(reset=True)
        reading.cancel()
        await until_calls(served, 0)

    serve(segment, test)


async def refused(served: Endpoint, count: int) -> None:
    async def reached() -> bool:
        await asyncio.sleep(0)
        return served.server.calls.refusals.count == count

    await served.until(reached)


def test_a_call_that_sends_no_message_is_ended(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        silent: Any = served.channel.stream_unary(GET)(timeout=TIMEOUT_S)
        assert await refusal(silent) == (
            grpc.StatusCode.DEADLINE_EXCEEDED,
            f"{GET}: the client sent no message within 0.05 s",
        )
        closed: Any = served.channel.stream_unary(GET)(timeout=TIMEOUT_S)
        await closed.done_writing()
        assert await refusal(closed) == (grpc.StatusCode.INVALID_ARGUMENT, f"{GET}: the client sent no message")
        await until_calls(served, 0)

    serve(segment, test, CallLimits(message_s=0.05))


PUBLISHES = [method for method in NEEDS if method.endswith("/Publish")]


def test_undecodable_bytes_are_refused_without_a_log_line(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
    """Publish is not tested here, because it skips such messages. Its own tests check that."""
    methods = [method for method in NEEDS if method not in PUBLISHES]

    async def test(served: Endpoint) -> None:
        refused = 0
        for method in methods:
            call: Any = served.channel.unary_unary(method)
            told, message = await refusal(call(b"\xff" * 7, timeout=TIMEOUT_S))
            if told is not grpc.StatusCode.UNIMPLEMENTED:  # it takes no message, or is not served yet
                assert (told, message) == (
                    grpc.StatusCode.INVALID_ARGUMENT,
                    f"{method}: 7 bytes are not a valid message of this call",
                )
                refused += 1
            await until_calls(served, 0)
        assert refused > len(methods) / 2

    with caplog.at_level(logging.ERROR):
        serve(segment, test)
    assert not caplog.records


@pytest.mark.parametrize(
    ("peer", "token", "client"),
    [
        ("ipv4:127.0.0.1:5001", None, "ipv4:127.0.0.1:5001"),
        ("ipv6:%5B::1%5D:5001", None, "ipv6:%5B::1%5D:5001"),
        ("unix:", None, "unix:"),
        ("ipv4:10.0.0.5:5001", None, "ipv4:10.0.0.5"),
        ("ipv6:%5Bfe80::1%5D:5001", None, "ipv6:%5Bfe80::1%5D"),
        ("ipv4:10.0.0.5:5001", "dash", "token dash"),
    ],
)
def test_clients_are_counted_by_token_host_or_local_connection(peer: str, token: str | None, client: str) -> None:
    assert client_of(peer, token) == client


def test_refusals_beyond_a_few_lines_are_logged_as_a_count(caplog: pytest.LogCaptureFixture) -> None:
    async def test() -> None:
        refusals = Refusals(turn_s=0.01)
        for number in range(3 * LINES):
            refusals.add(f"reason {number}", "cell/a", "ipv4:127.0.0.1:5")
        assert refusals.count == 3 * LINES
        assert [record.getMessage() for record in caplog.records] == [
            f"publish refused: reason {number}" for number in range(LINES)
        ]
        async with asyncio.timeout(20):
            while len(caplog.records) <= LINES:  # noqa: ASYNC110  waits for a log line
                await asyncio.sleep(0)
        assert caplog.records[-1].getMessage() == f"publish refused: {2 * LINES} more times in 0.01 s"
        refusals.add("once more", "cell/a", "ipv4:127.0.0.1:5")
        assert caplog.records[-1].getMessage() == "publish refused: once more"

    with caplog.at_level(logging.WARNING):
        asyncio.run(test())


def test_bytes_of_answers_and_streams_are_counted(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=7))
        async with grpc.aio.insecure_channel(f"127.0.0.1:{served.port}") as channel:
            get: Any = channel.unary_unary(GET, wire.TopicDescriptor.SerializeToString)
            answer = await get(STEP, timeout=TIMEOUT_S)
            assert served.server.calls.sent_bytes == len(answer) > 0
            with pytest.raises(grpc.aio.AioRpcError):
                await get(wire.TopicDescriptor(path="cell/nothing"), timeout=TIMEOUT_S)
            subscribe: Any = channel.unary_stream(
                "/simulation.server.SimlogAPI/Subscribe", wire.TopicDescriptor.SerializeToString
            )
            stream = subscribe(STEP, timeout=TIMEOUT_S)
            sent = len(answer) + len(await stream.read())
            served.publish(image(step=30_000))
            sent += len(await stream.read())
            assert served.server.calls.sent_bytes == sent
            stream.cancel()

    serve(segment, test)


def test_a_version_of_grpcio_with_other_private_functions_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    check_version()
    monkeypatch.setattr(cygrpc, "_schedule_rpc_coro", lambda rpc_coro, loop: None)
    monkeypatch.delattr(cygrpc, "get_working_loop")
    with pytest.raises(EndpointError, match=r"_schedule_rpc_coro\(rpc_coro, rpc_state.*get_working_loop.*tested"):
        check_version()
