"""Version 2's subscribers: a stream each, for all of their topics."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Final

from shmio.endpoints.grpc.marks import Marks
from shmio.endpoints.grpc.outbox import EventLane, Finish, Lane, Outbox, StateLane
from shmio.endpoints.grpc.shadows import Shadow, Shadows, Way
from shmio.endpoints.grpc.shape import shape
from shmio.endpoints.grpc.topics import Mark, Topics
from shmio.endpoints.grpc.values import Encoded, encoder, marked, path_field, subject
from shmio.errors import ConflictError, EndpointError, PathError, ShmioError, ValueRangeError
from shmio.layout.topic import Topic, shorten
from shmio.logs import fields

MAX_SUBSCRIBERS: Final = 256
MAX_TOPICS: Final = 10_000
"""Of one subscriber."""
MAX_ALL_TOPICS: Final = 100_000
"""Of all subscribers."""
MAX_NAME: Final = 256
"""Characters of a subscriber's name, and of its uuid."""
PATIENCE_S: Final = 1.0
"""So long Subscribe waits for its subscriber: the two calls may arrive in any order."""

log = logging.getLogger("shmio.grpc")


@dataclass(slots=True)
class _Subscription:
    """``topic``: None of an injection's. ``leave``: None while no source has such a topic."""

    topic: Topic | Mark | None
    lane: Lane | None
    leave: Callable[[], None] | None = None


class Subscriber:
    """One CreateSubscriber call."""

    def __init__(
        self, topics: Topics, shadows: Shadows, marks: Marks, name: str, outbox: Outbox, holder: object
    ) -> None:
        """``holder``: whose it is."""
        self.name = name
        self.outbox = outbox
        self.holder = holder
        self.replaced = False
        """Whether another one of its uuid has taken its place."""
        self._topics = topics
        self._shadows = shadows
        self._marks = marks
        self._subscriptions: dict[str, _Subscription] = {}

    def __len__(self) -> int:
        return len(self._subscriptions)

    def add(self, path: str) -> None:
        """Subscribe to a topic; again, if it is already: nothing. PathError, ValueRangeError, EndpointError."""
        if path in self._subscriptions:
            return
        finish = partial(Encoded.under, path=path_field(path))
        if shadow := self._shadows.find(path):
            self._subscriptions[path] = _Subscription(None, None, self._join_shadow(path, shadow, finish))
            return
        topic = self._topics.mark(path) or self._topics.topic(path)
        lane: Lane = StateLane(self.outbox, finish)
        if isinstance(topic, Topic) and topic.direction == "in":
            lane = EventLane(self.outbox, shorten(path), finish)
        subscription = _Subscription(topic, lane)
        self._join(subscription)
        self._subscriptions[path] = subscription

    def move(self, sources: Collection[str]) -> None:
        """Go over to the feeds that these sources have by now; a topic that is gone waits until it is back."""
        for path, subscription in self._subscriptions.items():
            if isinstance(subscription.topic, Topic) and subscription.topic.source in sources:
                self._leave(subscription)
                try:
                    self._join(subscription)
                except ShmioError as error:
                    log.info("a subscribed topic is gone: %s", error, extra=fields(topic=shorten(path)))

    def close(self) -> None:
        """Leave all topics."""
        subscriptions, self._subscriptions = self._subscriptions, {}
        for subscription in subscriptions.values():
            self._leave(subscription)

    def _join_shadow(self, path: str, shadow: Shadow, finish: Finish) -> Callable[[], None]:
        """Listen to a topic of an injection, which a listener to originals holds; how to leave again."""
        injection, key = shadow.injection, object()
        to_message = encoder(injection.shape, injection.feed.block.layout)
        if shadow.way is Way.ORIGINALS:
            leave = injection.originals("v2", to_message, self.outbox, shorten(path), finish)
            self._shadows.hold(injection, key)
        else:
            leave = injection.gifts("v2", to_message, EventLane(self.outbox, shorten(path), finish))

        def over() -> None:
            log.info("a subscribed topic is gone: %s", injection.over, extra=fields(topic=shorten(path)))
            self._leave(self._subscriptions.pop(path))

        def leave_it() -> None:
            injection.ends.pop(key, None)
            leave()
            self._shadows.release(injection, key)

        injection.ends[key] = over
        return leave_it

    def _join(self, subscription: _Subscription) -> None:
        topic, lane = subscription.topic, subscription.lane
        if topic is None or lane is None:
            return
        if isinstance(topic, Mark):
            subscription.leave = self._marks.listen(topic, marked, lane)
            return
        feed = self._topics.feed(topic.source)
        layout = feed.block.layout
        subscription.leave = lane.join(feed, subject(shape(layout, topic), layout))

    def _leave(self, subscription: _Subscription) -> None:
        if subscription.leave is not None:
            leave, subscription.leave = subscription.leave, None
            leave()


class Subscribers:
    """Those whose stream is open, by their uuid."""

    def __init__(self, topics: Topics, shadows: Shadows, marks: Marks) -> None:
        self._topics = topics
        self._shadows = shadows
        self._marks = marks
        self._open: dict[str, Subscriber] = {}
        self._arrived = asyncio.Event()

    def enter(self, uuid: str, name: str, outbox: Outbox, holder: object) -> Subscriber:
        """A stream opens. One of its holder's that has the uuid ends: it may be what a broken connection has left.

        ValueRangeError: no uuid, or too long; ConflictError: another holder has it; EndpointError: too many.
        """
        if not uuid:
            raise ValueRangeError("uuid: it is needed, to say in Subscribe whose stream the topic is for")
        if max(len(uuid), len(name)) > MAX_NAME:
            raise ValueRangeError(f"name and uuid have at most {MAX_NAME} characters")
        before = self._open.get(uuid)
        if before is not None and before.holder != holder:
            raise ConflictError(f"uuid {shorten(uuid)!r} is another client's: take one that is drawn by chance")
        if before is not None:
            del self._open[uuid]
            before.replaced = True
            before.close()
            before.outbox.clear()
            before.outbox.end()
            log.info("subscriber %s came again; its stream before ends", shorten(name), extra=fields(uuid=uuid))
        elif len(self._open) >= MAX_SUBSCRIBERS:
            raise EndpointError(f"there are {MAX_SUBSCRIBERS} subscribers already; one stream serves many topics")
        subscriber = self._open[uuid] = Subscriber(self._topics, self._shadows, self._marks, name, outbox, holder)
        self._arrived.set()
        self._arrived = asyncio.Event()
        return subscriber

    def leave(self, uuid: str, subscriber: Subscriber) -> None:
        """Its stream has ended."""
        subscriber.close()
        if self._open.get(uuid) is subscriber:
            del self._open[uuid]

    async def subscribe(self, uuid: str, path: str, holder: object) -> None:
        """Add a topic to a subscriber's stream, which may still be about to open, and is its holder's alone.

        PathError: no such topic, or subscriber; ValueRangeError: too much for a message; EndpointError: too many.
        """
        with suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE_S):
                while uuid not in self._open:
                    await self._arrived.wait()
        subscriber = self._open.get(uuid)
        if subscriber is None or subscriber.holder != holder:
            raise PathError(
                f"subscriberUUID {shorten(uuid)!r}: no such subscriber; keep the stream of CreateSubscriber open"
            )
        if len(subscriber) >= MAX_TOPICS or sum(map(len, self._open.values())) >= MAX_ALL_TOPICS:
            raise EndpointError(
                f"{shorten(path)}: too many subscriptions: {MAX_TOPICS} a subscriber and {MAX_ALL_TOPICS} in all are "
                "the most"
            )
        subscriber.add(path)

    def move(self, sources: Collection[str]) -> None:
        """Have all go over to the feeds that these sources have by now."""
        for subscriber in self._open.values():
            subscriber.move(sources)
