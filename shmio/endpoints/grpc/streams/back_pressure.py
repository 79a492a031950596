"""Back-pressure: limits the messages that wait for clients, and skips frames while all clients are busy."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sized
from typing import Final, Protocol

from shmio.segment import Block, FrameFollower

WINDOW_S: Final = 0.25
"""Length in s of the periods in which the values that a client loses are compared with those offered to it."""
BEHIND_S: Final = 5.0
"""Interval in s at which clients that are far behind get another chance.

The values that a client loses while it is behind do not show how fast it could be. All clients get
their chance at the same time, because a frame that is read for one client is available to all.
"""
PART: Final = 3
"""A client that loses more than one of ``PART`` values is far behind."""
LATE_S: Final = 0.002
"""Age in s from which a waiting value is replaced by a newer one, if the client is far behind."""


class LossMonitor:
    """Decides from the number of values that a client loses whether the client is far behind.

    Times are in s, by any one clock.
    """

    def __init__(self) -> None:
        self.behind = False
        """True if the client is far behind, so that a queue would only delay its values."""
        self._offered = 0
        self._lost = 0
        self._until_s = 0.0

    def offer(self, now_s: float) -> None:
        """Count one value that was offered to the client. At the end of a period, update :attr:`behind`."""
        if now_s >= self._until_s:
            self.behind = not self.behind and PART * self._lost > self._offered
            self._offered = self._lost = 0
            self._until_s = (now_s // BEHIND_S + 1) * BEHIND_S if self.behind else now_s + WINDOW_S
        self._offered += 1

    def lose(self, count: int) -> None:
        """Count values that were dropped because a newer value replaced them."""
        self._lost += count

    def skip(self, count: int) -> None:
        """Count values that were never queued. They count as both offered and lost."""
        self._offered += count
        self._lost += count


BOUND_BYTES: Final = 8 << 20
"""Maximum size of a stream's waiting values, and also of its waiting events, in bytes."""
TOTAL_BYTES: Final = 256 << 20
"""Size of all waiting messages, in bytes, above which no stream may exceed an equal share of it."""


class TotalBacklog:
    """Total size of the messages that wait in all streams, and number of these streams."""

    def __init__(self) -> None:
        self.size = 0
        self.streams = 0

    def over(self, size: int) -> bool:
        """Return whether the total exceeds its limit, and ``size`` bytes exceed a stream's equal share of it."""
        return self.size > TOTAL_BYTES and size > TOTAL_BYTES // max(1, self.streams)


class Backlog:
    """Number and size of the messages of one kind that wait in one stream."""

    def __init__(self, total: TotalBacklog) -> None:
        self.count = 0
        self.size = 0
        self._total = total

    def full(self, message: Sized, bound: int, bound_bytes: int | None = None) -> bool:
        """Return whether one more message would exceed a limit. A single message always fits.

        Args:
            message: The message.
            bound: Maximum number of messages.
            bound_bytes: Maximum size of all messages, in bytes; None for ``BOUND_BYTES``.
        """
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
"""A feed that is more frames behind than this, or has no listeners, skips to the newest frame.

The limit is a number of frames, because an outbox has room for that many. Frames that come too fast
for the clients wait in the ring. The MQTT bridge has a limit in time instead, because it falls
behind only if it is delayed itself.
"""
FEW_FRAMES: Final = 8
"""Maximum number of frames that a client that is far behind gets at once."""
LOOK_S: Final = 0.02
"""Maximum time in s between two reads while all clients are busy. These reads notice bad quality."""


class Stream(Protocol):
    """A client's stream, as back-pressure sees it."""

    refills: dict[Callable[[], object], None]
    """Functions to call once, as soon as the stream has nothing left to send."""

    @property
    def busy(self) -> bool:
        """True if messages are waiting, or if the client has not taken the last message yet."""

    @property
    def behind(self) -> bool:
        """True if the client loses so many values that it is far behind."""

    def skip(self, frames: int, topics: int) -> None:
        """Count frames that were not delivered to a slow client, on ``topics`` of its topics."""


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
        """Add a stream. Call this once for each topic that the stream follows."""
        self._streams[stream] += 1
        if self._passing:
            stream.refills[self._refill] = None

    def leave(self, stream: Stream) -> None:
        """Remove one topic of a stream. When a stream's last topic is removed, the stream is removed, too."""
        self._streams[stream] -= 1
        if not self._streams[stream]:
            del self._streams[stream]
            stream.refills.pop(self._refill, None)

    def passes(self) -> bool:
        """Return whether the feed should read nothing now, because all streams are busy.

        If the feed has not read for ``LOOK_S``, the result is False. A busy stream calls ``refill``
        once it can take more.
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
