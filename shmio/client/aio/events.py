"""Iterators over the events of sources."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from typing import Self

from shmio.client.aio.transport import Stream
from shmio.messages import event_from_wire
from shmio.model.event import Event


class Events(AsyncIterator[Event]):
    """Iterator over events, for one task. It ends when the iterator or its client is closed.

    Any task may call :meth:`close`.
    """

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._waiting: Iterator[Event] = iter(())

    @classmethod
    async def begin(cls, stream: Stream) -> Self:
        """Return an iterator over the stream's events, as soon as the endpoint follows the sources."""
        try:
            await stream.first()
        except BaseException:
            stream.close()
            raise
        return cls(stream)

    async def __anext__(self) -> Event:
        """Wait for the next event.

        Raises:
            RemoteError: The instance has ended.
            EndpointError: The endpoint can no longer follow a source.
        """
        while True:
            for event in self._waiting:
                return event
            self._waiting = map(event_from_wire, (await anext(self._stream)).events)

    def close(self) -> None:
        """End the iteration."""
        self._stream.close()
        self._waiting = iter(())

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
