"""Clients cannot stop the server, whatever they call."""

from __future__ import annotations

import asyncio
import logging
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import grpc
import pytest
import trustme

from shmio.config import Address, Tls, UnixAddress
from shmio.endpoints.grpc.server.server import Server
from shmio.errors import EndpointError
from shmio.segment import Segment
from shmio.testing.flood import UNKNOWN, Flood
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from tests.unit.endpoints import http2
from tests.unit.endpoints.harness import LOOPBACK, TIMEOUT_S, Endpoint, code, endpoint, image, serve, value
from tests.unit.endpoints.rude import CALLS


async def known(channel: grpc.aio.Channel) -> bool:
    stub: Any = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
    topic = await stub.GetTopic(TopicDescriptor(path="cell/step"), timeout=TIMEOUT_S, wait_for_ready=True)
    return bool(topic.msgType == "int")


async def refused(server: Server, flood: Flood, calls: int) -> None:
    """Wait until this many more calls were refused."""
    until = flood.answered + calls
    async with asyncio.timeout(TIMEOUT_S):
        while flood.answered < until:  # noqa: ASYNC110  another thread changes it
            await asyncio.sleep(0.01)
    assert server.unknown >= until
    assert server.alive


def test_calls_to_unknown_methods_do_not_stop_the_server(
    segment: Segment, tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    """The calls come by TCP, by TLS and by a UNIX socket."""
    authority = trustme.CA()
    certificate = authority.issue_cert("localhost")
    certificate.private_key_pem.write_to_path(tmp_path / "key.pem")
    certificate.cert_chain_pems[0].write_to_path(tmp_path / "cert.pem")
    tls = Tls(certificate=str(tmp_path / "cert.pem"), key=str(tmp_path / "key.pem"))
    context = ssl.create_default_context()
    context.set_alpn_protocols(["h2"])
    authority.configure_trust(context)
    file = str(tmp_path / "s")

    async def test(served: Endpoint) -> None:
        server = Server(served.service.calls)
        listeners = [
            LOOPBACK,
            LOOPBACK._replace(address=Address("localhost", 0), encrypted=True),
            LOOPBACK._replace(address=UnixAddress(file)),
        ]
        plain, encrypted, _ = await server.start(listeners, tls)
        trusted = grpc.ssl_channel_credentials(authority.cert_pem.bytes())
        options = [("grpc.use_local_subchannel_pool", 1)]
        ways: list[tuple[tuple[str, int] | str, ssl.SSLContext | None, Callable[[], grpc.aio.Channel]]] = [
            (("127.0.0.1", plain), None, lambda: grpc.aio.insecure_channel(f"127.0.0.1:{plain}", options)),
            (
                ("localhost", encrypted),
                context,
                lambda: grpc.aio.secure_channel(f"localhost:{encrypted}", trusted, options),
            ),
            (file, None, lambda: grpc.aio.insecure_channel(f"unix:{quote(file)}", options)),
        ]
        for number, (target, trust, channel) in enumerate(ways):
            served.publish(image(step=number))
            async with channel() as before:
                stub: Any = SimlogAPIStub(before)  # type: ignore[no-untyped-call]
                stream = stub.Subscribe(TopicDescriptor(path="cell/step"), timeout=TIMEOUT_S)
                assert await value(stream) == str(number)
                flood = Flood()
                with flood.upon(target, trust):
                    await refused(server, flood, 100)
                    assert await known(before)
                    async with channel() as after:
                        assert await known(after)
                        call: Any = after.unary_unary(UNKNOWN.decode())
                        assert await code(call(b"", timeout=TIMEOUT_S)) is grpc.StatusCode.UNIMPLEMENTED
                    served.publish(image(step=number + 100))
                    assert await value(stream) == str(number + 100), "open streams continue"
                    await refused(server, flood, 100)
                assert flood.lost == 0
                stream.cancel()
        await server.stop()

    serve(segment, test)
    assert [record.message for record in caplog.records if record.exc_info or record.levelno >= logging.WARNING] == []
    assert "Traceback" not in capfd.readouterr().err


def test_grpcio_without_the_needed_internals_is_refused_at_start(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def test(served: Endpoint) -> None:
        with pytest.raises(EndpointError, match=r"grpcio \S+ does not have _ServicerContext.* install another version"):
            await Server(served.service.calls).start([LOOPBACK])

    async def run() -> None:
        async with endpoint(segment) as served:
            monkeypatch.delattr("grpc._cython.cygrpc._ServicerContext")
            await test(served)
            monkeypatch.undo()

    asyncio.run(run())


def test_a_stopped_server_is_not_alive(segment: Segment) -> None:
    """The endpoint's process then exits, because gRPC does not survive a second server in one process."""

    async def test(served: Endpoint) -> None:
        assert served.server.alive
        await served.server.stop()
        assert not served.server.alive

    serve(segment, test)


def test_undecodable_headers_log_nothing(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
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
