"""Declared injections as a program with threads holds them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Protocol, Self

import grpc

from shmio.client import injections
from shmio.client.calls import Target
from shmio.client.injections import Happening
from shmio.errors import CommandError, PathError


class Lifter(Protocol):
    """What it needs of its client."""

    target: Target

    def lift(self, source: str, number: int) -> None:
        """Lift an injection."""


class Campaign(Iterator[Happening]):
    """What was declared. Iterate over it for what is done: it ends when nothing of it stands. For one thread.

    ``declared``: in the order of the declarations, with their seeds.
    """

    def __init__(self, call: Any, client: Lifter, *, keep: bool) -> None:
        self._call = call
        self._client = client
        self._keep = keep
        try:
            first = next(call)
        except grpc.RpcError as error:
            client.target.fail(error)
        self.declared = injections.declared(first)
        self._left = dict.fromkeys((one.source, one.number) for one in self.declared)
        self._happened: list[Happening] = injections.happenings(first)

    def __next__(self) -> Happening:
        """The next one, waited for. RemoteError: the record is not read fast enough, or the instance has ended."""
        while not self._happened:
            try:
                self._happened = injections.happenings(next(self._call))
            except grpc.RpcError as error:
                if self._call.cancelled():
                    raise StopIteration from None
                self._client.target.fail(error)
        happened = self._happened.pop(0)
        if happened.what == "lifted":
            self._left.pop((happened.source, happened.number), None)
        return happened

    def close(self) -> None:
        """Lift what stands of it, unless it is to be kept."""
        left, self._left = self._left, {}
        try:
            for source, number in () if self._keep else left:
                with suppress(PathError, CommandError):  # it was over, or a reload has taken its source away
                    self._client.lift(source, number)
        finally:
            self._call.cancel()  # what still stands goes with it

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
