"""Encrypted channels, client certificates and passwords."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyAes256Sha256RsaPss, SecurityPolicyBasic256Sha256

from shmio.config import Token
from shmio.config.model import Client as TrustedClient
from shmio.segment import Segment
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.opcua.certificates import self_signed
from tests.unit.endpoints.opcua.harness import TIMEOUT_S, Served, node, serve
from tests.unit.endpoints.opcua.test_writing import PASSWORD, status

CLIENT = "urn:test:client"


@pytest.fixture
def identity(tmp_path: Path) -> dict[str, str]:
    certificate, key = self_signed(tmp_path, "urn:test:server")
    return {"certificate": str(certificate), "key": str(key)}


async def encrypted(one: Served, shown: tuple[Path, Path], policy: type = SecurityPolicyBasic256Sha256) -> Client:
    client = Client(one.url, timeout=TIMEOUT_S)
    client.application_uri = CLIENT
    await client.set_security(policy, *map(str, shown), mode=ua.MessageSecurityMode.SignAndEncrypt)
    return client


def test_a_trusted_certificate_gives_its_roles_and_no_other_opens_a_channel(
    segment: Segment, identity: dict[str, str], tmp_path: Path
) -> None:
    known = self_signed(tmp_path, CLIENT, "panel")
    (tmp_path / "other").mkdir()
    stranger = self_signed(tmp_path / "other", CLIENT, "panel")

    async def test(one: Served) -> None:
        one.publish(image(step=4))
        for policy in (SecurityPolicyBasic256Sha256, SecurityPolicyAes256Sha256RsaPss):
            async with await encrypted(one, known, policy) as client:
                assert await node(client, "cell/step").read_value() == 4
                assert await status(node(client, "cell/step"), 1, ua.VariantType.Int16) == "BadUserAccessDenied"
        with pytest.raises((ua.UaError, ConnectionError, TimeoutError)):
            async with await encrypted(one, stranger):
                pass
        assert one.endpoint.server.iserver.sessions == 0

    trusted = {"trusted": [str(known[0])], "client": [TrustedClient(subject="pan*", roles=["read"])]}
    serve(segment, test, **identity, **trusted)


def test_a_channel_without_security_only_tells_which_ones_there_are(segment: Segment, identity: dict[str, str]) -> None:
    """The library itself would let everybody create a session on such a channel, whatever its policies are."""

    async def test(one: Served) -> None:
        client = Client(one.url, timeout=TIMEOUT_S)
        found = await client.connect_and_get_server_endpoints()
        assert {one.SecurityMode for one in found} == {ua.MessageSecurityMode.SignAndEncrypt}
        await client.connect_socket()
        await client.send_hello()
        await client.open_secure_channel()
        with pytest.raises(ua.UaStatusCodeError) as refused:
            await client.uaclient.create_session(ua.CreateSessionParameters(RequestedSessionTimeout=60_000))
        assert refused.value.code == ua.StatusCodes.BadSecurityPolicyRejected
        client.disconnect_socket()
        assert one.endpoint.server.iserver.sessions == 0

    serve(segment, test, **identity)


def test_a_password_on_an_encrypted_channel(segment: Segment, identity: dict[str, str], tmp_path: Path) -> None:
    account = Token(name="operator", roles=["read"], sha256=hashlib.sha256(PASSWORD.encode()).hexdigest())

    async def test(one: Served) -> None:
        one.publish(image(step=4))
        shown = self_signed(tmp_path, CLIENT)
        for password, accepted in ((PASSWORD, True), (PASSWORD + "x", False)):
            client = await encrypted(one, shown)
            client.set_user("operator")
            client.set_password(password)
            if accepted:
                async with client:
                    assert await node(client, "cell/step").read_value() == 4
            else:
                with pytest.raises(ua.UaStatusCodeError):
                    await client.connect()

    serve(segment, test, **identity, account=[account])
