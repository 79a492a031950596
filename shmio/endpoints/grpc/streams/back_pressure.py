"""The streams that follow one block, and whether all of them have enough for now."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sized
from typing import Final

from shmio.endpoints.grpc.streams.channel import Stream
from shmio.segment import Block, Cursor, Frame

WINDOW_S: Final = 0.25
"""So often it is looked at."""
BEHIND_S: Final = 5.0
"""At the next multiple of this one that is far behind is tried again, for what it loses meanwhile does not say how fast
it is: with all others, for what is read for one of them is there for all."""
PART: Final = 3
"""A client that has lost more than one in so many values is far behind."""
LATE_S: Final = 0.002
"""What is for one that is far behind waits no longer if there is something newer."""


class LossMonitor:
    """Of one client's stream. Times in s, on any clock."""

    def __init__(self) -> None:
        self.behind = False
        """Whether it is far behind: then what waits for it makes it no better off, only later."""
        self._offered = 0
        self._lost = 0
        self._until_s = 0.0

    def offer(self, now_s: float) -> None:
        """There is a value for it."""
        if now_s >= self._until_s:
            self.behind = not self.behind and PART * self._lost > self._offered
            self._offered = self._lost = 0
            self._until_s = (now_s // BEHIND_S + 1) * BEHIND_S if self.behind else now_s + WINDOW_S
        self._offered += 1

    def lose(self, count: int) -> None:
        """So many were dropped for newer ones."""
        self._lost += count

    def skip(self, count: int) -> None:
        """So many were not even offered."""
        self._offered += count
        self._lost += count


BOUND_BYTES: Final = 8 << 20
"""Of values, and of events, that wait in a stream."""
TOTAL_BYTES: Final = 256 << 20
"""Of all that waits in all streams: when there is more, a stream may hold no more than its equal part of it."""


class TotalBacklog:
    """What waits in all streams."""

    def __init__(self) -> None:
        self.size = 0
        self.streams = 0

    def over(self, size: int) -> bool:
        """Whether there is too much of it, and a stream that holds so much has a part in that."""
        return self.size > TOTAL_BYTES and size > TOTAL_BYTES // max(1, self.streams)


class Backlog:
    """Messages of one kind that wait."""

    def __init__(self, total: TotalBacklog) -> None:
        self.count = 0
        self.size = 0
        self._total = total

    def full(self, message: Sized, bound: int, bound_bytes: int | None = None) -> bool:
        """Whether one more would be too much. A single one never is, however long."""
        most = BOUND_BYTES if bound_bytes is None else bound_bytes
        size = self.size + len(message)
        return self.count > 0 and (self.count >= bound or size > most or self._total.over(size))

    def add(self, message: Sized) -> None:
        """One waits."""
        size = len(message)
        self.count += 1
        self.size += size
        self._total.size += size

    def remove(self, message: Sized) -> None:
        """It waits no more."""
        size = len(message)
        self.count -= 1
        self.size -= size
        self._total.size -= size


CATCH_UP_FRAMES: Final = 48
"""A feed that is further behind than this goes on with the newest frame: what it skips is conflated, not lost.

So does one that nobody listens to. Frames, not a time as for the MQTT bridge, which falls behind only if it is held up
itself: here what clients are too slow for waits in the ring, and each takes it late, as many as an outbox has room for.
"""
FEW_FRAMES: Final = 8
"""So many, if they are new, are better than the newest alone for a client that is behind: it need not wait for more."""
LOOK_S: Final = 0.02
"""Now and then what comes is looked at, whoever has something to take: it may be bad news."""


class BackPressure:
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
