"""The endpoint: follows all sources, serves their nodes, and adds and removes sources after a reload."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Container, Iterator
from functools import partial

from shmio.config import OpcUa
from shmio.endpoints.opcua.feed import Feed
from shmio.endpoints.opcua.methods import Stepping, add_injections, add_step
from shmio.endpoints.opcua.nodes import SourceNode
from shmio.endpoints.opcua.server import Server, bound_decoding
from shmio.segment import Block, ProcessSlot, Segment
from shmio.segment.doorbell import Relay

log = logging.getLogger("shmio.opcua")


class Endpoint:
    """Serves an instance. Use it only in the event loop's thread."""

    def __init__(self, segment: Segment, slot: ProcessSlot, config: OpcUa) -> None:
        """Read certificates and accounts. :meth:`start` starts the server.

        Raises:
            ConfigError: A file is not usable.

        """
        bound_decoding()
        self.server = Server(segment.instance, config)
        self._segment, self._writer = segment, slot.writer or 0
        self._generation = -1
        self._relays: dict[SourceNode, Relay] = {}
        self._stopped: list[Relay] = []
        self._reading: asyncio.Task[list[SourceNode]] | None = None

    async def start(self) -> None:
        """Create the nodes, and start to listen.

        Raises:
            EndpointError: The address cannot be used.
        """
        await self.server.init()
        self.server.iserver.catch_up = self.poll
        self._stepping = Stepping(self._segment)
        add_step(self.server.iserver.space.root, self._stepping)
        self._add(await asyncio.to_thread(self._read, ()))
        await self.server.start()

    @property
    def sources(self) -> dict[str, SourceNode]:
        """The objects of the sources, by source name."""
        return self.server.iserver.space.sources

    @property
    def counters(self) -> tuple[int, ...]:
        """The counters, in the order in which the process table names them."""
        shared = self.server.iserver
        counted = shared.counters
        return (
            shared.sessions, shared.subscriptions.items, counted.writes, counted.refused, counted.sent_bytes,
            counted.sent_messages,
        )  # fmt: skip

    @property
    def readers(self) -> Iterator[tuple[Block, int]]:
        """The blocks that the endpoint reads, each with the number of the last frame that it has read."""
        return ((source.feed.block, source.feed.follower.last) for source in self.sources.values())

    def poll(self) -> None:
        """Read all new frames of all sources."""
        for source in tuple(self.sources.values()):
            while source.feed.poll():
                pass

    # ---- sources that come and go ------------------------------------------------------------------------------------

    def follow_reloads(self) -> None:
        """Add and remove sources after a reload. Large layouts are read in a thread, because that takes seconds."""
        if self._reading is not None and self._reading.done():
            reading, self._reading = self._reading, None
            self._add(reading.result())
        if self._stepping.lock.locked():
            return  # a step uses the sources, too
        if self._reading is None and self._segment.generation != self._generation:
            known = {source.feed.block.section for source in self.sources.values()}
            self._reading = asyncio.get_running_loop().create_task(asyncio.to_thread(self._read, known))
        if self._reading is not None:
            return
        for source in [one for one in self.sources.values() if one.name not in self._segment.blocks]:
            if source.feed.follower.ended:  # all its frames were read
                self._stop(source)
                self.server.iserver.space.remove(source.name)
                log.info("a reload removed the source %s", source.name)

    def _read(self, known: Container[int]) -> list[SourceNode]:
        self._generation = self._segment.generation  # first, so that the next check notices a change meanwhile
        self._segment.refresh()
        root, namespace = self.server.iserver.space.root, self.server.namespace
        blocks = [block for block in self._segment.blocks.values() if block.section not in known]
        sources = [SourceNode(root, Feed(block, self._writer, namespace)) for block in blocks]
        for source in sources:
            add_injections(source)
        return sources

    def _add(self, sources: list[SourceNode]) -> None:
        loop = asyncio.get_running_loop()
        for source in sources:
            if (before := self.sources.get(source.name)) is not None:
                before.feed.commands.poll()
                self._stop(before)
            source.feed.poll()
            self.server.iserver.space.add(source)
            relay = Relay(source.feed.block.ring, f"bell-{source.name}", source.feed.turn_ns)
            self._relays[source] = relay
            loop.add_reader(relay.descriptor, partial(self._wake, source, relay))

    def _wake(self, source: SourceNode, relay: Relay) -> None:
        relay.acknowledge()
        self._poll(source)

    def _poll(self, source: SourceNode) -> None:
        if source in self._relays and source.feed.poll():
            asyncio.get_running_loop().call_soon(self._poll, source)

    def _stop(self, source: SourceNode) -> None:
        relay = self._relays.pop(source)
        asyncio.get_running_loop().remove_reader(relay.descriptor)
        relay.stop()
        self._stopped = [one for one in self._stopped if one.alive] + [relay]

    async def stop(self) -> None:
        """Disconnect the clients, and stop following the sources."""
        if self._reading is not None:
            await asyncio.wait((self._reading,))
        await self.server.stop()
        for source in tuple(self._relays):
            self._stop(source)
        for relay in self._stopped:
            relay.join()
