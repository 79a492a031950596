"""Sources that a reload adds, changes and removes."""

from __future__ import annotations

from asyncua import ua

from shmio.layout.model import Layout, Register
from shmio.segment import Segment
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.opcua.harness import ABOUT, Changes, Served, node, serve, spec

SMALLER = Layout(
    "DB2", 2, 8, False,
    (Register("step", "INT", (), 0, None, 2, 1), Register("new", "DINT", (), 4, None, 4, 1, unit="mm", comment="way")),
)  # fmt: skip


def follows(one: Served) -> bool:
    """Let the endpoint check for a reload, as its process does all the time. The result is always False."""
    one.endpoint.follow_reloads()
    return False


def test_nodes_come_and_go_and_subscriptions_continue(segment: Segment) -> None:
    async def test(one: Served) -> None:
        one.publish(image(step=3))
        sources = one.endpoint.sources
        async with one.client() as client:
            changes = Changes()
            subscription = await client.create_subscription(20, changes)
            paths = ["cell/step", "cell/axis/position", "cell/step#Provenance"]
            await subscription.subscribe_data_change([node(client, path) for path in paths])
            await changes.until("cell/axis/position", lambda value: value.StatusCode.is_good())
            before = sources["cell"]
            segment.change(retire=["cell"], add=[spec(layout=SMALLER)])
            await one.until(lambda: follows(one) or sources["cell"] is not before)
            await changes.until("cell/axis/position", lambda value: value.StatusCode.name == "BadNodeIdUnknown")
            segment.writer("cell").publish(b"\0\5\0\0\0\0\0\7", cycle=1)
            await changes.until("cell/step", lambda value: value.Value.Value == 5)
            new = node(client, "cell/new")
            assert await new.read_value() == 7
            unit = await (await new.get_child("0:EngineeringUnits")).read_value()
            assert (unit.DisplayName.Text, unit.UnitId) == ("mm", 5066068)
            assert (await new.read_description()).Text == "way"
            names = [(await child.read_browse_name()).Name for child in await node(client, "cell").get_children()]
            assert names == ["step", "new", *ABOUT]
            segment.change(retire=["cell"], add=[spec("other", SMALLER)])
            await one.until(lambda: follows(one) or list(sources) == ["other"])
            await changes.until("cell/step", lambda value: value.StatusCode.name == "BadNodeIdUnknown")
            found = await new.read_data_value(raise_on_bad_status=False)
            assert found.StatusCode == ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown)
            await subscription.delete()

    serve(segment, test)


def test_a_large_cell_is_served_soon(segment: Segment) -> None:
    registers = tuple(Register(f"a{n // 100}/r{n}", "INT", (), 2 * n, None, 2, 1) for n in range(20_000))
    large = Layout("DB3", 3, 40_000, False, registers)

    async def test(one: Served) -> None:
        segment.change(retire=[], add=[spec("large", large)])
        await one.until(lambda: follows(one) or "large" in one.endpoint.sources)
        segment.writer("large").publish(bytes(40_000), cycle=1)
        async with one.client() as client:
            changes = Changes()
            subscription = await client.create_subscription(20, changes)
            await subscription.subscribe_data_change([node(client, f"large/{one.path}") for one in registers[:2_000]])
            await changes.until("large/a19/r1999", lambda value: value.Value.Value == 0)
            segment.writer("large").publish(bytes(3_998) + b"\0\1" + bytes(36_000), cycle=2)
            await changes.until("large/a19/r1999", lambda value: value.Value.Value == 1)
            assert len(changes.seen) == 2_001
            children = await node(client, "large").get_children()
            assert len(children) == 200 + len(ABOUT)

    serve(segment, test)
