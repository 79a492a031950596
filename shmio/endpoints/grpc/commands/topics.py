"""From a client's path to a source and a register, whichever wire it came by."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final

from shmio.endpoints.grpc.streams.feed import Feed
from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic, look_up, parse_topic, shorten


class TimeTopic(Enum):
    """A topic of time, which no source has: its path in canonical form."""

    STEP = "simlog/step"
    """The number of each step, when all else of that has been told."""
    CLOCK = "model/clock"
    """Simulation time."""


_TIME_TOPICS: Final = {time_topic.value: time_topic for time_topic in TimeTopic}


class Topics:
    """Looks paths up among the sources that there are by now."""

    def __init__(self, feeds: Mapping[str, Feed], default_source: str | None) -> None:
        """``default_source``: that of paths which name none; default: the only one."""
        self._feeds = feeds
        self._default = default_source

    def topic(self, path: str) -> Topic:
        """What a path says; PathError: no source of that name."""
        topic = self._parse(path)
        if topic.source not in self._feeds:
            if self._time_topic(topic):
                raise PathError(f"{shorten(path)}: it can be subscribed to, and nothing else")
            raise PathError(
                f"{shorten(path)}: {topic.source} is reserved; SIMLOG://step, model/clock and shadows that stand are "
                "all there is"
            )
        return topic

    def time_topic(self, path: str) -> TimeTopic | None:
        """The topic of time that a path names; None: another one. PathError as of :meth:`topic`."""
        return self._time_topic(self._parse(path))

    def _time_topic(self, topic: Topic) -> TimeTopic | None:
        return _TIME_TOPICS.get(f"{topic.source}/{topic.path}") if topic.direction != "in" else None

    def name(self, path: str) -> str:
        """One name for all ways to write a path, also one that names nothing here."""
        try:
            return str(self._parse(path))
        except PathError:
            return path.removeprefix("/")

    def _parse(self, path: str) -> Topic:
        default = self._default or (next(iter(self._feeds)) if len(self._feeds) == 1 else None)
        return parse_topic(path, self._feeds, default)

    def feed(self, source: str) -> Feed:
        """The feed of a source; PathError: a reload has removed it."""
        if source not in self._feeds:
            raise PathError(f"source {source} was removed by a reload")
        return self._feeds[source]

    def layout(self, topic: Topic) -> Layout:
        """The layout of a topic's source; PathError as of :meth:`feed`."""
        return self.feed(topic.source).block.layout

    def register(self, topic: Topic) -> Register:
        """The register of a topic; PathError: there is none, the message has near names."""
        return look_up(self.layout(topic), topic)
