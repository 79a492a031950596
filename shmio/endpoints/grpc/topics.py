"""Resolves clients' paths to sources and registers, for all services."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from enum import Enum
from typing import Final, NamedTuple

from shmio.endpoints.grpc.streams.feed import Feed
from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic, look_up, parse_topic, shorten
from shmio.segment import Block
from shmio.wording import unknown


class TimeTopic(Enum):
    """The time topics, which belong to no source. The values are the topics' canonical paths."""

    STEP = "simlog/step"
    """Number of each step, sent after all values of the step."""
    CLOCK = "model/clock"
    """The simulation time."""


_TIME_TOPICS: Final = {time_topic.value: time_topic for time_topic in TimeTopic}


class Topics:
    """Resolves paths to the sources that exist at present."""

    def __init__(self, feeds: Mapping[str, Feed], default_source: str | None) -> None:
        """Create the resolver.

        Args:
            feeds: The feeds of all sources, by name.
            default_source: The source of paths that name no source; if None, the only source, if
                there is just one.

        """
        self._feeds = feeds
        self._default = default_source

    def topic(self, path: str) -> Topic:
        """Parse the path of a topic of a source.

        Raises:
            PathError: There is no such source, or the path names a time topic.

        """
        topic = self._parse(path)
        if topic.source not in self._feeds:
            if self._time_topic(topic):
                raise PathError(f"{shorten(path)}: clients can only subscribe to this topic")
            raise PathError(
                f"{shorten(path)}: {topic.source} is reserved; only SIMLOG://step, model/clock and existing shadows "
                "are available"
            )
        return topic

    def time_topic(self, path: str) -> TimeTopic | None:
        """Return the time topic that a path names; None if it names none.

        Raises:
            PathError: There is no such source.

        """
        return self._time_topic(self._parse(path))

    def _time_topic(self, topic: Topic) -> TimeTopic | None:
        return _TIME_TOPICS.get(f"{topic.source}/{topic.path}") if topic.direction != "in" else None

    def name(self, path: str) -> str:
        """Return the canonical form of a path, even if no such topic exists."""
        try:
            return str(self._parse(path))
        except PathError:
            return path.removeprefix("/")

    def _parse(self, path: str) -> Topic:
        default = self._default or (next(iter(self._feeds)) if len(self._feeds) == 1 else None)
        return parse_topic(path, self._feeds, default)

    def feed(self, source: str) -> Feed:
        """Return the feed of a source.

        Raises:
            PathError: A reload has removed the source.

        """
        if source not in self._feeds:
            raise PathError(f"source {source} was removed by a reload")
        return self._feeds[source]

    def blocks(self, sources: Collection[str]) -> list[Block]:
        """Return the blocks of these sources; of all sources if ``sources`` is empty.

        Raises:
            PathError: There is no such source.

        """
        for source in sources:
            if source not in self._feeds:
                raise PathError(unknown("source", source, self._feeds))
        return [self._feeds[source].block for source in dict.fromkeys(sources) or self._feeds]

    def layout(self, topic: Topic) -> Layout:
        """Return the layout of a topic's source.

        Raises:
            PathError: A reload has removed the source.

        """
        return self.feed(topic.source).block.layout

    def register(self, topic: Topic) -> Register:
        """Return the register of a topic.

        Raises:
            PathError: There is no such register; the message lists similar names.

        """
        return look_up(self.layout(topic), topic)


class Shape(NamedTuple):
    """The registers that a path names.

    Attributes:
        path: Canonical path in the block.
        registers: One register or array element, or all registers of a structure.
        whole: True if the path names a register or an element, False if it names a structure.

    """

    path: str
    registers: tuple[Register, ...]
    whole: bool

    @property
    def elements(self) -> int:
        """Number of values in all registers together: numbers, bits and texts."""
        return sum(register.count for register in self.registers)


def shape(layout: Layout, topic: Topic) -> Shape:
    """Return the registers that a topic names in a layout.

    A structure of the data block has only the block's own members, without those that a tag table
    adds, because old clients expect the same message as before.

    Raises:
        PathError: There is no such register or structure.

    """
    below = layout.base.members(topic.path) or layout.members(topic.path)
    if below:
        return Shape(topic.path, tuple(layout.registers[index] for index in below), whole=False)
    return Shape(topic.path, (look_up(layout, topic),), whole=True)
