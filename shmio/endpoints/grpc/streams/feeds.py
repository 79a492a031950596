"""The feeds of all sources that there are by now: a reload may add sources, end them, or change their layout."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping

from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.wakeups import WakeUps
from shmio.endpoints.grpc.time.virtual_time import VirtualTime
from shmio.segment import Segment


class Feeds(Mapping[str, Feed]):
    """A feed for each block of a segment, by its source's name; for the event loop's thread."""

    def __init__(
        self,
        segment: Segment,
        writer: int,
        wake_ups: WakeUps,
        on_quality: Callable[[str, bool], None],
        virtual_time: VirtualTime | None = None,
    ) -> None:
        """``writer``: the command queue of this process. ``on_quality``: told whether a source is good by now.

        ``hold``: see :class:`Feed`.
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
        """Messages made since the start."""
        return self._ended_messages + sum(feed.messages for feed in (*self._feeds.values(), *self._ended))

    @property
    def alive(self) -> bool:
        """Whether every block is being followed."""
        return all(feed.alive for feed in self._feeds.values())

    def start(self) -> None:
        """Begin to follow all blocks that are not followed yet."""
        for source, block in self._segment.blocks.items():
            if source not in self._feeds:
                feed = self._feeds[source] = Feed(
                    block, self._writer, self._wake_ups, self._on_quality, self._virtual_time
                )
                self._on_quality(source, False)
                feed.start()

    async def follow(self) -> list[str]:
        """Take up what a reload has changed; the sources whose feed is another by now, those that came or went too.

        FormatError: the segment makes no sense any more.
        """
        self._prune()
        if self._segment.generation == self._generation:
            return []
        await asyncio.to_thread(self._read)
        before = dict(self._feeds)
        over = [name for name, feed in self._feeds.items() if self._segment.blocks.get(name) is not feed.block]
        for name in over:
            feed = self._feeds.pop(name)
            self._ended.append(feed)  # it ends by itself, when all is read
            self._on_quality(name, False)
        self.start()
        return [name for name in before | self._feeds if before.get(name) is not self._feeds.get(name)]

    def _read(self) -> None:
        """Read what there is by now: for a big layout it takes a second, in which streams of others must not stand."""
        self._generation = self._segment.generation  # before looking: what changes meanwhile is read the next time
        self._segment.refresh()
        for block in self._segment.blocks.values():
            block.layout.members(""), block.layout.by_path

    def _prune(self) -> None:
        """Forget the feeds of which nothing is left, and with them what they hold of the segment."""
        over = [feed for feed in self._ended if feed.over]
        self._ended_messages += sum(feed.messages for feed in over)
        self._ended = [feed for feed in self._ended if feed not in over]

    def stop(self) -> None:
        """Follow nothing any more."""
        for feed in (*self._feeds.values(), *self._ended):
            feed.stop()
