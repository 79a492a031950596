"""Writes by OPC UA: each is a command to the source, and the status of the write is the command's outcome."""

from __future__ import annotations

import hashlib
from collections.abc import Awaitable, Callable

import pytest
from asyncua import ua

from shmio.config import Token
from shmio.connectors.injection_layers import Owner
from shmio.segment import Segment
from tests.unit.endpoints.opcua.harness import WRITER, Changes, Served, node, serve
from tests.unit.endpoints.plant import Plant

PASSWORD = "a-long-and-random-password"


def with_plant(segment: Segment, test: Callable[[Served, Plant], Awaitable[None]], **config: object) -> None:
    async def run(one: Served) -> None:
        plant = Plant(one.writer)
        plant.owners[WRITER] = Owner(WRITER, 3)
        try:
            plant.cycle()
            plant.run()
            await test(one, plant)
        finally:
            plant.stop()

    serve(segment, run, **config)


async def status(target: object, value: object, kind: ua.VariantType) -> str:
    """Write a value, and return the name of the status."""
    try:
        await target.write_value(ua.DataValue(ua.Variant(value, kind)))  # type: ignore[attr-defined]
    except ua.UaStatusCodeError as error:
        return str(ua.StatusCode(error.code).name)
    return "Good"


def test_a_written_value_comes_back_from_the_device(segment: Segment) -> None:
    async def test(one: Served, plant: Plant) -> None:
        async with one.client() as client:
            changes = Changes()
            subscription = await client.create_subscription(20, changes)
            await subscription.subscribe_data_change(node(client, "cell/step"))
            assert await status(node(client, "cell/step"), 7, ua.VariantType.Int16) == "Good"
            assert plant.memory[12:14] == b"\0\7"
            await changes.until("cell/step", lambda value: value.Value.Value == 7)
            assert await status(node(client, "cell/inputs"), [3, 4], ua.VariantType.Byte) == "Good"
            assert await status(node(client, "cell/inputs"), b"\5\6", ua.VariantType.ByteString) == "Good"
            assert await status(node(client, "cell/inputs/1"), 9, ua.VariantType.Byte) == "Good"
            assert plant.memory[10:12] == b"\5\x09"
            assert await status(node(client, "cell/name"), "Müller", ua.VariantType.String) == "Good"
            assert await status(node(client, "cell/running"), True, ua.VariantType.Boolean) == "Good"

    with_plant(segment, test)


def test_what_cannot_be_written_is_refused_with_a_fitting_status(segment: Segment) -> None:
    async def test(one: Served, plant: Plant) -> None:
        async with one.client() as client:
            step = node(client, "cell/step")
            assert await status(node(client, "cell/secret"), 1, ua.VariantType.Int16) == "BadNotWritable"
            assert await status(node(client, "cell/step#Injected"), True, ua.VariantType.Boolean) == "BadNotWritable"
            assert await status(node(client, "cell/none"), 1, ua.VariantType.Int16) == "BadNodeIdUnknown"
            assert await status(step, 1.5, ua.VariantType.Float) == "BadTypeMismatch"
            assert await status(node(client, "cell/inputs"), [1], ua.VariantType.Byte) == "BadOutOfRange"
            assert await status(node(client, "cell/name"), "far too long", ua.VariantType.String) == "BadOutOfRange"
            clock = client.get_node(ua.ObjectIds.Server_ServerStatus_CurrentTime)
            assert await status(clock, ua.datetime.now(), ua.VariantType.DateTime) == "BadNotWritable"
            assert plant.written == []
            plant.refusal = "read only"
            assert await status(step, 1, ua.VariantType.Int16) == "BadDeviceFailure"
            plant.lost = True
            assert await status(step, 1, ua.VariantType.Int16) in ("BadTimeout", "BadNoCommunication")

    with_plant(segment, test)


def test_a_text_that_is_not_utf_8_costs_only_its_own_write(segment: Segment) -> None:
    async def test(one: Served, plant: Plant) -> None:
        async with one.client() as client:
            values = [("cell/name", "\udcff", ua.VariantType.String), ("\udcff", 1, ua.VariantType.Int16)]
            values.append(("cell/step", 5, ua.VariantType.Int16))
            asked = [
                ua.WriteValue(
                    ua.NodeId(path, 2), ua.AttributeIds.Value, None, ua.DataValue(ua.Variant(value, kind))
                )
                for path, value, kind in values
            ]  # fmt: skip
            found = await client.uaclient.write(ua.WriteParameters(asked))
            assert [status.name for status in found] == ["BadOutOfRange", "BadNodeIdUnknown", "Good"]
            assert plant.memory[12:14] == b"\0\5"

    with_plant(segment, test)


def test_roles_of_accounts(segment: Segment) -> None:
    hashed = hashlib.sha256(PASSWORD.encode()).hexdigest()
    operator_account = Token(name="operator", roles=["read", "write"], sha256=hashed)

    async def test(one: Served, plant: Plant) -> None:
        async with one.client() as viewer:
            assert await node(viewer, "cell/step").read_value() == 0
            assert await status(node(viewer, "cell/step"), 1, ua.VariantType.Int16) == "BadUserAccessDenied"
            level = await node(viewer, "cell/step").read_attribute(ua.AttributeIds.UserAccessLevel)
            assert level.Value.Value == 1
        async with one.client(name="operator", password=PASSWORD) as operator:
            assert await status(node(operator, "cell/step"), 1, ua.VariantType.Int16) == "Good"
        for name, password in (("operator", "wrong"), ("admin", ""), ("", PASSWORD), ("nobody", PASSWORD)):
            with pytest.raises(ua.UaStatusCodeError) as refused:
                async with one.client(name=name or "x", password=password):
                    pass
            assert refused.value.code == ua.StatusCodes.BadUserAccessDenied

    with_plant(segment, test, account=[operator_account], anonymous=["read"])


def test_without_anonymous_roles_nobody_reads_without_an_account(segment: Segment) -> None:
    async def test(one: Served) -> None:
        with pytest.raises(ua.UaStatusCodeError):
            async with one.client():
                pass

    serve(segment, test, account=[Token(name="a", roles=["read"], sha256="0" * 64)])
