"""Calls of shmio.v1 that use only the generated code, as a client in any language does."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import Any

import grpc

from shmio.wire import shmio_v1_pb2 as wire
from shmio.wire.shmio_v1_pb2_grpc import ShmioStub
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint

COLUMNS = ("", "bools", "int32s", "int64s", "uint64s", "floats", "doubles", "texts")


def stub(served: Endpoint) -> Any:
    return ShmioStub(served.channel)  # type: ignore[no-untyped-call]


def read(served: Endpoint, *patterns: str, **options: Any) -> Any:
    return stub(served).Read(wire.ReadRequest(patterns=patterns, **options), timeout=TIMEOUT_S)


def subscribe(served: Endpoint, *patterns: str, **options: Any) -> Stream:
    request = wire.SubscribeRequest(patterns=patterns, **options)
    return Stream(stub(served).Subscribe(request, timeout=TIMEOUT_S))


class Stream:
    """Tables, updates and ends of one stream, one at a time."""

    def __init__(self, call: Any) -> None:
        self.call = call
        self.tables: dict[int, Any] = {}
        self._waiting: list[Any] = []

    async def next(self) -> Any:
        """Return the next table, update or end."""
        while not self._waiting:
            message = await asyncio.wait_for(self.call.read(), TIMEOUT_S)
            assert message is not grpc.aio.EOF
            self._waiting = [*message.tables, *message.updates, *message.ended]
        found = self._waiting.pop(0)
        if isinstance(found, wire.Table):
            self.tables[found.number] = found
        return found

    async def update(self) -> Any:
        while not isinstance(found := await self.next(), wire.Update):
            pass
        return found

    async def values(self) -> dict[str, Any]:
        """Return the next update's values by path."""
        update = await self.update()
        return values(self.tables[update.table].registers, update.values)


def values(registers: Iterable[Any], found: Any) -> dict[str, Any]:
    """Return the scalars and whole arrays of ``Values`` by path.

    For an array of which only some elements are sent, the value is a dict of these elements by index.
    """
    elements: dict[tuple[int, int], Any] = {}
    for column, name in enumerate(COLUMNS):
        if name and found.HasField(name):
            part = getattr(found, name)
            elements |= {(column, slot): item for slot, item in zip(part.slots or range(1 << 30), part.values)}  # noqa: B905
    named: dict[str, Any] = {}
    for register in registers:
        got = {
            i: elements[register.column, register.slot + i]
            for i in range(register.count)
            if (register.column, register.slot + i) in elements
        }
        if len(got) == register.count:
            named[register.path] = list(got.values()) if register.dims else got[0]
        elif got:
            named[register.path] = got
    return named
