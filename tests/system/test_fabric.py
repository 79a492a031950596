"""A cell with its own NATS server: what a client of the fabric and the user of the cell see."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator

import nats
import pytest
from nats.aio.msg import Msg

from shmio.config import Address
from shmio.fabric.messages import decode_entries, decode_header
from shmio.segment import Frame
from shmio.testing.cell import CONFIG, Cell, kill, until
from shmio.testing.ports import reserved_port

FABRIC = """
[fabric]
server = "embedded"
listen = "{nats}"
cell = "plant1.line3.a50"
"""
SUBJECT = "shmio.plant1.line3.a50.cell.live"


@pytest.fixture
def address() -> Iterator[Address]:
    with reserved_port() as address:
        yield address


async def _receive(address: Address, count: int) -> list[Frame]:
    """Receive frames of the source ``cell`` with a bare NATS client."""
    client = await nats.connect(f"nats://{address}")
    messages: asyncio.Queue[Msg] = asyncio.Queue()
    await client.subscribe(SUBJECT, cb=messages.put)
    frames: list[Frame] = []
    expected = 0
    async with asyncio.timeout(60):
        while len(frames) < count:
            data = (await messages.get()).data
            number = decode_header(data).number
            assert number == (expected or number)
            expected = number + 1
            frames += [entry for entry in decode_entries(data) if isinstance(entry, Frame)]
    await client.close()
    return frames


def test_a_bare_client_receives_each_frame(make_cell: Callable[..., Cell], address: Address) -> None:
    cell = make_cell(config=CONFIG + FABRIC.replace("{nats}", str(address)))
    cell.up()
    until(lambda: cell.processes()["fabric"]["counters"]["messages"] > 0, "the uplink's first message")
    frames = asyncio.run(_receive(address, 50))
    first = frames[0].number
    assert [frame.number for frame in frames] == list(range(first, first + len(frames)))
    before = cell.processes()
    kill(before["nats"]["pid"])
    until(lambda: cell.processes()["fabric"]["counters"]["connects"] == 2, "the uplink's reconnection")
    until(lambda: cell.status()["state"] == "running", "no problem")
    assert asyncio.run(_receive(address, 5))
    assert cell.processes()["fabric"]["pid"] == before["fabric"]["pid"]
    cell.down()
