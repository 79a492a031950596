"""Access rights over real sockets: tokens, certificates, and the roles of an address."""

from __future__ import annotations

import asyncio
import hashlib
import logging
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import grpc
import pytest
import trustme

from shmio.config import Address, Grpc, Tls, Token
from shmio.config.model import Client, Listening
from shmio.endpoints import wrong_tokens
from shmio.endpoints.grpc.server.access import NEEDS, Keys, Listener, ListenerAccess, Listeners
from shmio.endpoints.grpc.server.server import Server
from shmio.segment import Segment
from shmio.wire import simlog_v1_pb2 as wire
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, image, refusal, serve

READER, WRITER = "reader-0123456789abcdef", "writer-0123456789abcdef"
GET = "/simulation.server.SimlogAPI/GetTopic"
SUBSCRIBE = "/simulation.server.SimlogAPI/Subscribe"
PUBLISH = "/simulation.server.SimlogAPI/Publish"
STEP = wire.TopicDescriptor(path="cell/step").SerializeToString()
DENIED, UNKNOWN = grpc.StatusCode.PERMISSION_DENIED, grpc.StatusCode.UNAUTHENTICATED


def token(secret: str, *roles: str) -> Token:
    return Token(name=secret.partition("-")[0], roles=list(roles), sha256=hashlib.sha256(secret.encode()).hexdigest())


def shown(secret: str) -> list[tuple[str, str]]:
    return [("authorization", f"Bearer {secret}")]


BOTH = [token(READER, "read"), token(WRITER, "read", "write")]
LOCAL = Grpc(listen=["127.0.0.1:0"], token=BOTH)


@asynccontextmanager
async def guarded(
    served: Endpoint, listeners: Sequence[Listener], tls: Tls | None = None
) -> AsyncIterator[tuple[Server, list[int]]]:
    server = Server(served.service.calls)
    try:
        yield server, await server.start(listeners, tls)
    finally:
        await server.stop()


def call(channel: grpc.aio.Channel, method: str, request: bytes = STEP, secret: str = "") -> Any:
    multi: Any = channel.unary_unary(method)
    return multi(request, metadata=shown(secret) if secret else None, timeout=TIMEOUT_S)


def follow(channel: grpc.aio.Channel, secret: str) -> Any:
    multi: Any = channel.unary_stream(SUBSCRIBE)
    return multi(STEP, metadata=shown(secret), timeout=TIMEOUT_S)


def test_a_token_has_exactly_its_roles(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
    async def test(served: Endpoint) -> None:
        async with (
            guarded(served, Listeners(LOCAL).listeners) as (server, (port,)),
            grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel,
        ):
            assert await call(channel, GET, secret=READER)
            assert await call(channel, PUBLISH, b"", WRITER) == b""
            told, message = await refusal(call(channel, GET))
            assert told is UNKNOWN
            assert message == (
                "GetTopic needs the role read, and this address gives nothing without a token; send "
                "authorization: Bearer TOKEN with a token of [[grpc.token]]"
            )
            told, message = await refusal(call(channel, GET, secret="guessed-0123456789abcdef"))
            assert (told, message.startswith("the token is not in [[grpc.token]]")) == (UNKNOWN, True)
            told, message = await refusal(call(channel, PUBLISH, b"", READER))
            assert told is DENIED
            assert message == (
                "Publish needs the role write; token 'reader' has read; add the role to its roles in [[grpc.token]]"
            )
            get: Any = channel.unary_unary(GET)
            basic = [("authorization", f"Basic {READER}")]
            assert (await refusal(get(STEP, metadata=basic, timeout=TIMEOUT_S)))[0] is UNKNOWN
            assert server.calls.refusals.count == 4

    with caplog.at_level(logging.DEBUG):
        serve(segment, test)
    assert "call refused: the token is not in" in caplog.text
    assert not any(secret in caplog.text for secret in (READER, WRITER, "guessed-"))


def test_every_call_is_refused_without_its_role(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        nobody = Listener(Address("127.0.0.1", 0), ListenerAccess(Keys(), ()))
        names = ("simulation.", "simlog.", "grpc.health.", "grpc.reflection.")
        async with (
            guarded(served, [nobody]) as (server, (port,)),
            grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel,
        ):
            refused = 0
            for method, role in NEEDS.items():
                told, message = await refusal(call(channel, method, b""))
                if told is not grpc.StatusCode.UNIMPLEMENTED:
                    assert (told, f"needs the role {role}; this address has none" in message) == (DENIED, True), method
                    refused += method.startswith(tuple(f"/{name}" for name in names))
            assert refused >= 14
            assert len(server.calls) == 0

    serve(segment, test)


def test_a_call_without_a_table_entry_is_refused(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(NEEDS, GET)

    async def test(served: Endpoint) -> None:
        assert await refusal(call(served.channel, GET)) == (
            DENIED,
            f"{GET}: no role allows this call",
        )
        assert (await refusal(call(served.channel, "/no.Service/Call")))[0] is grpc.StatusCode.UNIMPLEMENTED

    serve(segment, test)


def test_a_reload_ends_only_the_streams_of_removed_tokens(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        listeners = Listeners(LOCAL)
        async with (
            guarded(served, listeners.listeners) as (server, (port,)),
            grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel,
        ):
            stays, goes = follow(channel, READER), follow(channel, WRITER)
            for stream in (stays, goes):
                assert wire.ROSMessage.FromString(await stream.read()).value == "1"
            new = "newone-0123456789abcdef"
            listeners.take(Grpc(listen=LOCAL.listen, token=[BOTH[0], token(new, "read")]))
            assert server.calls.review() == 1
            told, message = await refusal(goes.read())
            assert (told, message.startswith("the token is not in")) == (UNKNOWN, True)
            assert await call(channel, GET, secret=new)
            served.publish(image(step=2))
            assert wire.ROSMessage.FromString(await stays.read()).value == "2"
            listeners.take(Grpc(listen=LOCAL.listen, token=[token(READER, "write")]))
            assert server.calls.review() == 1
            assert (await refusal(stays.read()))[0] is DENIED
            listeners.take(Grpc(listen=LOCAL.listen))
            assert await call(channel, GET), "any client may read, as no tokens are configured any more"
            stays.cancel()

    serve(segment, test)


def test_an_address_gives_its_roles_to_clients_without_a_token(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        config = Grpc(listen=[], token=BOTH, address=[Listening(listen="127.0.0.1:0", roles=["read"])])
        exposed = Listener(Address("127.0.0.1", 0), ListenerAccess(Keys.of(config), ["read"], takes_tokens=False))
        async with guarded(served, [*Listeners(config).listeners, exposed]) as (_, ports):
            async with grpc.aio.insecure_channel(f"127.0.0.1:{ports[0]}") as channel:
                assert await call(channel, GET)
                told, message = await refusal(call(channel, PUBLISH, b""))
                assert (told, "this address gives read without a token" in message) == (UNKNOWN, True)
                assert await call(channel, PUBLISH, b"", WRITER) == b""
            async with grpc.aio.insecure_channel(f"127.0.0.1:{ports[1]}") as channel:
                assert await call(channel, GET)
                told, message = await refusal(call(channel, PUBLISH, b""))
                assert (told, "this address has read; add the role to the roles of the address" in message) == (
                    DENIED,
                    True,
                )
                told, message = await refusal(call(channel, GET, secret=WRITER))
                assert (told, "have this token replaced" in message) == (UNKNOWN, True)

    serve(segment, test)


def test_the_names_of_a_certificate_give_its_roles(segment: Segment, tmp_path: Path) -> None:
    authority = trustme.CA()
    server_cert = authority.issue_cert("localhost")
    server_cert.private_key_pem.write_to_path(tmp_path / "key.pem")
    server_cert.cert_chain_pems[0].write_to_path(tmp_path / "cert.pem")
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    tls = Tls(certificate=str(tmp_path / "cert.pem"), key=str(tmp_path / "key.pem"), client_ca=str(tmp_path / "ca.pem"))
    config = Grpc(
        listen=["localhost:0"],
        tls=tls,
        token=[token(WRITER, "write")],
        client=[
            Client(subject="*.lab.example", roles=["read"]),
            Client(subject=["planner", "other"], roles=["read", "write"]),
        ],
    )

    def as_client(*names: str, common_name: str | None = None) -> grpc.aio.Channel:
        shows = authority.issue_cert(*names, common_name=common_name)
        known = grpc.ssl_channel_credentials(
            authority.cert_pem.bytes(), shows.private_key_pem.bytes(), shows.cert_chain_pems[0].bytes()
        )
        return grpc.aio.secure_channel(f"localhost:{port}", known, [("grpc.use_local_subchannel_pool", 1)])

    port = 0

    async def test(served: Endpoint) -> None:
        nonlocal port
        async with guarded(served, Listeners(config).listeners, tls) as (_, (port,)):
            async with as_client("dash.lab.example") as channel:
                assert await call(channel, GET)
                told, message = await refusal(call(channel, PUBLISH, b""))
                assert (told, "the certificate of 'dash.lab.example' has read" in message) == (DENIED, True)
                assert await call(channel, PUBLISH, b"", WRITER) == b"", "the roles of certificate and token add up"
            async with as_client("x@example.org", common_name="planner") as channel:
                assert await call(channel, PUBLISH, b"") == b""
            async with as_client("dash.lab.example.evil.org") as channel:
                told, message = await refusal(call(channel, GET))
                assert (told, "send authorization: Bearer" in message) == (UNKNOWN, True)

    serve(segment, test)


def test_right_token_is_accepted_at_once_while_wrong_ones_are_slowed_down(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wrong_tokens, "DELAYS_S", (10 * TIMEOUT_S,))

    async def test(served: Endpoint) -> None:
        begun, ended = asyncio.Event(), asyncio.Event()

        async def watched(host: str) -> None:
            begun.set()
            try:
                await wrong_tokens.WrongTokens.slow_down(server.calls.wrong, host)
            finally:
                ended.set()

        async with (
            guarded(served, Listeners(LOCAL).listeners) as (server, (port,)),
            grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel,
        ):
            for _ in range(wrong_tokens.FREE):
                assert (await refusal(call(channel, GET, secret="wrong")))[0] is UNKNOWN
            monkeypatch.setattr(server.calls.wrong, "slow_down", watched)
            slowed = call(channel, GET, secret="wrong")
            await begun.wait()
            assert await call(channel, GET, secret=READER)
            assert not slowed.done()
            assert not ended.is_set()
            slowed.cancel()
            await ended.wait()  # a client that gives up leaves nothing behind

    serve(segment, test)


def test_a_caller_without_a_token_is_refused_at_once(segment: Segment) -> None:
    """The refusal comes before the call's message, which the endpoint does not read."""

    async def test(served: Endpoint) -> None:
        async with (
            guarded(served, Listeners(LOCAL).listeners) as (server, (port,)),
            grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel,
        ):
            silent: Any = channel.stream_unary(GET)(timeout=TIMEOUT_S)
            async with asyncio.timeout(TIMEOUT_S):
                assert await silent.code() is UNKNOWN
            assert len(server.calls) == 0

    serve(segment, test)
