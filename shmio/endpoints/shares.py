"""Shares the endpoint's time among its clients, so that the requests of one do not delay the others.

One thread serves all clients. It does the work for a client in slices of ``SLICE_S``, between which other
clients proceed, and a client that has used its share of the time waits. The share of a client depends on
how many others are busy; a client that needs little never waits.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine, Generator
from types import TracebackType
from typing import Any, Final

SLICE_S: Final = 0.001
"""Time in s after which the work for a client lets other clients proceed."""
CLIENT_SHARE: Final = 0.3
"""Largest part of the endpoint's time that the work for one client takes."""
ALL_SHARE: Final = 0.6
"""Largest part of the time that the work for all busy clients takes."""
ALONE_SHARE: Final = 0.9
"""Part of the time that the work for the only client takes."""
BURST_S: Final = 0.5
"""Time in s that a client which has used less than its share may use at once, as for its first requests."""
BUSY_S: Final = 1.0
BUSY_SHARE: Final = 0.02
"""A client that has used this part of the last ``BUSY_S`` counts as busy: all busy clients share ``ALL_SHARE``."""


BYTE_S: Final = 20e-9
"""Time in s that each byte for a client counts in addition, because the network and the client need time, too."""


class Shares:
    """The time that clients use, and the share that each of them has. Use it only in the event loop's thread."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self._open = 0
        self._busy_s: dict[Share, float] = {}

    def open(self) -> None:
        """Count a client that has connected."""
        self._open += 1

    def report_busy(self, share: Share, now_s: float) -> None:
        """Record that a client is busy."""
        self._busy_s.pop(share, None)
        self._busy_s[share] = now_s
        while now_s - self._busy_s[first := next(iter(self._busy_s))] > BUSY_S:
            del self._busy_s[first]

    def forget(self, share: Share) -> None:
        """Forget a client that has disconnected."""
        self._open -= 1
        self._busy_s.pop(share, None)

    @property
    def rate(self) -> float:
        """The part of the time that each client has."""
        if self._open <= 1:
            return ALONE_SHARE
        return min(CLIENT_SHARE, ALL_SHARE / max(1, len(self._busy_s)))


class Share:
    """The time that one client uses. As a context manager, it counts the time of the block."""

    def __init__(self, shares: Shares) -> None:
        self._shares = shares
        shares.open()
        self._credit_s = BURST_S
        self._depth = 0
        self._recent_s = 0.0
        self._at_s = self._begun_s = self._recent_at_s = shares.clock()

    def __enter__(self) -> None:
        if self._depth:
            self._charge()
        else:
            self._begun_s = self._shares.clock()
        self._depth += 1

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._depth -= 1
        self._charge()

    def _charge(self) -> None:
        now_s = self._shares.clock()
        self._refill(now_s)
        used_s = now_s - self._begun_s
        self._credit_s -= used_s
        self._begun_s = now_s
        # The time used of late, which fades within BUSY_S.
        self._recent_s = max(0.0, self._recent_s - (now_s - self._recent_at_s) * BUSY_SHARE) + used_s
        self._recent_at_s = now_s
        if self._recent_s > BUSY_SHARE * BUSY_S:
            self._recent_s = BUSY_SHARE * BUSY_S
            self._shares.report_busy(self, now_s)

    def count_bytes(self, number: int) -> None:
        """Count bytes that are sent to the client."""
        self._credit_s -= number * BYTE_S
        self._recent_s += number * BYTE_S

    def count_time(self, used_s: float) -> None:
        """Count time in s that another thread has used for the client."""
        self._credit_s -= used_s
        self._recent_s += used_s

    def _refill(self, now_s: float) -> None:
        self._credit_s = min(BURST_S, self._credit_s + (now_s - self._at_s) * self._shares.rate)
        self._at_s = now_s

    @property
    def wait_s(self) -> float:
        """The time in s for which the client has to wait; 0 if it has not used up its share."""
        if self._credit_s < 0:
            self._refill(self._shares.clock())
        return max(0.0, -self._credit_s / self._shares.rate)

    @property
    def over(self) -> bool:
        """True if the present slice is over."""
        return self._shares.clock() - self._begun_s >= SLICE_S

    async def turn(self) -> None:
        """Let other clients proceed if the present slice is over. Call this between pieces of work."""
        if self.over:
            self._charge()
            await self.wait()

    async def wait(self) -> None:
        """Let other clients proceed, and wait if this client has used up its share."""
        await asyncio.sleep(self.wait_s)

    async def count(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Run a coroutine, and count the time that it takes, without the time for which it waits."""
        return await _Counted(self, work)

    def close(self) -> None:
        """Forget the client, which has disconnected."""
        self._shares.forget(self)


class _Counted:
    """Runs a coroutine inside another, and counts the time of each of its steps."""

    def __init__(self, share: Share, work: Coroutine[Any, Any, Any]) -> None:
        self._share, self._work = share, work

    def __await__(self) -> Generator[Any, Any, Any]:
        proceed: Callable[[], Any] = lambda: self._work.send(None)  # noqa: E731
        while True:
            try:
                with self._share:
                    awaited = proceed()
            except StopIteration as end:
                return end.value
            try:
                given = yield awaited
            except BaseException as error:  # noqa: BLE001  the coroutine handles it
                proceed = lambda error=error: self._work.throw(error)  # type: ignore[misc]  # noqa: E731
            else:
                proceed = lambda given=given: self._work.send(given)  # type: ignore[misc]  # noqa: E731
