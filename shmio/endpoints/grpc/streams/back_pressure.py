"""Back-pressure: limits the messages that wait for clients, and skips frames if all clients are busy."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sized
from typing import Final, Protocol

from shmio.segment import Block, FrameFollower

WINDOW_S: Final = 0.25
"""Period for which a client's lost values are compared with those offered to it, in s."""
BEHIND_S: Final = 5.0
"""Interval at which clients that are far behind get another chance, in s.

The values that a client loses while it is behind do not show how fast it could be. All clients get
their chance at the same time, because a frame that is read for one client is available to all.
"""
PART: Final = 3
"""A client that loses more than one in ``PART`` values is far behind."""
LATE_S: Final = 0.002
"""Time in s after which a newer value replaces a waiting value, if the client is far behind."""


class LossMonitor:
    """Decides whether a client is far behind, by the number of values that it loses.

    Times are in s, by any clock.
    """

    def __init__(self) -> None:
        self.behind = False
        """True if the client is far behind, so that a queue would only delay its values."""
        self._offered = 0
        self._lost = 0
        self._until_s = 0.0

    def offer(self, now_s: float) -> None:
        """Count one value offered to the client. At the end of a period, update ``behind``."""
        if now_s >= self._until_s:
            self.behind = not self.behind and PART * self._lost > self._offered
            self._offered = self._lost = 0
            self._until_s = (now_s // BEHIND_S + 1) * BEHIND_S if self.behind else now_s + WINDOW_S
        self._offered += 1

    def lose(self, count: int) -> None:
        """Count values that were dropped because newer values replaced them."""
        self._lost += count

    def skip(self, count: int) -> None:
        """Count values that were never queued. They count as offered and as lost."""
        self._offered += count
        self._lost += count


BOUND_BYTES: Final = 8 << 20
"""Maximum size of one stream's waiting values, and of its waiting events, in bytes."""
TOTAL_BYTES: Final = 256 << 20
"""Maximum size of all waiting messages, in bytes. Above it, no stream may exceed an equal share."""


class TotalBacklog:
    """Size of the messages that wait in all streams, and the number of these streams."""

    def __init__(self) -> None:
        self.size = 0
        self.streams = 0

    def over(self, size: int) -> bool:
        """Return whether the total is too large, and ``size`` bytes exceed a stream's equal share."""
        return self.size > TOTAL_BYTES and size > TOTAL_BYTES // max(1, self.streams)


class Backlog:
    """Number and size of the messages of one kind that wait in one stream."""

    def __init__(self, total: TotalBacklog) -> None:
        self.count = 0
        self.size = 0
        self._total = total

    def full(self, message: Sized, bound: int, bound_bytes: int | None = None) -> bool:
        """Return whether one more message would exceed a limit. A single message always fits."""
        most = BOUND_BYTES if bound_bytes is None else bound_bytes
        size = self.size + len(message)
        return self.count > 0 and (self.count >= bound or size > most or self._total.over(size))

    def add(self, message: Sized) -> None:
        """Count a message that starts to wait."""
        size = len(message)
        self.count += 1
        self.size += size
        self._total.size += size

    def remove(self, message: Sized) -> None:
        """Count a message that was sent or dropped."""
        size = len(message)
        self.count -= 1
        self.size -= size
        self._total.size -= size


CATCH_UP_FRAMES: Final = 48
"""A feed that is further behind than this, or has no listeners, skips to the newest frame.

The limit is a number of frames, because an outbox has room for that many. Frames that are too fast
for the clients wait in the ring. The MQTT bridge has a time limit instead, because it falls behind
only if it is delayed itself.
"""
FEW_FRAMES: Final = 8
"""Maximum number of frames that a client that is far behind gets at once."""
LOOK_S: Final = 0.02
"""Longest time between two reads while all clients are busy, in s. These reads notice bad quality."""


class Stream(Protocol):
    """A client's stream, as back-pressure sees it."""

    refills: dict[Callable[[], object], None]
    """Functions to call once, as soon as the stream has nothing to send."""

    @property
    def busy(self) -> bool:
        """True if messages wait, or if the client has not taken the last message yet."""

    @property
    def behind(self) -> bool:
        """True if the client loses so many values that it is far behind."""

    def skip(self, frames: int, topics: int) -> None:
        """Count frames of ``topics`` topics that were not delivered to a slow client."""


class BackPressure:
    """Back-pressure for the streams that follow one block.

    While all of its streams are busy, the feed reads no frames. As soon as a stream can take more,
    the feed continues with the newest frames.
    """

    def __init__(self, block: Block, refill: Callable[[], object]) -> None:
        """Start without streams.

        Args:
            block: The block that the streams follow.
            refill: Called when a stream can take more.

        """
        self._block = block
        self._refill = refill
        self._streams: Counter[Stream] = Counter()
        self._passing = False
        self._until_s = 0.0

    def join(self, stream: Stream) -> None:
        """Add one topic of a stream."""
        self._streams[stream] += 1
        if self._passing:
            stream.refills[self._refill] = None

    def leave(self, stream: Stream) -> None:
        """Remove one topic of a stream."""
        self._streams[stream] -= 1
        if not self._streams[stream]:
            del self._streams[stream]
            stream.refills.pop(self._refill, None)

    def passes(self) -> bool:
        """Return whether the feed should read nothing now, because all streams are busy.

        Return False if the last read was more than ``LOOK_S`` ago. A busy stream calls ``refill``
        when it can take more.
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

    def skip(self, follower: FrameFollower) -> None:
        """Skip to the newest frames if there are no streams, or if the feed or all clients are far behind."""
        passing, self._passing = self._passing, False
        self._until_s = time.monotonic() + LOOK_S
        behind = passing and all(stream.behind for stream in self._streams)
        head = self._block.ring.head()
        if head - follower.last <= (CATCH_UP_FRAMES if self._streams and not behind else 1):
            return
        first = head
        if behind:
            several = max(follower.last + 1, head - FEW_FRAMES + 1)
            frame = self._block.read(several)
            if frame is not None and self._block.now_ns() - frame.publish_ns < 1e9 * LATE_S:
                first = several
        for stream, topics in self._streams.items():
            stream.skip(first - follower.last - 1, topics)
        follower.resume(after=first - 1)
