"""The feeds of all sources; a reload may add or remove sources, or change their layout."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping

from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.wakeups import WakeUps
from shmio.endpoints.grpc.time.virtual_time import VirtualTime
from shmio.segment import Segment


class Feeds(Mapping[str, Feed]):
    """The feeds of a segment's blocks, by source name; for the event loop's thread."""

    def __init__(
        self,
        segment: Segment,
        writer: int,
        wake_ups: WakeUps,
        on_quality: Callable[[str, bool], None],
        virtual_time: VirtualTime | None = None,
    ) -> None:
        """Start without feeds; see :meth:`start`.

        Args:
            segment: The instance's shared memory.
            writer: The command queue of this process.
            wake_ups: Wakes the feeds when their blocks have something new.
            on_quality: Called with a source's name, and whether its quality is good.
            virtual_time: See :class:`Feed`.

        """
        self._segment = segment
        self._generation = -1  # of the segment when it was last read
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

    @property
    def messages(self) -> int:
        """Number of messages encoded since the start."""
        return self._ended_messages + sum(feed.messages for feed in (*self._feeds.values(), *self._ended))

    @property
    def alive(self) -> bool:
        """Whether every block is being followed."""
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
        """Adopt what a reload has changed.

        Returns:
            The sources that were added or removed, or have a new feed.

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
        self._generation = self._segment.generation  # first: a change during the read is noticed next time
        self._segment.refresh()
        for block in self._segment.blocks.values():
            block.layout.members(""), block.layout.by_path

    def _prune(self) -> None:
        """Forget the feeds that are over, and release what they hold of the segment."""
        over = [feed for feed in self._ended if feed.over]
        self._ended_messages += sum(feed.messages for feed in over)
        self._ended = [feed for feed in self._ended if feed not in over]

    def stop(self) -> None:
        """Stop all feeds."""
        for feed in (*self._feeds.values(), *self._ended):
            feed.stop()
