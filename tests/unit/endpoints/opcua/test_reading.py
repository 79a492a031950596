"""Browsing, reading and subscribing, with asyncua's client."""

from __future__ import annotations

from asyncua import ua

from shmio.segment import Quality, Segment
from tests.unit.endpoints.harness import LAYOUT, image
from tests.unit.endpoints.opcua.harness import ABOUT, Changes, Served, node, serve


def test_the_instance_is_a_tree_of_objects_and_variables(segment: Segment, instance: str) -> None:
    async def test(one: Served) -> None:
        async with one.client() as client:
            root = await client.nodes.objects.get_child(f"2:{instance}")
            assert [(await child.read_browse_name()).Name for child in await root.get_children()] == ["Step", "cell"]
            source = await root.get_child("2:cell")
            names = {(await child.read_browse_name()).Name for child in await source.get_children()}
            assert names == {"axis", "running", "inputs", "step", "bits", "name", "long", "secret", *ABOUT}
            position = await source.get_child(["2:axis", "2:position"])
            assert position.nodeid == ua.NodeId("cell/axis/position", 2)
            assert await position.read_data_type() == ua.NodeId(ua.ObjectIds.Float)
            assert (await position.get_parent()).nodeid == ua.NodeId("cell/axis", 2)
            inputs = await source.get_child("2:inputs")
            assert await inputs.read_array_dimensions() == [2]
            assert await inputs.read_value_rank() == 1
            assert [(await one.read_browse_name()).Name for one in await position.get_properties()] == [
                "Provenance", "Injected",
            ]  # fmt: skip

    serve(segment, test)


def test_a_read_has_the_newest_values(segment: Segment) -> None:
    async def test(one: Served) -> None:
        async with one.client() as client:
            step = node(client, "cell/step")
            nothing = await step.read_data_value(raise_on_bad_status=False)
            assert nothing.StatusCode.name == "BadWaitingForInitialData"
            for number in range(1, 30):
                one.publish(image(step=number, inputs=b"\1\2", position=0.5))
                assert await step.read_value() == number
            values = await client.read_values([node(client, f"cell/{path}") for path in ("inputs", "axis/position")])
            assert values == [[1, 2], 0.5]
            found = await step.read_data_value()
            assert found.SourceTimestamp is not None
            assert await node(client, "cell/inputs/1").read_value() == 2
            assert await node(client, "cell/inputs/1.%X1").read_value() is True

    serve(segment, test)


def test_a_subscription_gets_only_what_changes(segment: Segment) -> None:
    async def test(one: Served) -> None:
        one.publish(image(step=1))
        async with one.client() as client:
            changes = Changes()
            subscription = await client.create_subscription(20, changes)
            paths = [f"cell/{register.path}" for register in LAYOUT.registers]
            await subscription.subscribe_data_change([node(client, path) for path in paths])
            await changes.until("cell/secret", lambda value: value.Value.Value == 0)
            assert sorted(path for path, _ in changes.seen) == sorted(paths)
            changes.seen.clear()
            one.publish(image(step=2))
            await changes.until("cell/step", lambda value: value.Value.Value == 2)
            one.publish(image(step=3))
            await changes.until("cell/step", lambda value: value.Value.Value == 3)
            assert {path for path, _ in changes.seen} == {"cell/step"}

    serve(segment, test)


def test_bad_quality_reaches_every_variable(segment: Segment) -> None:
    async def test(one: Served) -> None:
        one.publish(image(step=1))
        async with one.client() as client:
            changes = Changes()
            subscription = await client.create_subscription(20, changes)
            await subscription.subscribe_data_change([node(client, "cell/step"), node(client, "cell#Reason")])
            await changes.until("cell/step", lambda value: value.StatusCode.is_good())
            one.publish(image(step=1), Quality.BAD, reason="cable out")
            bad = await changes.until("cell/step", lambda value: value.StatusCode.is_bad())
            assert bad.StatusCode.name == "BadNoCommunication"
            assert bad.Value.Value is None
            assert [value.Value.Value for path, value in changes.seen if path == "cell#Reason"][-1:] in (
                ["cable out"],
                [""],
            )
            assert await node(client, "cell#Reason").read_value() == "cable out"
            assert await node(client, "cell#Quality").read_value() == "bad"
            one.publish(image(step=1))
            await changes.until("cell/step", lambda value: value.StatusCode.is_good())

    serve(segment, test)
