"""The values of registers over time, for plots. Registers that several pages plot are packed once.

A batch is a binary message with the frames of one feed, little-endian: the feed's number (uint32),
the number of frames (uint32), and the time of the frame before them (float64), NaN after a gap.
Then follow as float64 the times of the frames, and for each register its values, NaN where the
quality is bad; then for each register a byte for each frame, its provenance. Times are in s, UTC.
"""

from __future__ import annotations

import asyncio
import logging
import math
import struct
import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from shmio.endpoints.turns import Turn
from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.values.frame_codec import FrameCodec
from shmio.local.reading import status_of
from shmio.model.values import Provenance, Quality
from shmio.segment import Block
from shmio.segment.block import Frame

INTERVAL_S: Final = 0.04
"""Interval in s at which new frames are packed and sent. A page redraws at the same interval."""
HISTORY_S: Final = 8.0
"""Length in s of the past that a new follower gets first, as far as its frames are still in the ring."""
MAX_HISTORY: Final = 2_000
"""Maximum number of past frames that a new follower gets first. If there are more, every n-th is chosen."""
MAX_BEHIND: Final = 500
"""Maximum number of unread frames. If there are more, this process was too slow, and the older ones become a gap."""
MAX_BATCH_BYTES: Final = 256 << 10
"""Maximum size in bytes of the values and provenance marks of a batch."""
MAX_IMAGE_BYTES: Final = 32 << 20
"""Maximum size in bytes of the images from which a batch is made."""
LEAST_GAP_NS: Final = 100_000_000
"""Minimum time in ns without frames that counts as a gap. For sources with a long period, it is longer."""
HEAD: Final = struct.Struct("<IId")
"""The format of a batch's head."""
_MILLISECOND: Final = np.timedelta64(1, "ms")

_log = logging.getLogger("shmio.web")


class Follower(Protocol):
    """Receives the batches of feeds."""

    turn: Turn
    """What the follower's client has of the server's time."""

    def take(self, batch: bytes) -> None:
        """Receive a batch. The follower may drop it."""

    def end(self, number: int) -> None:
        """Handle the end of the feed with this number: a reload has replaced its source, or the feed has failed."""


class Feed:
    """Sends the values of some registers of one source to its followers.

    Use it in the event loop's thread only.
    """

    def __init__(self, number: int, block: Block, registers: Sequence[Register], utc_ns: int) -> None:
        """Start with the next frame.

        Args:
            number: The feed's number, which its batches carry.
            block: The source's block.
            registers: The registers; :func:`check_plottable` must have accepted each of them.
            utc_ns: UTC minus the time of CLOCK_MONOTONIC, in ns.

        """
        self.number, self.block, self.registers = number, block, tuple(registers)
        self.followers: set[Follower] = set()
        layout = block.layout
        self._codec = FrameCodec(Layout("", None, layout.size, False, self.registers, layout.byte_order))
        self._cursor = block.cursor()
        self._live = _Packer(self, block.read(self.last) if self.last else None)
        self._utc_ns = utc_ns

    def history(self, last: int) -> tuple[list[bytes], Frame | None]:
        """Return batches of past frames for a new follower, and the last of these frames.

        You may call this from another thread.

        Args:
            last: Number of the last frame to return.

        Returns:
            The batches, and the last frame in them; None if there is no frame.

        """
        block = self.block
        count = min(block.ring.slot_count - 1, last, math.ceil(HISTORY_S * 1e9 / block.period_ns))
        step = max(1, math.ceil(count / MAX_HISTORY))
        packer = _Packer(self, None, step)
        numbers = range(last - (count - 1) // step * step, last + 1, step)
        return list(packer.batches(filter(None, map(block.read, numbers)))), packer.before

    def between(self, before: Frame | None, first: int, last: int) -> list[bytes]:
        """Return the batches of the frames with numbers from ``first`` to ``last``.

        ``before`` is the frame before them; None after a gap.
        """
        return list(_Packer(self, before).batches(filter(None, map(self.block.read, range(first, last + 1)))))

    @property
    def last(self) -> int:
        """Number of the last frame that was sent to the followers."""
        return self._cursor.last

    def send(self) -> None:
        """Send new frames to all followers."""
        batches = self.read()
        for follower in tuple(self.followers):
            for batch in batches:
                follower.take(batch)

    def read(self) -> list[bytes]:
        """Return the batches of the frames that are new since the last call."""
        cursor = self._cursor
        if cursor.behind > MAX_BEHIND:
            cursor.resume(after=cursor.last + cursor.behind - MAX_BEHIND)
        return list(self._live.batches(islice(iter(cursor.poll, None), MAX_BEHIND)))

    def pack(self, before: Frame | None, frames: Sequence[Frame]) -> bytes:
        """Return one batch with these frames.

        Args:
            before: The frame before them; None after a gap.
            frames: The frames.

        """
        rows = len(frames)
        decoded = self._codec.decode(b"".join(frame.image for frame in frames))
        raw = decoded
        if any(frame.effective is not None for frame in frames):
            raw = self._codec.decode(b"".join(frame.raw for frame in frames))
            present = [one for one in self.block.injections.read() if one.direction == "out"]
        columns = np.empty((1 + len(self.registers), rows), "<f8")
        columns[0] = [self._utc_s(frame) for frame in frames]
        marks = np.empty((len(self.registers), rows), np.uint8)
        marks[:] = [frame.provenance for frame in frames]
        bad = np.array([frame.quality is Quality.BAD or not frame.source_ns for frame in frames])
        for index, register in enumerate(self.registers):
            values = decoded[register.path]
            columns[1 + index] = numbers(values)
            columns[1 + index][bad | self._bad(register, frames)] = math.nan
            if raw is not decoded:
                original = raw[register.path]
                altered = (values != original) & ((values == values) | (original == original))  # noqa: PLR0124  not both NaN
                if any(one.covers(register) for one in present):
                    altered |= np.array([frame.effective is not None for frame in frames])
                marks[index][altered] = Provenance.INJECTED
        head = HEAD.pack(self.number, rows, math.nan if before is None else self._utc_s(before))
        return head + columns.tobytes() + marks.tobytes()

    def _utc_s(self, frame: Frame) -> float:
        return (frame.publish_ns + self._utc_ns) / 1e9

    def _bad(self, register: Register, frames: Sequence[Frame]) -> npt.NDArray[np.bool_] | bool:
        """Return for each frame whether the source reports the register as bad."""
        if self.block.statuses is None:
            return False
        statuses = (status_of(self.block, register, frame) for frame in frames)
        return np.array([status is not None and status.quality is Quality.BAD for status in statuses])


class _Packer:
    """Splits a feed's frames into batches: at gaps, and where a batch has become large."""

    def __init__(self, feed: Feed, before: Frame | None = None, step: int = 1) -> None:
        """Create the packer.

        Args:
            feed: The feed.
            before: The frame before the first; None after a gap.
            step: Difference between the numbers of consecutive frames.

        """
        self.before = before
        """The last frame that was packed; None at the start and after a gap."""
        self._feed, self._step = feed, step
        block = feed.block
        self._gap_ns = max(block.stale_ns, 3 * step * block.period_ns, LEAST_GAP_NS)
        self._most = max(
            1, min(MAX_BATCH_BYTES // (9 * len(feed.registers)), MAX_IMAGE_BYTES // max(1, block.layout.size))
        )

    def batches(self, frames: Iterable[Frame]) -> Iterator[bytes]:
        """Split frames into batches, and yield these."""
        start = self.before
        waiting: list[Frame] = []
        for frame in frames:
            gap = self.before is not None and (
                frame.number != self.before.number + self._step
                or frame.publish_ns - self.before.publish_ns > self._gap_ns
            )
            if waiting and (gap or len(waiting) == self._most):
                yield self._feed.pack(start, waiting)
                start, waiting = self.before, []
            if gap:
                start = None
            waiting.append(frame)
            self.before = frame
        if waiting:
            yield self._feed.pack(start, waiting)


class Feeds:
    """The feeds that pages follow. Use it in the event loop's thread only."""

    def __init__(self) -> None:
        self._feeds: dict[tuple[int, tuple[str, ...]], Feed] = {}
        self._number = 0
        self.utc_ns = time.time_ns() - time.monotonic_ns()
        """UTC minus the time of CLOCK_MONOTONIC, in ns. All feeds use it, so that a frame has the same time in each."""
        self._task: asyncio.Task[None] | None = None

    async def follow(self, block: Block, registers: Sequence[Register], follower: Follower) -> Feed:
        """Send a follower the frames of the last seconds, and from then on each new frame. Return the feed.

        Args:
            block: The source's block.
            registers: The registers.
            follower: Receives the batches.

        """
        key = (block.section, tuple(register.path for register in registers))
        feed = self._feeds.get(key)
        if feed is None:
            self._number += 1
            feed = self._feeds[key] = Feed(self._number, block, registers, self.utc_ns)
        last = feed.last
        batches, before = await follower.turn.in_thread(feed.history, last)
        self._feeds[key] = feed  # it may have been removed, because nobody followed it yet
        feed.send()
        for batch in chain(batches, feed.between(before, last + 1, feed.last)):
            follower.take(batch)
        feed.followers.add(follower)
        if self._task is None:
            self._task = asyncio.get_running_loop().create_task(self._send())
        return feed

    @property
    def readers(self) -> Iterator[tuple[Block, int]]:
        """The blocks that pages plot, each with the number of the last frame that was sent."""
        return ((feed.block, feed.last) for feed in self._feeds.values() if feed.followers)

    def leave(self, feed: Feed, follower: Follower) -> None:
        """Remove a follower from a feed."""
        feed.followers.discard(follower)
        if self._task is not None and not any(feed.followers for feed in self._feeds.values()):
            self._task.cancel()
            self._task = None
            self._feeds.clear()

    async def _send(self) -> None:
        """Send new frames at intervals, while pages follow any. The first follower with time left pays for the feed."""
        while True:
            await asyncio.sleep(INTERVAL_S)
            for key, feed in list(self._feeds.items()):
                if not feed.followers:
                    self._feeds.pop(key, None)
                    continue
                await asyncio.sleep(0)
                payer = next((one for one in feed.followers if not one.turn.share.wait_s), None)
                if payer is None:  # the feed's frames wait in the ring; if there are too many, they become a gap
                    continue
                with payer.turn.share:
                    alive = _sent(feed)
                if not alive:
                    self._feeds.pop(key, None)
                    for follower in tuple(feed.followers):
                        follower.end(feed.number)
                        self.leave(feed, follower)


def _sent(feed: Feed) -> bool:
    """Send a feed's new frames; return False if the feed has ended."""
    try:
        retired = feed.block.retired  # before the frames are read: nothing is published after the end
        feed.send()
    except Exception:  # noqa: BLE001  the feeds of other sources continue
        _log.exception("a plot of %s failed and ends", feed.block.source)
        return False
    return not retired


def check_plottable(register: Register) -> None:
    """Check that a register can be plotted: that it is a single number, BOOL or duration.

    Raises:
        PathError: It cannot be plotted.
    """
    kind = np.dtype(_kind(register)).kind
    if register.dims:
        raise PathError(f"{register.path}: this is an array; plot one element, such as {_first(register)}")
    if kind not in "?biufm":
        raise PathError(f"{register.path}: {register.type} is not a number, so it cannot be plotted")


def _kind(register: Register) -> Any:
    codec = FrameCodec(Layout("", None, register.offset + register.size, False, (register,), "big"))
    return codec.dtype[0].base


def _first(register: Register) -> str:
    return "/".join([register.path, *(str(low) for low, _ in register.dims)])


def numbers(values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the values of a plottable register as numbers. Durations are in ms."""
    found: npt.NDArray[np.float64] = values / _MILLISECOND if values.dtype.kind == "m" else values.astype(np.float64)
    return found
