"""Declared injections of a program."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any, Protocol, Self

from shmio.client import injections
from shmio.client.aio.transport import Stream
from shmio.errors import CommandError, PathError
from shmio.model.injection import Happening


class Lift(Protocol):
    """Lifts an injection of a source by its number."""

    async def __call__(self, source: str, number: int) -> None:
        """Lift an injection; PathError, CommandError if that fails."""


class Campaign(AsyncIterator[Happening]):
    """Injections that were declared together.

    Iterate over it for their events, in one task; the iteration ends when all injections have
    ended. ``declared`` has the injections in the order of the declarations, with their seeds.
    """

    def __init__(self, stream: Stream, first: Any, lift: Lift, *, keep: bool) -> None:
        self._stream = stream
        self._lift = lift
        self._keep = keep
        self.declared = injections.declared(first)
        self._left = dict.fromkeys((one.source, one.number) for one in self.declared)
        self._happened: list[Happening] = injections.happenings(first)

    @classmethod
    async def lay(cls, stream: Stream, lift: Lift, *, keep: bool) -> Self:
        """Read the first answers to Declare, and return the campaign."""
        try:
            return cls(stream, await stream.first(), lift, keep=keep)
        except BaseException:
            stream.close()
            raise

    async def __anext__(self) -> Happening:
        """Wait for the next event.

        Raises:
            RemoteError: The events were not read fast enough, or the instance has ended.
        """
        while not self._happened:
            self._happened = injections.happenings(await anext(self._stream))
        happened = self._happened.pop(0)
        if happened.what == "lifted":
            self._left.pop((happened.source, happened.number), None)
        return happened

    async def close(self) -> None:
        """Lift the remaining injections, unless ``keep`` was given."""
        left, self._left = self._left, {}
        try:
            for source, number in () if self._keep else left:
                with suppress(PathError, CommandError):  # it has ended, or a reload removed its source
                    await self._lift(source, number)
        finally:
            self._stream.close()  # this ends what still remains

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
