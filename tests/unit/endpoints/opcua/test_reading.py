"""Browsing, reading and subscribing at the OPC UA endpoint, with asyncua's client."""

from __future__ import annotations

from typing import Any

import pytest
from asyncua import ua
from asyncua.ua.ua_binary import struct_to_binary

from shmio.endpoints.opcua.values import RegisterState, encode, moment, variant
from shmio.layout.model import Layout, Register
from shmio.model.statuses import RegisterStatus, status_area
from shmio.segment import Quality, Segment
from tests.unit.endpoints.harness import LAYOUT, image
from tests.unit.endpoints.opcua.harness import ABOUT, Changes, Served, node, processes, serve, spec


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


def test_a_stale_value_and_bytes_that_are_no_value_are_bad(instance: str) -> None:
    layout = Layout(
        "DB1", 1, 8, False,
        (Register("day", "DATE_AND_TIME", (), 0, None, 8, 1),),
    )  # fmt: skip

    async def test(one: Served) -> None:
        one.publish(b"\x24\x02\x29\x12\x34\x56\x78\x94")
        async with one.client() as client:
            changes = Changes()
            subscription = await client.create_subscription(20, changes)
            await subscription.subscribe_data_change(node(client, "cell/day"))
            await changes.until("cell/day", lambda value: value.Value.Value == "2024-02-29T12:34:56.789")
            one.publish(b"\xff" * 8)
            await changes.until("cell/day", lambda value: value.StatusCode.name == "BadDecodingError")
            await changes.until("cell/day", lambda value: value.StatusCode.name == "BadOutOfService")
            found = await node(client, "cell/day").read_data_value(raise_on_bad_status=False)
            assert found.StatusCode.name == "BadOutOfService"

    with Segment.create(instance, [spec(layout=layout, stale_ns=300_000_000)], processes()) as segment:
        serve(segment, test)
        segment.unlink()


def test_each_register_has_the_status_and_time_that_its_device_gives(instance: str) -> None:
    registers = (Register("a", "INT", (), 0, None, 2, 1), Register("b", "INT", (), 2, None, 2, 1))
    layout = Layout("TAGS", None, 4, False, registers).with_statuses()
    area = status_area(layout)
    assert area is not None

    def frame(code: int, time_ns: int) -> bytes:
        raw = bytearray(layout.size)
        raw[:4] = b"\0\1\0\2"
        area.put(raw, 0, RegisterStatus(0, 1_000_000_000))
        area.put(raw, 1, RegisterStatus(code, time_ns))
        return bytes(raw)

    async def test(one: Served) -> None:
        one.publish(frame(0, 2_000_000_000))
        async with one.client() as client:
            changes = Changes()
            subscription = await client.create_subscription(20, changes)
            await subscription.subscribe_data_change([node(client, "cell/a"), node(client, "cell/b")])
            good = await changes.until("cell/b", lambda value: value.Value.Value == 2)
            assert good.SourceTimestamp.timestamp() == 2
            one.publish(frame(0x808C0000, 3_000_000_000))
            bad = await changes.until("cell/b", lambda value: value.StatusCode.is_bad())
            assert (bad.StatusCode.name, bad.SourceTimestamp.timestamp()) == ("BadSensorFailure", 3)
            for found, code in ((0x51000200, 0x40000000), (0x91010000, 0x803C0000)):  # Uncertain, BadOutOfRange
                one.publish(frame(found, 4_000_000_000))
                await changes.until("cell/b", lambda value, code=code: value.StatusCode.value == code)  # type: ignore[misc]
                read = await node(client, "cell/b").read_data_value(raise_on_bad_status=False)
                assert read.StatusCode.value == code
            assert [path for path, _ in changes.seen].count("cell/a") == 1
            assert (await node(client, "cell/a").read_data_value()).SourceTimestamp.timestamp() == 1

    with Segment.create(instance, [spec(layout=layout)], processes()) as segment:
        serve(segment, test)
        segment.unlink()


def test_a_queue_keeps_the_values_in_between_and_says_what_it_lost(segment: Segment) -> None:
    async def test(one: Served) -> None:
        one.publish(image(step=0))
        async with one.client() as client:
            changes = Changes()
            subscription = await client.create_subscription(60_000, changes)
            # The library asks for samples every 50 ms by default; values in between would rightly be missing.
            await subscription.subscribe_data_change(node(client, "cell/step"), queuesize=3, sampling_interval=0.0)
            prompt = Changes()
            await (await client.create_subscription(10, prompt)).subscribe_data_change(node(client, "cell/step"))
            for step in range(1, 6):
                one.publish(image(step=step))
                await prompt.until("cell/step", lambda value, step=step: value.Value.Value == step)  # type: ignore[misc]
            await subscription.update(
                ua.ModifySubscriptionParameters(subscription.subscription_id, 20.0, 100, 10, 0, 0)
            )
            await changes.until("cell/step", lambda value: value.Value.Value == 5)
            assert [value.Value.Value for _, value in changes.seen] == [3, 4, 5]
            assert changes.seen[0][1].StatusCode.value == 0x480

    serve(segment, test)


def test_a_dead_band_holds_small_changes_back(segment: Segment) -> None:
    async def test(one: Served) -> None:
        one.publish(image(position=0.0))
        async with one.client() as client:
            changes = Changes()
            subscription = await client.create_subscription(20, changes)
            position = node(client, "cell/axis/position")
            given = ua.DataChangeFilter(ua.DataChangeTrigger.StatusValue, ua.DeadbandType.Absolute, 1.0)
            await subscription._subscribe(position, ua.AttributeIds.Value, mfilter=given)
            await subscription.subscribe_data_change(node(client, "cell/step"))
            await changes.until("cell/step", lambda value: value.Value.Value == 0)
            for step, value in ((1, 0.9), (2, 1.5), (3, 2.4), (4, 3.0)):
                one.publish(image(position=value, step=step))
                await changes.until("cell/step", lambda value, step=step: value.Value.Value == step)  # type: ignore[misc]
            seen = [value.Value.Value for path, value in changes.seen if path == "cell/axis/position"]
            assert seen == [0.0, 1.5, 3.0]

    serve(segment, test)


def test_bytes_written_to_connections_are_counted(segment: Segment) -> None:
    async def test(one: Served) -> None:
        received = 0
        one.publish(image(step=1))
        async with one.client() as client:
            protocol: Any = client.uaclient.protocol
            receive = protocol.data_received
            before = one.endpoint.counters[4]

            def count(data: bytes) -> None:
                nonlocal received
                received += len(data)
                receive(data)

            protocol.data_received = count
            for _ in range(3):
                await node(client, "cell/step").read_value()
            await one.until(lambda: one.endpoint.counters[4] - before == received > 0)

    serve(segment, test)


def test_the_encoder_gives_the_bytes_of_the_library() -> None:
    cases: list[tuple[str, tuple[tuple[int, int], ...], Any]] = [
        ("BOOL", (), True), ("BYTE", (), 200), ("SINT", (), -3), ("INT", (), -300), ("UINT", (), 60_000),
        ("DINT", (), -70_000), ("UDINT", (), 4_000_000_000), ("LINT", (), -(2**62)), ("ULINT", (), 2**64 - 1),
        ("REAL", (), 1.5), ("LREAL", (), float("inf")), ("STRING[9]", (), "größer"), ("WSTRING[9]", (), "\udcff"),
        ("DATE", (), "2026-02-03"), ("REAL", ((0, 2),), [1.0, 2.0, 3.0]), ("BOOL", ((1, 2),), [True, False]),
        ("STRING[9]", ((0, 1),), ["a", ""]), ("INT", ((0, 1), (0, 2)), [[1, 2, 3], [4, 5, 6]]), ("INT", (), None),
    ]  # fmt: skip
    for kind, dims, value in cases:
        register = Register("x", kind, dims, 0, None, 8, 1)
        for code, source_ns, server_ns in ((0, 0, 0), (0x80310000, 1_700_000_000_123_456_789, 0), (0x960000, 1, 2_000)):
            state = RegisterState(value, code, source_ns)
            expected = ua.DataValue(
                None if value is None else variant(register, value), ua.StatusCode(code),
                moment(source_ns) if source_ns else None, moment(server_ns) if server_ns else None,
            )  # fmt: skip
            assert encode(register, state, server_ns) == struct_to_binary(expected), (kind, dims, value)


def test_properties_and_types_of_the_standard_have_its_names(instance: str) -> None:
    """Of a variable with a unit and no range: AnalogUnitType, with 0:EngineeringUnits (OPC 10000-8, section 5.3.2)."""
    registers = (
        Register("force", "REAL", (), 0, None, 4, 1, unit="kN"),
        Register("plain", "REAL", (), 4, None, 4, 1),
        Register("text", "STRING[6]", (), 8, None, 8, 1, unit="mm"),
    )
    layout = Layout("DB1", 1, 16, False, registers)

    async def test(one: Served) -> None:
        async with one.client() as client:
            force = node(client, "cell/force")
            unit = await force.get_child("0:EngineeringUnits")
            assert (await unit.read_browse_name()) == ua.QualifiedName("EngineeringUnits", 0)
            assert (await unit.read_value()).UnitId == int.from_bytes(b"B47", "big")
            assert await unit.read_data_type() == ua.NodeId(ua.ObjectIds.EUInformation)
            names = [await found.read_browse_name() for found in await force.get_properties()]
            assert [str(name.NamespaceIndex) + name.Name for name in names] == [
                "0EngineeringUnits", "2Provenance", "2Injected",
            ]  # fmt: skip
            kinds = [await node(client, f"cell/{path}").read_type_definition() for path in ("force", "plain", "text")]
            base = ua.NodeId(ua.ObjectIds.BaseDataVariableType)
            assert kinds == [ua.NodeId(ua.ObjectIds.AnalogUnitType), base, base]
            with pytest.raises(ua.uaerrors.BadNoMatch):
                await force.get_child("2:EngineeringUnits")

    with Segment.create(instance, [spec(layout=layout)], processes()) as segment:
        serve(segment, test)
        segment.unlink()
