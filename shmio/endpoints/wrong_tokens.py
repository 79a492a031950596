"""Slows down clients that show wrong tokens. A right token is accepted at once, whatever other clients do.

Many clients may share an address behind a router, so no address is ever refused.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from typing import Final

FREE: Final = 10
"""Number of wrong tokens from an address within ``PERIOD_S`` that are answered at once: users make mistakes."""
PERIOD_S: Final = 60.0
DELAYS_S: Final = (0.25, 0.5, 1.0, 2.0)
"""Delays in s of the answers to further wrong tokens from an address. The last one is also that of all later ones."""
MAX_HOSTS: Final = 1024
"""Maximum number of addresses that are remembered. Those without a wrong token for longest are forgotten first."""
MAX_WAITING: Final = 32
"""Maximum number of answers that are delayed at the same time. Each keeps a connection from others."""


class WrongTokens:
    """Delays the answers to wrong tokens. Use it in the event loop's thread only."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._seen: OrderedDict[str, list[float]] = OrderedDict()
        """The times in s of the newest wrong tokens from each address."""
        self._waiting: OrderedDict[asyncio.Event, None] = OrderedDict()

    def count(self, host: str) -> float:
        """Count a wrong token from an address. Return by how many s to delay the answer."""
        now_s = self._now()
        seen = [at_s for at_s in self._seen.pop(host, ()) if now_s - at_s < PERIOD_S]
        delay_s = 0.0 if len(seen) < FREE else DELAYS_S[min(len(seen) - FREE, len(DELAYS_S) - 1)]
        self._seen[host] = [*seen, now_s][-(FREE + len(DELAYS_S)) :]
        if len(self._seen) > MAX_HOSTS:
            self._seen.popitem(last=False)
        return delay_s

    async def slow_down(self, host: str) -> None:
        """Count a wrong token from an address, and wait as long as its answer is to be delayed."""
        delay_s = self.count(host)
        if not delay_s:
            return
        if len(self._waiting) >= MAX_WAITING:
            self._waiting.popitem(last=False)[0].set()
        over = asyncio.Event()
        self._waiting[over] = None
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(delay_s):
                    await over.wait()
        finally:
            self._waiting.pop(over, None)
