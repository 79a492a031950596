"""Answers to requests for missing messages take turns."""

from __future__ import annotations

import asyncio
from typing import Any

import msgspec
import pytest
from nats.aio.msg import Msg

from shmio.endpoints.fabric import publisher as module
from shmio.endpoints.fabric.backlog import Backlog, Kept, Row
from shmio.endpoints.fabric.publisher import Publisher
from shmio.fabric.client import FabricClient
from shmio.fabric.messages import Header, MissingRequest, with_header
from shmio.fabric.names import CellName
from tests.unit.endpoints.fabric.harness import CELL, in_loop

MESSAGES = 40


class Client(FabricClient):
    """Notes the subjects to which it publishes."""

    def __init__(self) -> None:
        super().__init__()
        self.subjects: list[str] = []
        self.most = self._under_way = 0

    async def publish(self, subject: str, *_: Any, **__: Any) -> None:
        self.subjects.append(subject)
        self._under_way += 1
        self.most = max(self.most, self._under_way)

    async def confirm(self) -> None:
        await asyncio.sleep(0)
        self._under_way = 0


@in_loop
async def test_a_reader_who_asks_for_all_delays_others_by_one_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    backlog, row = Backlog(1 << 20), Row(CellName.parse(CELL), "cell", 7)
    for number in range(1, MESSAGES + 1):
        data = with_header(Header(0, 7, number, bytes(8), 0, 0, 0), entries=bytearray(100))
        backlog.put(row, Kept(number, data, 0))
    monkeypatch.setattr(module, "TURN_BYTES", 4 * row.find(1).size)  # type: ignore[union-attr]
    publisher, client = Publisher(backlog), Client()
    publisher._client = client

    def request(reply: str, first: int) -> Msg:
        data = msgspec.json.encode(MissingRequest(7, first, 1 << 62))
        return Msg(client, "shmio.missing", reply, data, None)

    answers = [asyncio.create_task(publisher.answer(row, request(f"greedy{number}", 1))) for number in range(3)]
    lost = asyncio.create_task(publisher.answer(row, request("lost", 1)))
    while client.subjects.count("greedy2") < 5:  # noqa: ASYNC110  in their second turns
        await asyncio.sleep(0)
    lost.cancel()
    before = len(client.subjects)
    await asyncio.gather(*answers, publisher.answer(row, request("modest", MESSAGES)))
    for number in range(3):
        assert client.subjects.count(f"greedy{number}") == MESSAGES + 1, "all messages, and the end"
    first = client.subjects.index("modest")
    assert client.subjects.count("modest") == 2
    assert client.most <= 2 * 4, "the answers of all readers together wait for the server"
    assert first - before <= 4 + 1, "after the present turn alone"
