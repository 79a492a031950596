"""Both clients behind one asyncio interface: each call of the synchronous client runs in a thread."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Final, Self

import pytest

from shmio.client import Campaign, Client, Events, Shadow, Simulation, Steps, Subscription, connect, connect_aio

_HELD: Final = (Campaign, Client, Events, Shadow, Simulation, Steps, Subscription)
_AT_ONCE: Final = {"subscribe", "steps"} | {"close"}
"""Methods that are not awaited; ``close`` is awaited for the classes in ``_CLOSE_WAITS``."""
_CLOSE_WAITS: Final = (Campaign, Client, Shadow)
_OVER: Final = object()


class Threaded:
    """The synchronous client, or one of its objects, with the asynchronous interface."""

    def __init__(self, held: Any) -> None:
        self._held = held

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._held, name)
        if not callable(found):
            return found
        at_once = name in _AT_ONCE and not (name == "close" and isinstance(self._held, _CLOSE_WAITS))
        return (lambda *given, **named: _threaded(found(*given, **named))) if at_once else _awaited(found)

    def __getitem__(self, path: str) -> Any:
        return _awaited(self._held.__getitem__)(path)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Any:
        found = await asyncio.to_thread(next, self._held, _OVER)
        if found is _OVER:
            raise StopAsyncIteration
        return found

    async def __aenter__(self) -> Self:
        assert await asyncio.to_thread(self._held.__enter__) is self._held
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.to_thread(self._held.__exit__, *_)


def _threaded(found: Any) -> Any:
    return Threaded(found) if isinstance(found, _HELD) else found


def _awaited(method: Callable[..., Any]) -> Callable[..., Any]:
    async def call(*given: Any, **named: Any) -> Any:
        return _threaded(await asyncio.to_thread(method, *given, **named))

    return call


def _connect(address: str, **options: Any) -> Any:
    return Threaded(connect(address, **options))


Connect = Callable[..., Any]
BOTH: Final = pytest.mark.parametrize("connects", [_connect, connect_aio], ids=["threads", "asyncio"])
"""Runs a test with each client. The test connects with ``async with connects(address) as cell``."""
