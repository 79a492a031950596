"""The streams that follow one block, and whether all of them have enough for now."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Final

from shmio.endpoints.grpc.channel import Stream
from shmio.endpoints.grpc.pace import LATE_S
from shmio.segment import Block, Cursor, Frame

CATCH_UP_FRAMES: Final = 48
"""A feed that is further behind than this goes on with the newest frame: what it skips is conflated, not lost.

So does one that nobody listens to. Frames, not a time as for the MQTT bridge, which falls behind only if it is held up
itself: here what clients are too slow for waits in the ring, and each takes it late, as many as an outbox has room for.
"""
FEW_FRAMES: Final = 8
"""So many, if they are new, are better than the newest alone for a client that is behind: it need not wait for more."""
LOOK_S: Final = 0.02
"""Now and then what comes is looked at, whoever has something to take: it may be bad news."""


class Crowd:
    """Of a feed, which need not read what nobody can take: when one of them can, it is what is newest then."""

    def __init__(self, block: Block, refill: Callable[[], object]) -> None:
        """``refill``: called when one of them can take more."""
        self._block = block
        self._refill = refill
        self._streams: Counter[Stream] = Counter()
        self._passing = False
        self._until_s = 0.0

    def join(self, stream: Stream) -> None:
        """One more topic of a stream."""
        self._streams[stream] += 1
        if self._passing:
            stream.refills[self._refill] = None

    def leave(self, stream: Stream) -> None:
        """One less."""
        self._streams[stream] -= 1
        if not self._streams[stream]:
            del self._streams[stream]
            stream.refills.pop(self._refill, None)

    def passes(self) -> bool:
        """Whether what comes now is not to be read yet: all have something to take, and will ask for more.

        Now and then it is, ``LOOK_S`` after the last time.
        """
        if not self._streams:
            return False
        for stream in self._streams:
            if not stream.busy:
                return False
        if not self._passing:
            self._passing = True
            for stream in self._streams:
                stream.refills[self._refill] = None
        return time.monotonic() <= self._until_s

    def look(self, cursor: Cursor[Frame]) -> Cursor[Frame]:
        """Where to go on, now that what there is is looked at: without what is too much, or too old."""
        passing, self._passing = self._passing, False
        self._until_s = time.monotonic() + LOOK_S
        behind = passing and all(stream.behind for stream in self._streams)
        head = self._block.ring.head()
        if head - cursor.last <= (CATCH_UP_FRAMES if self._streams and not behind else 1):
            return cursor
        first = head
        if behind:
            several = max(cursor.last + 1, head - FEW_FRAMES + 1)
            frame = self._block.read(several)
            if frame is not None and self._block.now_ns() - frame.publish_ns < 1e9 * LATE_S:
                first = several
        for stream, topics in self._streams.items():
            stream.skip(first - cursor.last - 1, topics)
        return self._block.cursor(after=first - 1)
