"""With ``client_ca``, a client without a valid certificate of that authority cannot make a call."""

from __future__ import annotations

import asyncio
import datetime
import socket
import ssl
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import grpc
import pytest
import trustme

from shmio.config import Address, Tls
from shmio.endpoints.grpc.server.server import Server
from shmio.segment import Segment
from shmio.testing.flood import Flood
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from tests.unit.endpoints.harness import LOOPBACK, TIMEOUT_S, Endpoint, code, serve

DAY = datetime.timedelta(days=1)
NOW = datetime.datetime.now(datetime.UTC)
Certificate = trustme.LeafCert | None


class Party:
    """The certificate authorities of the endpoint, and clients with certificates of several kinds."""

    def __init__(self, folder: Path) -> None:
        self.server, self.clients = trustme.CA(), trustme.CA()
        certificate = self.server.issue_cert("localhost")
        certificate.private_key_pem.write_to_path(folder / "key.pem")
        certificate.cert_chain_pems[0].write_to_path(folder / "cert.pem")
        self.clients.cert_pem.write_to_path(folder / "ca.pem")
        self.tls = Tls(certificate=f"{folder}/cert.pem", key=f"{folder}/key.pem", client_ca=f"{folder}/ca.pem")

    @asynccontextmanager
    async def channel(self, port: int, own: Certificate) -> AsyncIterator[grpc.aio.Channel]:
        """Open a channel that presents this certificate."""
        parts = () if own is None else (own.private_key_pem.bytes(), b"".join(p.bytes() for p in own.cert_chain_pems))
        credentials = grpc.ssl_channel_credentials(self.server.cert_pem.bytes(), *parts)
        options = [("grpc.use_local_subchannel_pool", 1)]
        async with grpc.aio.secure_channel(f"localhost:{port}", credentials, options) as channel:
            yield channel

    async def known(self, port: int) -> bool:
        """Return whether a client with a valid certificate is served."""
        async with self.channel(port, self.clients.issue_cert("twin@example.org")) as channel:
            stub: Any = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
            answer = await stub.GetTopic(TopicDescriptor(path="cell/step"), timeout=TIMEOUT_S)
            return bool(answer.msgType == "int")


INTRUDERS: dict[str, Callable[[Party], Certificate]] = {
    "no certificate": lambda _: None,
    "another authority": lambda _: trustme.CA().issue_cert("twin@example.org"),
    "the server's authority": lambda party: party.server.issue_cert("twin@example.org"),
    "expired": lambda party: party.clients.issue_cert(
        "twin@example.org", not_before=NOW - 9 * DAY, not_after=NOW - DAY
    ),
    "not valid yet": lambda party: party.clients.issue_cert("twin@example.org", not_before=NOW + DAY),
}


@pytest.mark.parametrize("intruder", INTRUDERS)
def test_a_client_without_a_valid_certificate_cannot_make_calls(
    segment: Segment, tmp_path: Path, intruder: str, capfd: pytest.CaptureFixture[str]
) -> None:
    party = Party(tmp_path)

    async def test(served: Endpoint) -> None:
        server = Server(served.service.calls)
        (port,) = await server.start([LOOPBACK._replace(address=Address("localhost", 0), encrypted=True)], party.tls)
        async with party.channel(port, INTRUDERS[intruder](party)) as channel:
            stub: Any = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
            topic = TopicDescriptor(path="cell/step")
            assert await code(stub.GetTopic(topic, timeout=TIMEOUT_S)) is grpc.StatusCode.UNAVAILABLE
            unknown: Any = channel.unary_unary("/no/such")
            assert await code(unknown(b"", timeout=TIMEOUT_S)) is grpc.StatusCode.UNAVAILABLE
        assert await party.known(port)
        assert (server.unknown, len(server.calls)) == (0, 0)
        await server.stop()

    serve(segment, test)
    assert "Traceback" not in capfd.readouterr().err


def test_failed_handshakes_do_not_disturb_other_clients(segment: Segment, tmp_path: Path) -> None:
    party = Party(tmp_path)
    context = ssl.create_default_context()
    context.set_alpn_protocols(["h2"])
    party.server.configure_trust(context)

    def break_off(port: int) -> None:
        """Send part of a handshake, then end or reset the connection."""
        for number in range(20):
            with socket.create_connection(("localhost", port)) as connection:
                connection.sendall(b"\x16\x03\x01\x02\0\x01\0\x01\xfc\x03\x03"[: 1 + number % 11])

    async def test(served: Endpoint) -> None:
        server = Server(served.service.calls)
        (port,) = await server.start([LOOPBACK._replace(address=Address("localhost", 0), encrypted=True)], party.tls)
        flood = Flood()
        with flood.upon(("localhost", port), context):
            async with asyncio.timeout(TIMEOUT_S):
                while flood.lost < 20:  # noqa: ASYNC110  another thread changes it
                    await asyncio.sleep(0.01)
            await asyncio.to_thread(break_off, port)
            assert await party.known(port)
        assert flood.answered == server.unknown == 0
        await server.stop()

    serve(segment, test)
