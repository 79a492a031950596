"""The streams that follow one block, and whether all of them are too slow for it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

from shmio.endpoints.grpc.channel import Stream
from shmio.endpoints.grpc.pace import LATE_S


class Crowd:
    """Of a feed, which need not read what nobody can take: when one of them can, it is what is newest then."""

    def __init__(self, refill: Callable[[], object]) -> None:
        """``refill``: called when one of them can take more."""
        self._refill = refill
        self._streams: Counter[Stream] = Counter()
        self._passing = False
        self._until_s = 0.0

    def join(self, stream: Stream) -> None:
        """One more topic of a stream."""
        self._streams[stream] += 1

    def leave(self, stream: Stream) -> None:
        """One less."""
        self._streams[stream] -= 1
        if not self._streams[stream]:
            del self._streams[stream]

    def passes(self) -> bool:
        """Whether what comes now is not to be read yet: all are far behind, and have something to take.

        Now and then it is, lest what waits gets too old.
        """
        if not self._streams or time.monotonic() > self._until_s:
            return False
        for stream in self._streams:
            if not stream.lags:
                return False
        if not self._passing:
            self._passing = True
            for stream in self._streams:
                stream.refills[self._refill] = None
        return True

    def passed(self) -> bool:
        """Whether something was not read until now, when all that there is is looked at."""
        passed, self._passing = self._passing, False
        self._until_s = time.monotonic() + LATE_S
        return passed
