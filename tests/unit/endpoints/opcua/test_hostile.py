"""Hostile input to the endpoint: its cost is bounded, and other clients are still served."""

from __future__ import annotations

import asyncio
import socket
import struct
from typing import Any

import pytest
from asyncua import Client, ua
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import struct_to_binary, variant_from_binary

from shmio.endpoints.opcua.server import SILENT_S
from shmio.segment import Segment
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.opcua.harness import TIMEOUT_S, Changes, Served, node, serve

HELLO = ua.Hello(0, 65535, 65535, 0, 0, "opc.tcp://127.0.0.1/")


def hello() -> bytes:
    body: bytes = struct_to_binary(HELLO)
    return b"HELF" + struct.pack("<I", 8 + len(body)) + body


async def ended(one: Served, data: bytes) -> bytes:
    """Send bytes. Return what the endpoint sends until it disconnects."""
    reader, writer = await asyncio.open_connection("127.0.0.1", one.port)
    try:
        writer.write(data)
        return await asyncio.wait_for(reader.read(), TIMEOUT_S)
    except ConnectionResetError:
        return b""
    finally:
        writer.close()


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        bytes(64),
        b"\xff" * 4096,
        b"HELF" + struct.pack("<I", 0xFFFFFFFF),
        b"HELF" + struct.pack("<I", 8),
        b"MSGF" + struct.pack("<II", 64, 1) + bytes(52),
        hello() + b"HELF" + struct.pack("<I", 64) + bytes(56),
        hello() + b"OPNF" + struct.pack("<II", 1 << 30, 0),
        hello() + b"OPNF" + struct.pack("<II", 40, 0) + b"\xff" * 28,
        hello() + b"MSGF" + struct.pack("<II", 40, 77) + bytes(28),
        hello() + b"ERRF" + struct.pack("<I", 16) + bytes(8),
    ],
)
def test_what_is_not_opc_ua_ends_its_connection(segment: Segment, data: bytes) -> None:
    async def test(one: Served) -> None:
        one.publish(image(step=1))
        async with one.client() as client:
            await ended(one, data)
            assert await node(client, "cell/step").read_value() == 1

    serve(segment, test)


async def silent(one: Served, state: str) -> Any:
    """Open a connection in one of the states that it can have before a session, and leave it there."""
    if state in ("channel", "session"):
        client = Client(one.url, timeout=TIMEOUT_S)
        await client.connect_socket()
        await client.send_hello()
        await client.open_secure_channel()
        if state == "session":
            await client.create_session()
        return client.disconnect_socket
    _, writer = await asyncio.open_connection("127.0.0.1", one.port)
    writer.write({"open": b"", "half a Hello": hello()[:20], "Hello": hello()}[state])
    return writer.close


@pytest.mark.parametrize("state", ["open", "half a Hello", "Hello", "channel", "session"])
def test_silent_connections_lock_nobody_out(segment: Segment, state: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.opcua.connection.MAX_PENDING", 10)
    monkeypatch.setattr("shmio.endpoints.opcua.server.MAX_CONNECTIONS", 5)
    monkeypatch.setattr("shmio.endpoints.opcua.server.MAX_PENDING", 10)
    monkeypatch.setattr("shmio.endpoints.opcua.server.MAX_SESSIONS", 2)

    async def test(one: Served) -> None:
        one.publish(image(step=1))
        async with one.client() as before:
            close = [await silent(one, state) for _ in range(25)]
            async with one.client() as client:
                assert await node(client, "cell/step").read_value() == 1
            assert await node(before, "cell/step").read_value() == 1
            for end in close:
                end()

    serve(segment, test)


def test_sessions_that_nobody_uses_make_room(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.opcua.server.MAX_SESSIONS", 2)

    async def test(one: Served) -> None:
        one.publish(image(step=1))
        async with one.client() as used, one.client() as lost:
            await lost.create_subscription(20, Changes())  # the session outlives its connection
            with pytest.raises(ua.UaStatusCodeError) as refused:
                async with one.client():
                    pass
            assert refused.value.code == ua.StatusCodes.BadTooManySessions
            lost.disconnect_socket()
            sessions = one.endpoint.server.iserver._external_sessions
            await one.until(lambda: any(session.detached for session in sessions.values()))
            async with one.client() as third:
                assert await node(third, "cell/step").read_value() == 1
                assert await node(used, "cell/step").read_value() == 1
                (silent, _) = sessions.values()
                silent._last_activity -= SILENT_S + 1
                async with one.client() as fourth:
                    assert await node(fourth, "cell/step").read_value() == 1

    serve(segment, test)


def test_connections_are_bounded_and_half_open_ones_end(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.opcua.server.MAX_CONNECTIONS", 2)
    monkeypatch.setattr("shmio.endpoints.opcua.server.MAX_PENDING", 3)
    monkeypatch.setattr("shmio.endpoints.opcua.server.ACTIVATION_S", 0.5)

    async def test(one: Served) -> None:
        one.publish(image(step=1))
        async with one.client() as client:
            half = [await asyncio.open_connection("127.0.0.1", one.port) for _ in range(20)]
            for _, writer in half:
                writer.write(hello()[:20])
            for reader, writer in half:
                await asyncio.wait_for(reader.read(), TIMEOUT_S)
                writer.close()
            assert await node(client, "cell/step").read_value() == 1
        async with one.client() as later:
            assert await node(later, "cell/step").read_value() == 1

    serve(segment, test)


def test_a_session_that_is_never_activated_leaves_nothing(segment: Segment) -> None:
    async def test(one: Served) -> None:
        for _ in range(3):
            client = Client(one.url, timeout=TIMEOUT_S)
            await client.connect_socket()
            await client.send_hello()
            await client.open_secure_channel()
            for _ in range(5):
                await client.create_session()
            assert one.endpoint.server.iserver.sessions == 1
            client.disconnect_socket()
            await one.until(lambda: one.endpoint.server.iserver.sessions == 0)

    serve(segment, test)


def test_a_client_cannot_use_the_subscriptions_or_the_session_of_another_one(segment: Segment) -> None:
    async def test(one: Served) -> None:
        one.publish(image(step=1))
        async with one.client() as owner, one.client() as other:
            changes = Changes()
            subscription = await owner.create_subscription(20, changes)
            await subscription.subscribe_data_change(node(owner, "cell/step"))
            await changes.until("cell/step", lambda value: value.StatusCode.is_good())
            number = subscription.subscription_id
            (refused,) = await other.uaclient.delete_subscriptions([number])
            assert refused.name == "BadSubscriptionIdInvalid"
            asked = ua.TransferSubscriptionsParameters([ua.UInt32(number)], False)
            (taken,) = await other.uaclient.transfer_subscriptions(asked)
            assert taken.StatusCode.name == "BadSubscriptionIdInvalid"
            one.publish(image(step=2))
            await changes.until("cell/step", lambda value: value.Value.Value == 2)
            tokens = {
                session.auth_token.Identifier for session in one.endpoint.server.iserver._external_sessions.values()
            }
            assert all(isinstance(token, bytes) and len(token) == 32 for token in tokens)

    serve(segment, test)


def test_wishes_beyond_the_limits_are_revised(segment: Segment) -> None:
    async def test(one: Served) -> None:
        one.publish(image(step=1))
        async with one.client() as client:
            for wish, most in ((0.0, 20.0), (-5.0, 20.0), (float("nan"), 60_000.0), (1e300, 60_000.0)):
                asked = ua.CreateSubscriptionParameters(wish, 0xFFFFFFFF, 0xFFFFFFFF, 0, True, 0)
                revised = await client.uaclient.create_subscription(asked, lambda _: None)
                assert revised.RevisedPublishingInterval == most
                assert revised.RevisedLifetimeCount <= 9_000
            item = ua.MonitoredItemCreateRequest(
                ua.ReadValueId(ua.NodeId("cell/step", 2), ua.AttributeIds.Value), ua.MonitoringMode.Reporting,
                ua.MonitoringParameters(1, float("nan"), None, 0xFFFFFFFF, True),
            )  # fmt: skip
            params = ua.CreateMonitoredItemsParameters(revised.SubscriptionId, ua.TimestampsToReturn.Both, [item])
            (made,) = await client.uaclient.create_monitored_items(params)
            assert (made.StatusCode.name, made.RevisedQueueSize) == ("Good", 100)

    serve(segment, test)


def test_an_array_of_nothing_is_refused(segment: Segment) -> None:
    """The elements take no bytes, so that a short message could request any amount of memory."""

    async def test(one: Served) -> None:
        with pytest.raises(ua.UaStatusCodeError):
            variant_from_binary(Buffer(b"\x80" + struct.pack("<i", 0x7FFFFFFF)))
        async with one.client() as client:
            many = [ua.ReadValueId(ua.NodeId("cell/step", 2), ua.AttributeIds.Value)] * 10_001
            with pytest.raises(ua.UaStatusCodeError) as refused:
                await client.uaclient.read(ua.ReadParameters(NodesToRead=many))
            assert refused.value.code == ua.StatusCodes.BadTooManyOperations

    serve(segment, test)


def test_a_wrong_item_costs_only_itself(segment: Segment) -> None:
    """Numbers that are in no enumeration, structures that cannot be decoded, and texts that are not UTF-8."""

    async def test(one: Served) -> None:
        one.publish(image(step=1))
        async with one.client() as client:
            step, unknown = ua.NodeId("cell/step", 2), ua.NodeId("\udcff", 2)

            def browse(direction: int) -> ua.BrowseDescription:
                asked = ua.BrowseDescription(step, ua.BrowseDirection.Forward, ua.NodeId(), True, 0, 63)
                asked.BrowseDirection = direction
                return asked

            found = await client.uaclient.browse(ua.BrowseParameters(NodesToBrowse=[browse(9), browse(0)]))
            assert [result.StatusCode.name for result in found] == ["BadBrowseDirectionInvalid", "Good"]
            values = [ua.ReadValueId(which, ua.AttributeIds.Value) for which in (unknown, step)]
            values.append(ua.ReadValueId(step, 9_999))
            read = await client.uaclient.read(ua.ReadParameters(NodesToRead=values))
            assert [value.StatusCode.name for value in read] == ["BadNodeIdUnknown", "Good", "BadAttributeIdInvalid"]
            asked = ua.CreateSubscriptionParameters(20.0, 100, 10, 0, True, 0)
            made = await client.uaclient.create_subscription(asked, lambda _: None)

            def item(mode: int, given: Any) -> ua.MonitoredItemCreateRequest:
                options = ua.MonitoringParameters(1, 0.0, given, 1, True)
                request = ua.MonitoredItemCreateRequest(values[1], ua.MonitoringMode.Reporting, options)
                request.MonitoringMode = mode
                return request

            broken = ua.ExtensionObject(ua.NodeId(ua.ObjectIds.DataChangeFilter_Encoding_DefaultBinary), b"\1\2")
            strange = ua.DataChangeFilter(ua.DataChangeTrigger.Status, 0, 0.0)
            strange.Trigger = 77
            items = [item(9, None), item(2, broken), item(2, strange), item(2, None)]
            params = ua.CreateMonitoredItemsParameters(made.SubscriptionId, ua.TimestampsToReturn.Both, items)
            results = await client.uaclient.create_monitored_items(params)
            assert [result.StatusCode.name for result in results] == [
                "BadMonitoringModeInvalid", "BadMonitoredItemFilterUnsupported", "BadMonitoredItemFilterInvalid",
                "Good",
            ]  # fmt: skip
            long = ua.RelativePath([ua.RelativePathElement(ua.NodeId(), False, True, ua.QualifiedName("x", 2))] * 2_000)
            with pytest.raises(ua.UaStatusCodeError):
                await client.uaclient.translate_browsepaths_to_nodeids([ua.BrowsePath(step, long)])
            assert await node(client, "cell/step").read_value() == 1

    serve(segment, test)


def test_an_answer_that_the_client_cannot_take_costs_only_its_request(segment: Segment) -> None:
    async def test(one: Served) -> None:
        one.publish(image(step=1))
        client = Client(one.url, timeout=TIMEOUT_S)
        async with client:
            protocol: Any = one.endpoint.server.bserver.clients[0].processor
            protocol._limits.max_message_size = 70_000  # what a Hello with this limit sets
            many = [ua.ReadValueId(ua.NodeId("cell/long", 2), ua.AttributeIds.Value)] * 200
            with pytest.raises(ua.UaStatusCodeError) as refused:
                await client.uaclient.read(ua.ReadParameters(NodesToRead=many))
            assert refused.value.code == ua.StatusCodes.BadResponseTooLarge
            assert await node(client, "cell/step").read_value() == 1

    serve(segment, test)


def test_services_that_would_change_the_address_space_are_refused(segment: Segment) -> None:
    async def test(one: Served) -> None:
        async with one.client() as client:
            for call in (
                client.nodes.objects.add_folder(2, "x"),
                client.delete_nodes([node(client, "cell/step")]),
                client.register_server(one.endpoint.server),
                client.nodes.server.read_event_history(None, None, 1),
            ):
                with pytest.raises((ua.UaError, AttributeError)):
                    await call

    serve(segment, test)


def test_a_client_that_does_not_read_is_disconnected(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.opcua.connection.STUCK_S", 0.3)

    async def test(one: Served) -> None:
        one.publish(image(step=1))
        client = Client(one.url, timeout=TIMEOUT_S)
        await client.connect()
        protocol: Any = client.uaclient.protocol
        protocol.transport.pause_reading()
        protocol.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        many = [ua.ReadValueId(ua.NodeId("cell/long", 2), ua.AttributeIds.Value)] * 2_000
        reads = [asyncio.ensure_future(client.uaclient.read(ua.ReadParameters(NodesToRead=many))) for _ in range(30)]
        await one.until(lambda: bool(one.endpoint.server.bserver.clients))
        await one.until(lambda: not one.endpoint.server.bserver.clients)
        for read in reads:
            read.cancel()
        await asyncio.gather(*reads, return_exceptions=True)
        protocol.transport.abort()  # a close would wait until everything is sent
        client.disconnect_socket()
        async with one.client() as later:
            assert await node(later, "cell/step").read_value() == 1

    serve(segment, test)
