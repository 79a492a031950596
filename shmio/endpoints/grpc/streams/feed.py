"""Follows one block: finds the changes in each frame once, and encodes each change once."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sized, ValuesView
from typing import Final, NamedTuple, Protocol

from shmio.endpoints.grpc.commands.command_client import CommandClient
from shmio.endpoints.grpc.encoding import Subject
from shmio.endpoints.grpc.streams.back_pressure import BackPressure, Stream
from shmio.endpoints.grpc.wakeups import BatchReader, WakeUps
from shmio.model.statuses import StatusArea
from shmio.segment import Block, Event, Frame, FrameFollower, Quality, QualityChange, Segment
from shmio.segment.changed_registers import ChangeScan, entries


class Moment(NamedTuple):
    """A step's number, and the simulation time after the step, in ns since the instance's start."""

    number: int
    clock_ns: int


class DeliveredImage(NamedTuple):
    """The image of a block after a step. ``raw`` is the image without injections."""

    number: int
    clock_ns: int
    image: bytes
    raw: bytes


class VirtualTime:
    """The state of virtual time, as the feeds need it.

    ``on`` is True while time is virtual. ``moment`` is the last step that was delivered. In virtual
    time, the values of blocks on the instance's clock are delivered step by step. Use it only in
    the event loop's thread.
    """

    def __init__(self) -> None:
        self.on = False
        self.update: Callable[[], object] = lambda: None
        """Function that adopts the steps that other programs have made. The timeline sets it."""
        self.moment = Moment(0, 0)


class Listener(Protocol):
    """A stream's subscription to one subject. The methods are called in the event loop's thread."""

    @property
    def stream(self) -> Stream:
        """The stream that this listener belongs to."""

    since: int
    """Number of the frame whose value the stream already has; 0 if it has none."""

    def deliver(self, message: Sized, at_s: float | None = None) -> None:
        """Add one message to the stream.

        Args:
            message: The message.
            at_s: Time of the message, in s of the monotonic clock; None for now.

        """

    def keep(self, message: Sized) -> None:
        """Queue a message of a step. It must not be dropped."""

    def lose(self) -> None:
        """Drop the messages that have not been sent yet, because the quality has become bad."""


class _Channel:
    """A subject with its listeners. It encodes the subject's value once for all of them."""

    def __init__(self, subject: Subject, slot: int, statuses: StatusArea | None) -> None:
        """Create a channel without listeners.

        Args:
            subject: The subject.
            slot: Index of the channel in the feed's table.
            statuses: The status area of the block's images.

        """
        self.encode = subject.encode
        self.listeners: dict[Listener, None] = {}  # in the order in which they came
        self.slot = slot
        first = subject.registers[0]
        self.order = first.offset, first.bit or 0, subject.path, subject.wire
        """Sort key: the changes of a step are delivered in the order of the block's registers."""
        self.changed = subject.changed
        self.entries = b"" if self.changed else entries(subject.registers, slot, statuses)


class _ChannelTable(NamedTuple):
    """All channels of a block, and the scan that finds those whose bytes have changed."""

    slots: tuple[_Channel | None, ...]
    scan: ChangeScan
    apart: tuple[_Channel, ...]
    """Channels whose subject has its own function to compare two images."""

    @classmethod
    def of(cls, channels: Collection[_Channel], slots: int) -> _ChannelTable:
        """Build the table of these channels. It has ``slots`` slots, some of which may be free."""
        places: list[_Channel | None] = [None] * slots
        for channel in channels:
            places[channel.slot] = channel
        apart = tuple(channel for channel in channels if channel.changed)
        return cls(tuple(places), ChangeScan.joined(channel.entries for channel in channels), apart)


TURN_FRAMES: Final = 8
"""Maximum number of frames that are delivered before the event loop serves the streams again."""


class Feed:
    """Delivers the changes of one block's registers to listeners, while the quality is good.

    After bad quality, the feed delivers every register again. In virtual time, the feed of a block
    on the instance's clock is *suspended*: only :meth:`step` delivers its values. Use it only in
    the event loop's thread.
    """

    def __init__(
        self,
        block: Block,
        writer: int,
        wake_ups: WakeUps,
        on_quality: Callable[[str, bool], None],
        virtual_time: VirtualTime | None = None,
    ) -> None:
        """Create a feed; :meth:`start` starts it.

        Args:
            block: The block to follow.
            writer: Number of this process's command queue.
            wake_ups: Wakes the feed when the block has a new frame or event.
            on_quality: Called with the source's name, and whether its quality is good.
            virtual_time: The state of virtual time; None if time is always real.

        """
        self.block = block
        self.commands = CommandClient(block, writer, wake_ups, self._stamp)
        """Sends commands to the block's source."""
        self.messages = 0
        self._virtual_time = virtual_time or VirtualTime()
        self._suspended = self._virtual_time.on and block.attributes.stepped
        self._stepped = False  # whether a step was delivered since the feed has been suspended
        self._shown: Frame | DeliveredImage | None = None  # the last delivery; None while the quality is bad
        self._good = False  # the quality that was reported last
        self._loop = asyncio.get_running_loop()
        self._on_quality = on_quality
        self._channels: dict[Subject, _Channel] = {}
        self._back_pressure = BackPressure(block, self._refill)
        self._free: list[int] = []  # unused slots
        self._table = _ChannelTable.of((), 0)
        self._outdated = False
        self._awaiting_value: dict[Listener, _Channel] = {}  # listeners that wait for a good value
        _ = block.layout.members("")  # builds the index of paths before the first client needs it
        self._follower = FrameFollower(block, notice_gaps=True)
        self._reader = BatchReader(block, wake_ups, self._read, passes=self._passes)

    @property
    def alive(self) -> bool:
        """True while the feed follows the block and its events, and also once a reload has retired the block."""
        return (self._reader.alive or self.block.retired) and self.commands.alive

    @property
    def last(self) -> int:
        """Number of the last frame that the feed has read."""
        return self._follower.last

    @property
    def over(self) -> bool:
        """True if the feed has ended, and has no listeners and no commands in flight."""
        return not (self._reader.alive or self._channels) and self.commands.over

    def start(self) -> None:
        """Start following the block."""
        if self._suspended:
            self._adopt(self.block.latest())
        self._follower.restart()
        self.commands.start()  # first, so that a write is delivered before the frame that shows it
        self._reader.start()

    def stop(self) -> None:
        """Stop following the block."""
        self._reader.stop()
        self.commands.stop()

    def listen(self, subject: Subject, listener: Listener) -> None:
        """Add a listener. It gets the present value at once, or as soon as the quality is good."""
        channel = self._channels.get(subject)
        if channel is None:
            slot = self._free.pop() if self._free else len(self._channels)
            channel = self._channels[subject] = _Channel(subject, slot, self.block.statuses)
            self._rebuild()
        channel.listeners[listener] = None
        self._back_pressure.join(listener.stream)
        listener.since = 0
        self._awaiting_value[listener] = channel
        self._settle()

    def leave(self, subject: Subject, listener: Listener) -> None:
        """Remove a listener. If it was the last listener to the subject, the channel ends."""
        self._awaiting_value.pop(listener, None)
        channel = self._channels[subject]
        del channel.listeners[listener]
        self._back_pressure.leave(listener.stream)
        if not channel.listeners:
            del self._channels[subject]
            self._free.append(channel.slot)
            if not self._outdated:  # rebuild once for all listeners that leave together
                self._outdated = True
                self._loop.call_soon(self._rebuild)

    def deliver_again(self, subject: Subject) -> None:
        """Deliver the value of a subject again, because it has changed without a new frame."""
        if channel := self._channels.get(subject):
            self._awaiting_value |= dict.fromkeys(channel.listeners, channel)
            self._settle()

    def suspend(self) -> None:
        """From now on, deliver values only by :meth:`step`, if the block is on the instance's clock."""
        self._suspended = self.block.attributes.stepped

    def resume(self) -> None:
        """Deliver every frame from now on, because time is real again.

        The newest frame comes first, because it may be newer than the last step.
        """
        if not self._suspended:
            return
        self._suspended = self._stepped = False
        self._follower.restart()
        self._reader.resume()
        self._reader.read_batch()
        self._settle()

    def step(self) -> None:
        """Deliver the changes of a step: the differences from the last delivery.

        The changes come in the order of the block's registers.

        Raises:
            SegmentError: No frame can be read.

        """
        if not self._suspended:
            return
        self._stepped = True
        frame = self.block.latest()
        if frame is None or frame.quality is Quality.BAD:
            self._shown = None
            return
        shown, self._shown = self._shown, DeliveredImage(*self._virtual_time.moment, frame.image, frame.raw)
        if not self._channels:
            return
        for channel in sorted(self._changes(shown, frame), key=lambda channel: channel.order):
            self._keep(channel.listeners, channel.encode(self._shown))
        self._settle()

    def _keep(self, listeners: Iterable[Listener], message: Sized | None) -> None:
        if message is not None:
            self.messages += 1
            for listener in listeners:
                self._awaiting_value.pop(listener, None)
                listener.keep(message)

    def _adopt(self, frame: Frame | None) -> None:
        """Deliver the first good image, if no step has been delivered yet."""
        if self._suspended and not self._stepped and self._shown is None and frame and frame.quality is not Quality.BAD:
            self._shown = DeliveredImage(*self._virtual_time.moment, frame.image, frame.raw)
            self._settle()

    def _settle(self) -> None:
        """Deliver the current value, if it is good, to the listeners that wait for a value."""
        if self._suspended:
            if self._shown is not None:
                for listener, channel in list(self._awaiting_value.items()):
                    self._keep([listener], channel.encode(self._shown))
                self._awaiting_value.clear()
            return
        frame = self.block.latest() if self._awaiting_value else None
        if frame is None or self.block.assess(frame)[0] is Quality.BAD:
            return
        for listener, channel in self._awaiting_value.items():
            listener.since = frame.number
            message = channel.encode(frame)
            if message is not None:
                listener.deliver(message, frame.publish_ns / 1e9)
        self._awaiting_value.clear()

    def _turn_bad(self, frame: int) -> None:
        """Drop listeners' values older than ``frame``, because its quality is bad."""
        self._shown = None
        for channel in self._channels.values():
            self._lose(channel, frame)
        self._report_quality(good=False)

    def _lose(self, channel: _Channel, frame: int) -> None:
        """Drop a channel's waiting values older than ``frame``. They are no longer valid."""
        for listener in channel.listeners:
            if listener.since < frame:
                listener.lose()
                listener.since = 0  # the value may have been dropped

    def _rebuild(self) -> None:
        self._table = _ChannelTable.of(self._channels.values(), len(self._channels) + len(self._free))
        self._outdated = False

    # ---- what the source publishes -----------------------------------------------------------------------------

    def _passes(self) -> bool:
        return not self._suspended and self._back_pressure.passes()

    def _refill(self) -> None:
        """Continue to read, because a stream that was busy can take more values."""
        if self._reader.alive:
            self._reader.read()
            if not self._back_pressure.passes():
                self._reader.resume()

    def _read(self) -> bool:
        """Read a few new frames. If there are none, check the age of the last frame."""
        follower = self._follower
        if not self._suspended:  # a suspended feed delivers only steps
            self._back_pressure.skip(follower)
        take = self._regard if self._suspended else self._take
        for count in range(TURN_FRAMES):
            frame = follower.poll()
            if frame is not None:
                take(frame)
                continue
            if not (count or self._suspended) and follower.became_stale():
                self._turn_bad(follower.last + 1)
            if follower.ended:
                self._reader.stop()
            elif self._suspended:
                self._rest(count)
            return False
        return True

    def _rest(self, frames: int) -> None:
        """Pause the wake-ups after these frames of a suspended feed, unless somebody waits for an event."""
        if not self.commands.idle:
            self._reader.resume()
        elif frames:  # without a new frame, there is nothing to rest from
            self._reader.pause()

    def _take(self, frame: Frame) -> None:
        """Deliver a frame if its quality is good.

        If its quality is bad, or if the previous frame had become stale, drop the waiting values.
        """
        change = self._follower.take(frame)
        bad = self._follower.quality is Quality.BAD
        if self._shown is not None and (bad or change is QualityChange.GAP):
            self._turn_bad(frame.number)
        if not bad:
            if not self._good:
                self._report_quality(good=True)
            self._show(self._shown, frame)
            self._shown = frame

    def _regard(self, frame: Frame) -> None:
        """Report a change of quality at once, although the values wait for a step."""
        self._report_quality(good=frame.quality is not Quality.BAD)
        self._adopt(frame)

    def _report_quality(self, *, good: bool) -> None:
        if good != self._good:
            self._good = good
            self._on_quality(self.block.source, good)

    def _show(self, shown: Frame | DeliveredImage | None, frame: Frame) -> None:
        """Deliver the changes since ``shown`` to the listeners that do not have this frame yet.

        If ``shown`` is None, deliver all values.
        """
        for channel in self._changes(shown, frame):
            message = channel.encode(frame)
            if message is None:
                self._lose(channel, frame.number)
                continue
            self.messages += 1
            for listener in channel.listeners:
                if frame.number > listener.since:
                    self._awaiting_value.pop(listener, None)
                    listener.deliver(message, frame.publish_ns / 1e9)
        if self._awaiting_value:
            self._settle()

    def _changes(self, shown: Frame | DeliveredImage | None, frame: Frame) -> list[_Channel]:
        """Return the channels whose bytes have changed since ``shown``; None: all channels."""
        slots, scan, apart = self._table
        if shown is None:
            return [channel for channel in slots if channel]
        changes = [channel for slot in scan.changed(shown.image, frame.image) if (channel := slots[slot])]
        return changes + [channel for channel in apart if channel.changed and channel.changed(shown, frame)]

    def present(self) -> Frame | DeliveredImage | None:
        """Return the image that a new listener would get; None if the quality is not good."""
        if self._suspended:
            self._virtual_time.update()
            return self._shown
        frame = self.block.latest()
        return None if frame is None or self.block.assess(frame)[0] is Quality.BAD else frame

    def _stamp(self, event: Event) -> tuple[int, int]:
        """Return the number and the time to report for an event.

        They are those of the event's frame, or in virtual time those of the last step.
        """
        return self._virtual_time.moment if self._suspended else Moment(event.frame, event.clock_ns)


class Feeds(Mapping[str, Feed]):
    """The feeds of a segment's blocks, by source name. Use it only in the event loop's thread."""

    def __init__(
        self,
        segment: Segment,
        writer: int,
        wake_ups: WakeUps,
        on_quality: Callable[[str, bool], None],
        virtual_time: VirtualTime | None = None,
    ) -> None:
        """Prepare the mapping; :meth:`start` creates the feeds.

        Args:
            segment: The instance's shared memory.
            writer: Number of this process's command queue.
            wake_ups: Wakes the feeds when their blocks have new frames or events.
            on_quality: Called with a source's name, and whether its quality is good.
            virtual_time: The state of virtual time; None if time is always real.

        """
        self._segment = segment
        self._generation = -1  # the segment's generation at the last read
        self._writer = writer
        self._wake_ups = wake_ups
        self._on_quality = on_quality
        self._virtual_time = virtual_time
        self._feeds: dict[str, Feed] = {}
        self._ended: list[Feed] = []
        self._ended_messages = 0

    def __getitem__(self, source: str) -> Feed:
        return self._feeds[source]

    def __iter__(self) -> Iterator[str]:
        return iter(self._feeds)

    def __len__(self) -> int:
        return len(self._feeds)

    def values(self) -> ValuesView[Feed]:
        """Return all feeds. Each step needs them; the method of Mapping would look up each by its name."""
        return self._feeds.values()

    @property
    def messages(self) -> int:
        """Number of messages encoded since the start."""
        return self._ended_messages + sum(feed.messages for feed in (*self._feeds.values(), *self._ended))

    @property
    def readers(self) -> Iterator[tuple[Block, int]]:
        """The blocks of the feeds, each with the number of the last frame read."""
        return ((feed.block, feed.last) for feed in self._feeds.values())

    @property
    def alive(self) -> bool:
        """True if all feeds follow their blocks."""
        return all(feed.alive for feed in self._feeds.values())

    def start(self) -> None:
        """Start a feed for each block that has none."""
        for source, block in self._segment.blocks.items():
            if source not in self._feeds:
                feed = self._feeds[source] = Feed(
                    block, self._writer, self._wake_ups, self._on_quality, self._virtual_time
                )
                self._on_quality(source, False)
                feed.start()

    async def follow(self) -> list[str]:
        """Adopt the changes of a reload.

        Returns:
            The sources that were added or removed, or that have a new feed.

        Raises:
            FormatError: The segment is damaged.

        """
        self._prune()
        if self._segment.generation == self._generation:
            return []
        await asyncio.to_thread(self._read)
        before = dict(self._feeds)
        over = [name for name, feed in self._feeds.items() if self._segment.blocks.get(name) is not feed.block]
        for name in over:
            feed = self._feeds.pop(name)
            self._ended.append(feed)  # it ends by itself after its last frame
            self._on_quality(name, False)
        self.start()
        return [name for name in before | self._feeds if before.get(name) is not self._feeds.get(name)]

    def _read(self) -> None:
        """Read the segment's blocks. Runs in a thread, because a large layout takes a second."""
        self._generation = self._segment.generation  # first, so that the next call notices a change during the read
        self._segment.refresh()
        for block in self._segment.blocks.values():
            block.layout.members(""), block.layout.by_path

    def _prune(self) -> None:
        """Forget the feeds that have ended, and release their parts of the segment."""
        over = [feed for feed in self._ended if feed.over]
        self._ended_messages += sum(feed.messages for feed in over)
        self._ended = [feed for feed in self._ended if feed not in over]

    def stop(self) -> None:
        """Stop all feeds."""
        for feed in (*self._feeds.values(), *self._ended):
            feed.stop()
