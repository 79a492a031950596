"""Back-pressure: bounds on what waits for clients, and when a block need not be read."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sized
from typing import Final, Protocol

from shmio.segment import Block, FrameFollower

WINDOW_S: Final = 0.25
"""Length of the window in which a client's losses are compared with its values."""
BEHIND_S: Final = 5.0
"""A client that is far behind is tried again at the next multiple of this time.

Its losses while it is behind do not show how fast it could be. All clients are tried at the
same time, because a frame that is read for one of them is available to all.
"""
PART: Final = 3
"""A client that loses more than one value in this many is far behind."""
LATE_S: Final = 0.002
"""A value for a client that is far behind is dropped after this time if there is a newer one."""


class LossMonitor:
    """Decides from one client's lost values whether it is far behind. Times in s, on any clock."""

    def __init__(self) -> None:
        self.behind = False
        """Whether the client is far behind: queued values would only reach it later."""
        self._offered = 0
        self._lost = 0
        self._until_s = 0.0

    def offer(self, now_s: float) -> None:
        """Count one value for the client; at the end of a window decide anew."""
        if now_s >= self._until_s:
            self.behind = not self.behind and PART * self._lost > self._offered
            self._offered = self._lost = 0
            self._until_s = (now_s // BEHIND_S + 1) * BEHIND_S if self.behind else now_s + WINDOW_S
        self._offered += 1

    def lose(self, count: int) -> None:
        """Count values that were dropped in favour of newer ones."""
        self._lost += count

    def skip(self, count: int) -> None:
        """Count values that were never queued; they count as offered and as lost."""
        self._offered += count
        self._lost += count


BOUND_BYTES: Final = 8 << 20
"""Limit of the values, and of the events, that wait in one stream."""
TOTAL_BYTES: Final = 256 << 20
"""Limit of all messages that wait in all streams; beyond it each stream has an equal share."""


class TotalBacklog:
    """Size of the messages that wait in all streams, and the number of these streams."""

    def __init__(self) -> None:
        self.size = 0
        self.streams = 0

    def over(self, size: int) -> bool:
        """Return whether all is too much and a stream of ``size`` bytes is over its share."""
        return self.size > TOTAL_BYTES and size > TOTAL_BYTES // max(1, self.streams)


class Backlog:
    """Count and size of the messages of one kind that wait in one stream."""

    def __init__(self, total: TotalBacklog) -> None:
        self.count = 0
        self.size = 0
        self._total = total

    def full(self, message: Sized, bound: int, bound_bytes: int | None = None) -> bool:
        """Return whether one more message would exceed a bound. A single message never does."""
        most = BOUND_BYTES if bound_bytes is None else bound_bytes
        size = self.size + len(message)
        return self.count > 0 and (self.count >= bound or size > most or self._total.over(size))

    def add(self, message: Sized) -> None:
        """Count a message that begins to wait."""
        size = len(message)
        self.count += 1
        self.size += size
        self._total.size += size

    def remove(self, message: Sized) -> None:
        """Count out a message that was sent or dropped."""
        size = len(message)
        self.count -= 1
        self.size -= size
        self._total.size -= size


CATCH_UP_FRAMES: Final = 48
"""A feed that is further behind than this skips to the newest frame: the rest is conflated.

A feed without listeners also skips. The bound is a number of frames. The MQTT bridge has a
time instead, because it falls behind only if it is delayed itself. Here frames that clients
are too slow for wait in the ring, up to the number that an outbox has room for.
"""
FEW_FRAMES: Final = 8
"""A client that is behind gets this many frames, if they are new, so that it need not wait."""
LOOK_S: Final = 0.02
"""Frames are read at least this often, even if all clients are busy: quality may be bad."""


class Stream(Protocol):
    """A client's stream, as back-pressure sees it."""

    refills: dict[Callable[[], object], None]
    """Functions that are called once, as soon as the stream has nothing to send."""

    @property
    def busy(self) -> bool:
        """Whether messages wait, or the client is still taking the last one."""

    @property
    def behind(self) -> bool:
        """Whether the client loses so many values that it is far behind."""

    def skip(self, frames: int, topics: int) -> None:
        """Count frames that were not delivered to ``topics`` topics of a slow client."""


class BackPressure:
    """Back-pressure for the streams that follow one block.

    The feed reads no frames while all of its streams are busy. As soon as a stream can take
    more, the feed continues with the newest frames.
    """

    def __init__(self, block: Block, refill: Callable[[], object]) -> None:
        """``refill`` is called when a stream can take more."""
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

        Busy streams call ``refill`` later. ``LOOK_S`` after the last read the answer is False.
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
        """Skip the frames that are too many, or too old for the streams."""
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
