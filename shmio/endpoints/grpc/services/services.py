"""Creates all services of the endpoint."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

import grpc

from shmio.endpoints.grpc.services.injection import Shadows
from shmio.endpoints.grpc.services.publish import Publisher
from shmio.endpoints.grpc.services.simlog_v1 import SimlogV1
from shmio.endpoints.grpc.services.simlog_v2 import SimlogV2
from shmio.endpoints.grpc.services.simserver import SimServer
from shmio.endpoints.grpc.shmio_v1.service import ShmioV1
from shmio.endpoints.grpc.streams.feed import Feed, VirtualTime
from shmio.endpoints.grpc.streams.outbox import OpenStreams, Outboxes
from shmio.endpoints.grpc.time.stepper import Stepper
from shmio.endpoints.grpc.topics import Topics
from shmio.endpoints.grpc.wakeups import WakeUps
from shmio.segment import Block, ProcessSlot, Segment


class Services:
    """The services that a server offers at each of its addresses."""

    def __init__(
        self,
        segment: Segment,
        slot: ProcessSlot,
        virtual_time: VirtualTime,
        wake_ups: WakeUps,
        feeds: Mapping[str, Feed],
        default_source: str | None,
    ) -> None:
        """Create the services.

        Args:
            segment: The instance's shared memory.
            slot: This process's entry in the process table.
            virtual_time: The virtual time that the feeds use.
            wake_ups: The wake-ups that the feeds use.
            feeds: The feeds of all sources.
            default_source: The source of paths that name no source; if None, the only source, if
                there is just one.

        """
        topics = Topics(feeds, default_source)
        open_streams = OpenStreams()
        self._outboxes = Outboxes(open_streams)
        self._shadows = Shadows(topics)
        self._publisher = Publisher(topics, self._shadows)
        self.stepper = Stepper(
            segment, slot, virtual_time, wake_ups, feeds, self._outboxes, self._publisher.settle, open_streams
        )
        """Controls the instance's time for all services."""
        self._shmio_v1 = ShmioV1(topics, feeds, wake_ups, segment, self.stepper, open_streams)
        self._services = (
            self._shmio_v1,
            SimlogV1(topics, self._publisher, self._outboxes, self._shadows, self.stepper),
            SimlogV2(topics, self._publisher, self._outboxes, self._shadows, self.stepper.timeline.time_topics),
            SimServer(self.stepper, self._outboxes),
        )

    @property
    def calls(self) -> dict[str, dict[str, grpc.RpcMethodHandler[Any, Any]]]:
        """The handlers of each service, by the service's full name."""
        return {service.name: service.handlers() for service in self._services}

    @property
    def counters(self) -> tuple[int, int, int, int]:
        """Numbers of open streams, dropped messages, published values, and refused values.

        The endpoint drops messages for clients that are too slow.
        """
        streams = len(self._outboxes) + self._shmio_v1.subscribe_calls.streams
        return streams, self._outboxes.dropped, self._publisher.published, self._publisher.refused

    @property
    def updates(self) -> int:
        """Number of updates that ``shmio.v1`` has sent since the start.

        The feeds count the messages of the other services.
        """
        return self._shmio_v1.subscribe_calls.updates

    @property
    def readers(self) -> Iterator[tuple[Block, int]]:
        """The blocks that clients of ``shmio.v1`` read frame by frame, each with the number of the last frame sent."""
        return self._shmio_v1.subscribe_calls.readers

    @property
    def waiting_bytes(self) -> int:
        """Size of all messages that wait for clients, in bytes."""
        return self._outboxes.waiting_bytes

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """Switch the streams of these sources to their new feeds, after a reload."""
        self._shadows.on_sources_replaced(sources)
        for service in self._services:
            if not isinstance(service, SimServer):
                service.on_sources_replaced(sources)
