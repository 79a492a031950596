"""Methods of the OPC UA endpoint: to step virtual time, and to lift injections."""

from __future__ import annotations

import asyncio

import pytest
from asyncua import ua

from shmio.config import Token
from shmio.local.writer import SourceWriter
from shmio.segment import Segment
from tests.unit.endpoints.opcua.harness import Changes, Served, node, serve
from tests.unit.endpoints.opcua.test_writing import with_plant
from tests.unit.endpoints.plant import GUEST, Plant
from tests.unit.endpoints.stepped import Model, stepped_segment


async def refusal(call: object) -> str:
    """Return the name of the status with which a call ends."""
    with pytest.raises(ua.UaStatusCodeError) as refused:
        await call  # type: ignore[misc]
    return str(ua.StatusCode(refused.value.code).name)


def test_a_client_steps_virtual_time(instance: str) -> None:
    async def test(one: Served) -> None:
        async with one.client() as client:
            root, step = client.get_node(ua.NodeId(1, 2)), ua.NodeId("#Step", 2)
            count = node(client, "sim/count")
            assert await count.read_value() == 0
            number, time_s = await root.call_method(step, ua.Variant(20.0, ua.VariantType.Double))
            assert (number, time_s) == (1, 0.02)
            assert await count.read_value() == 1
            again = await root.call_method(step, ua.Variant(0.0, ua.VariantType.Double))
            assert again[0] == 2
            assert await count.read_value() == 2
            nan = ua.Variant(float("nan"), ua.VariantType.Double)
            assert await refusal(root.call_method(step, nan)) == "BadOutOfRange"
            assert await refusal(root.call_method(step, ua.Variant("1"))) == "BadInvalidArgument"
            assert await refusal(root.call_method(step)) == "BadArgumentsMissing"
            arguments = await client.get_node(ua.NodeId("#Step#InputArguments", 2)).read_value()
            assert [one.Name for one in arguments] == ["Length"]

    with stepped_segment(instance, "sim") as segment:
        model = Model(segment, "sim")
        try:
            serve(segment, test)
        finally:
            model.stop()


def test_real_time_is_not_stepped(segment: Segment) -> None:
    async def test(one: Served) -> None:
        async with one.client() as client:
            call = client.get_node(ua.NodeId(1, 2)).call_method(
                ua.NodeId("#Step", 2), ua.Variant(20.0, ua.VariantType.Double)
            )
            assert await refusal(call) == "BadInvalidState"
        assert not segment.clock.read().virtual

    serve(segment, test)


def test_a_client_sees_and_lifts_injections(segment: Segment) -> None:
    async def test(one: Served, plant: Plant) -> None:
        guest = SourceWriter(segment.blocks["cell"], GUEST)
        async with one.client() as client:
            source, changes = node(client, "cell"), Changes()
            subscription = await client.create_subscription(20, changes)
            await subscription.subscribe_data_change([node(client, f"cell/step{name}") for name in ("", "#Injected")])
            await changes.until("cell/step", lambda value: value.StatusCode.is_good())
            number = await asyncio.to_thread(guest.inject, ["step"], name="test")
            await asyncio.to_thread(guest.shadow, number, {"step": 77})
            shown = await changes.until("cell/step", lambda value: value.Value.Value == 77)
            assert shown.StatusCode.name == "GoodLocalOverride"
            if ("cell/step#Injected", True) not in [(path, value.Value.Value) for path, value in changes.seen]:
                await changes.until("cell/step#Injected", lambda value: value.Value.Value is True)
            assert await node(client, "cell/step#Provenance").read_value() == "injected"
            assert await node(client, "cell/secret#Provenance").read_value() == "live"
            assert await node(client, "cell#Injections").read_value() == [f"{number}: test (out)"]
            lift = ua.NodeId("cell#Lift", 2)
            wrong = source.call_method(lift, ua.Variant(1, ua.VariantType.UInt64))
            assert await refusal(wrong) == "BadNotFound"
            await source.call_method(lift, ua.Variant(number, ua.VariantType.UInt64))
            await changes.until("cell/step", lambda value: value.Value.Value == 0 and value.StatusCode.name == "Good")
            for name in ("one", "two"):
                await asyncio.to_thread(guest.inject, ["step"], name=name)
            assert await source.call_method(ua.NodeId("cell#LiftAll", 2)) == 2
            assert await node(client, "cell#Injections").read_value() == []

    with_plant(segment, test)


def test_each_method_needs_its_role(segment: Segment) -> None:
    async def test(one: Served) -> None:
        async with one.client() as client:
            step = client.get_node(ua.NodeId("#Step", 2))
            executable = await step.read_attribute(ua.AttributeIds.UserExecutable)
            assert executable.Value.Value is False
            call = client.get_node(ua.NodeId(1, 2)).call_method(step, ua.Variant(1.0, ua.VariantType.Double))
            assert await refusal(call) == "BadUserAccessDenied"
            assert (
                await refusal(node(client, "cell").call_method(ua.NodeId("cell#LiftAll", 2))) == "BadUserAccessDenied"
            )

    serve(segment, test, anonymous=["read"], account=[Token(name="a", roles=["control"], sha256="0" * 64)])
