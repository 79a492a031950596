"""The outboxes of all streams, with their common bound and counters."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

from shmio.endpoints.grpc.streams.back_pressure import TotalBacklog
from shmio.endpoints.grpc.streams.outbox import Outbox
from shmio.endpoints.grpc.time.open_streams import OpenStreams


class Outboxes:
    """The outboxes of all open streams."""

    def __init__(self, open_streams: OpenStreams | None = None) -> None:
        """``open_streams`` counts these streams together with those of other services."""
        self._open_streams = OpenStreams() if open_streams is None else open_streams
        self._open: set[Outbox] = set()
        self._dropped = 0
        self._total = TotalBacklog()

    @property
    def waiting_bytes(self) -> int:
        """Size of all waiting messages, in bytes."""
        return self._total.size

    def __len__(self) -> int:
        return len(self._open)

    @property
    def dropped(self) -> int:
        """Number of messages dropped since the start because a client was too slow."""
        return self._dropped + sum(outbox.dropped for outbox in self._open)

    @contextmanager
    def opened(self) -> Iterator[Outbox]:
        """Give a stream an outbox for as long as the stream is open."""
        outbox = Outbox(self._total)
        self._open.add(outbox)
        self._total.streams += 1
        try:
            with self._open_streams.joined():
                yield outbox
        finally:
            self._open.discard(outbox)
            self._total.streams -= 1
            self._dropped += outbox.dropped
            outbox.close()

    async def taken(self, patience_s: float) -> None:
        """Wait until all clients have taken what they are owed.

        Streams whose clients have not done so within ``patience_s`` fail.
        """
        owing = [outbox for outbox in self._open if outbox.owing]
        if not owing:
            return
        try:
            async with asyncio.timeout(patience_s):
                for outbox in owing:
                    await outbox.taken()
        except TimeoutError:
            for outbox in owing:
                if outbox.owing:
                    outbox.fail(f"the client has not taken the values of a step within {patience_s:g} s")
