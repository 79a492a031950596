"""All services of the endpoint, over the same feeds."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import grpc

from shmio.endpoints.grpc.commands.publish import Publisher
from shmio.endpoints.grpc.commands.topics import Topics
from shmio.endpoints.grpc.injection.injections import Shadows
from shmio.endpoints.grpc.services.simlog_v1 import SimlogV1
from shmio.endpoints.grpc.services.simlog_v2 import SimlogV2
from shmio.endpoints.grpc.services.simserver import SimServer
from shmio.endpoints.grpc.shmio_v1.service import ShmioV1
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outboxes import Outboxes
from shmio.endpoints.grpc.streams.wakeups import WakeUps
from shmio.endpoints.grpc.time.open_streams import OpenStreams
from shmio.endpoints.grpc.time.stepper import Stepper
from shmio.endpoints.grpc.time.virtual_time import VirtualTime
from shmio.segment import ProcessSlot, Segment


class Services:
    """What a server offers on each of its addresses."""

    def __init__(
        self,
        segment: Segment,
        slot: ProcessSlot,
        virtual_time: VirtualTime,
        wake_ups: WakeUps,
        feeds: Mapping[str, Feed],
        default_source: str | None,
    ) -> None:
        """``slot``: this process's in the table. ``hold``, ``bells``: those of the feeds.

        ``default_source``: that of paths which name none; default: the only one.
        """
        topics = Topics(feeds, default_source)
        open_streams = OpenStreams()
        self._outboxes = Outboxes(open_streams)
        self._shadows = Shadows(topics)
        self._publisher = Publisher(topics, self._shadows)
        self.stepper = Stepper(
            segment, slot, virtual_time, wake_ups, feeds, self._outboxes, self._publisher, open_streams
        )
        """The instance's time."""
        self._shmio_v1 = ShmioV1(topics, feeds, wake_ups, segment, self.stepper, open_streams)
        self._services = (
            self._shmio_v1,
            SimlogV1(topics, self._publisher, self._outboxes, self._shadows, self.stepper),
            SimlogV2(topics, self._publisher, self._outboxes, self._shadows, self.stepper.timeline.time_topics),
            SimServer(self.stepper, self._outboxes),
        )

    @property
    def calls(self) -> dict[str, dict[str, grpc.RpcMethodHandler[Any, Any]]]:
        """The calls of each service, by its full name, for a server."""
        return {service.name: service.handlers() for service in self._services}

    @property
    def counters(self) -> tuple[int, int, int, int]:
        """Streams of subscribers open, messages dropped on slow ones, messages published, and refused."""
        streams = len(self._outboxes) + self._shmio_v1.streams
        return streams, self._outboxes.dropped, self._publisher.published, self._publisher.refused

    @property
    def updates(self) -> int:
        """Updates of our own service since the start; what feeds have made is counted there."""
        return self._shmio_v1.updates

    @property
    def waiting_bytes(self) -> int:
        """Of all messages that wait to be read by clients."""
        return self._outboxes.waiting_bytes

    def move(self, sources: Collection[str]) -> None:
        """Have the streams of these sources go over to the feeds that there are by now."""
        self._shadows.move(sources)
        for service in self._services:
            if not isinstance(service, SimServer):
                service.move(sources)
