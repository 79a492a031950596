"""From a client's path to a source and a register, whichever wire it came by."""

from __future__ import annotations

from collections.abc import Mapping

from shmio.endpoints.grpc.feed import Feed
from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic, look_up, parse_topic, shorten


class Topics:
    """Looks paths up among the sources that there are by now."""

    def __init__(self, feeds: Mapping[str, Feed], default_source: str | None) -> None:
        """``default_source``: that of paths which name none; default: the only one."""
        self._feeds = feeds
        self._default = default_source

    def topic(self, path: str) -> Topic:
        """What a path says; PathError: no source of that name."""
        default = self._default or (next(iter(self._feeds)) if len(self._feeds) == 1 else None)
        topic = parse_topic(path, self._feeds, default)
        if topic.source not in self._feeds:
            raise PathError(f"{shorten(path)}: {topic.source} is reserved, and this version serves nothing there")
        return topic

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
