"""Limits how many requests of one client are carried out at a time, so that a busy client hardly delays others."""

from __future__ import annotations

import asyncio
from typing import Final
from weakref import WeakValueDictionary

AT_ONCE: Final = 2
"""Number of a client's requests that are carried out at a time. Further ones wait for their turn."""


class Turns:
    """The turns of all clients. Use it in the event loop's thread only."""

    def __init__(self, at_once: int = AT_ONCE) -> None:
        self._at_once = at_once
        self._turns: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()

    def of(self, client: str) -> asyncio.Semaphore:
        """Return what a client's requests hold while they are carried out."""
        turn = self._turns.get(client)
        if turn is None:
            turn = self._turns[client] = asyncio.Semaphore(self._at_once)
        return turn
