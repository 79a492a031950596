"""Follows one block in a thread: one change scan for each frame, one encoding for each change, whoever listens."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterable, Sized
from typing import NamedTuple, Protocol

from shmio.endpoints.grpc.inlet import Inlet
from shmio.endpoints.grpc.subject import Subject
from shmio.segment import Block, Frame, Quality
from shmio.segment.scan import ChangeScan, entries

log = logging.getLogger("shmio.grpc")

CATCH_UP_FRAMES = 32
"""A feed that is further behind than this goes on with the newest frame: what it skips is conflated, not lost."""

WAIT_S = 0.2
"""Longest wait for a frame before age is looked at."""


class Listener(Protocol):
    """One stream; called in the event loop's thread."""

    since: int
    """Frame whose value the stream already has."""

    def deliver(self, message: Sized) -> None:
        """Take one message for this stream."""

    def lose(self) -> None:
        """Quality is bad: what was not sent yet must not be sent any more."""


class Channel:
    """A subject as somebody listens to it: how a frame becomes a message, and who gets it."""

    def __init__(self, subject: Subject, slot: int) -> None:
        """``slot``: its place in the feed's table."""
        self.encode = subject.encode
        self.listeners: set[Listener] = set()
        self.slot = slot
        self.entries = entries(subject.registers, slot)


class _Table(NamedTuple):
    slots: tuple[Channel | None, ...]
    scan: ChangeScan


class Feed:
    """Delivers the changes of one block's registers to listeners while quality is good.

    On recovery from bad quality every register is delivered again. ``listen`` and ``leave`` belong to the event loop's
    thread; the thread of the feed only reads the table that they replace.
    """

    def __init__(
        self,
        block: Block,
        writer: int,
        loop: asyncio.AbstractEventLoop,
        on_quality: Callable[[str, bool], None],
    ) -> None:
        """``writer``: the command queue of this process."""
        self.block = block
        self.inlet = Inlet(block, writer, loop)
        """The other direction."""
        self.messages = 0
        self._loop = loop
        self._on_quality = on_quality
        self._channels: dict[Subject, Channel] = {}
        self._free: list[int] = []  # slots
        self._table = _Table((), ChangeScan([]))
        self._outdated = False
        self._owed: dict[Listener, Channel] = {}  # joined while there was no good value
        _ = block.layout.members("")  # builds what paths are looked up in, before the first client waits for it
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"feed-{block.source}", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether the block is being followed, as long as there is something to come."""
        return (self._thread.is_alive() or self.block.retired) and self.inlet.alive

    @property
    def over(self) -> bool:
        """Whether nothing is left of it: neither a thread nor a stream."""
        return not (self._thread.is_alive() or self._channels) and self.inlet.over

    def start(self) -> None:
        """Begin to follow the block."""
        self._thread.start()
        self.inlet.start()

    def stop(self) -> None:
        """Tell the thread to end; it does within ``WAIT_S``."""
        self._stopping.set()
        self.inlet.stop()

    def join(self) -> None:
        """Wait until the thread has ended."""
        self._thread.join()
        self.inlet.join()

    def listen(self, subject: Subject, listener: Listener) -> None:
        """Join a subject's listeners; the current value is delivered at once, or as soon as it is good."""
        channel = self._channels.get(subject)
        if channel is None:
            slot = self._free.pop() if self._free else len(self._channels)
            channel = self._channels[subject] = Channel(subject, slot)
            self._rebuild()
        channel.listeners.add(listener)
        listener.since = 0
        self._owed[listener] = channel
        self._settle()

    def leave(self, subject: Subject, listener: Listener) -> None:
        """Leave; the last listener takes the channel with it."""
        self._owed.pop(listener, None)
        channel = self._channels[subject]
        channel.listeners.discard(listener)
        if not channel.listeners:
            del self._channels[subject]
            self._free.append(channel.slot)
            if not self._outdated:  # once for all who leave together
                self._outdated = True
                self._loop.call_soon(self._rebuild)

    def _settle(self) -> None:
        """Give those who are owed a value the newest one, if it is good."""
        frame = self.block.latest() if self._owed else None
        if frame is None or self.block.assess(frame)[0] is Quality.BAD:
            return
        for listener, channel in self._owed.items():
            listener.since = frame.number
            message = channel.encode(frame)
            if message is not None:
                listener.deliver(message)
        self._owed.clear()

    def _deliver(self, frame: int, batch: list[tuple[Channel, Sized]]) -> None:
        """Hand a frame's messages to all who have not seen that frame yet."""
        for channel, message in batch:
            for listener in channel.listeners:
                if frame > listener.since:
                    self._owed.pop(listener, None)
                    listener.deliver(message)
        self._settle()

    def _turn_bad(self, frame: int) -> None:
        """Quality is bad from ``frame`` on, for all who have not joined later."""
        for channel in self._channels.values():
            for listener in channel.listeners:
                if listener.since < frame:
                    listener.lose()
                    listener.since = 0  # it may have lost this very value
        self._on_quality(self.block.source, False)

    def _rebuild(self) -> None:
        slots: list[Channel | None] = [None] * (len(self._channels) + len(self._free))
        for channel in self._channels.values():
            slots[channel.slot] = channel
        self._table = _Table(tuple(slots), ChangeScan.joined(channel.entries for channel in self._channels.values()))
        self._outdated = False

    # ---- the feed's own thread ---------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._follow()
        except Exception:
            log.exception("the feed of %s failed", self.block.source)

    def _follow(self) -> None:
        block = self.block
        newest = block.latest()
        cursor = block.cursor(after=newest.number - 1 if newest else 0)
        shown: Frame | None = None  # what listeners have seen; None while quality is bad
        while not self._stopping.is_set():
            if cursor.behind > CATCH_UP_FRAMES:
                cursor = block.cursor(after=block.ring.head() - 1)
            retired = block.retired
            frame = cursor.next(timeout_s=min(WAIT_S, block.stale_ns / 1e9))
            if frame is None and retired:
                return
            good = frame is not None and block.assess(frame)[0] is not Quality.BAD
            # Age by the next frame's time, if there is one: it may have been stale while nobody was awake to see it.
            until_ns = frame.publish_ns if frame else block.now_ns()
            stale = shown is not None and shown.age_ns(until_ns) > block.stale_ns
            if shown is not None and (stale or (frame is not None and not good)):
                since = shown.number + 1 if frame is None else frame.number
                shown = None
                self._loop.call_soon_threadsafe(self._turn_bad, since)
            if frame is not None and good:
                self._show(shown, frame)
                shown = frame

    def _show(self, shown: Frame | None, frame: Frame) -> None:
        """Encode what has changed since the frame shown before; everything, if there is none."""
        slots, scan = self._table
        if shown is None:
            self._loop.call_soon_threadsafe(self._on_quality, self.block.source, True)
            news: Iterable[Channel | None] = slots
        else:
            news = [slots[i] for i in scan.changed(shown.image, frame.image)]
        batch = [(channel, message) for channel in news if channel and (message := channel.encode(frame)) is not None]
        if batch or self._owed:
            self.messages += len(batch)
            self._loop.call_soon_threadsafe(self._deliver, frame.number, batch)
