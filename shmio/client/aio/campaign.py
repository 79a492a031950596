"""Declared injections as a program with asyncio holds them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any, Protocol, Self

from shmio.client import injections
from shmio.client.aio.calls import receive
from shmio.client.calls import Target
from shmio.client.injections import Happening
from shmio.errors import CommandError, PathError


class Lifter(Protocol):
    """What it needs of its client."""

    target: Target

    async def lift(self, source: str, number: int) -> None:
        """Lift an injection."""


class Campaign(AsyncIterator[Happening]):
    """As :class:`shmio.client.Campaign`."""

    def __init__(self, call: Any, first: Any, client: Lifter, *, keep: bool) -> None:
        self._call = call
        self._client = client
        self._keep = keep
        self.declared = injections.declared(first)
        self._left = dict.fromkeys((one.source, one.number) for one in self.declared)
        self._happened: list[Happening] = injections.happenings(first)

    async def __anext__(self) -> Happening:
        """As that of :class:`shmio.client.Campaign`."""
        while not self._happened:
            self._happened = injections.happenings(await receive(self._call, self._client.target.fail))
        happened = self._happened.pop(0)
        if happened.what == "lifted":
            self._left.pop((happened.source, happened.number), None)
        return happened

    async def close(self) -> None:
        """Lift what stands of it, unless it is to be kept."""
        left, self._left = self._left, {}
        try:
            for source, number in () if self._keep else left:
                with suppress(PathError, CommandError):  # it was over, or a reload has taken its source away
                    await self._client.lift(source, number)
        finally:
            self._call.cancel()  # what still stands goes with it

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
