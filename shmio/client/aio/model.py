"""The model of a source, computed by a program."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from typing import Any, Self

from shmio.client import model
from shmio.client.aio.transport import Channel, Duplex, Step, outputs_of
from shmio.client.model import Member, Part, Rejoining, Work


class Simulation(Member, AsyncIterator[Work]):
    """A source that this program computes: iterate over the steps, and answer each.

    Close it, or use ``async with``. Only :meth:`close` may be called from other tasks.
    """

    def __init__(self, stream: Duplex, part: Part) -> None:
        super().__init__(part)
        self._stream = stream

    @classmethod
    async def join(cls, channel: Channel, method: Any, source: str, name: str) -> Self:
        """Join a source; see :meth:`Client.simulation`."""
        stream = Duplex(channel, method, model.join(source, name))
        try:
            return cls(stream, Part(await anext(stream, None)))
        except BaseException:
            stream.close()
            raise

    async def __anext__(self) -> Work:
        """Wait for the next step; the iteration ends when this object or its client is closed.

        Raises:
            LostError: The endpoint has ended, or a reload has changed the source.
            RemoteError: The connection failed otherwise.
        """
        self._work = self._part.take(await anext(self._stream))
        return self._work

    async def done(self, outputs: Mapping[str, object]) -> None:
        """Answer the present step with outputs by path; outputs that are left out keep their values.

        Raises:
            PathError: There is no such output; nothing was sent.
            ValueRangeError: A value does not fit; nothing was sent.
        """
        await self._answer(self._part.done(self._present(), outputs))

    async def fail(self, reason: str) -> None:
        """Answer that the present step has failed; the outputs stay as they are."""
        await self._answer(self._part.failed(self._present(), reason))

    async def compute(self, work: Work, step: Step, rejoining: Rejoining) -> None:
        """Call a program's function for a step, and answer with its outputs or its error."""
        rejoining.heed(self._part, work)
        try:
            outputs = await outputs_of(step(work.time_s, work.dt_s, work.inputs))
            answer = rejoining.answer(self._part, work, outputs)
        except Exception as error:  # noqa: BLE001  whatever it is, the step has failed with it
            answer = rejoining.failed(self._part, work, error)
        await self._answer(answer)

    async def _answer(self, data: bytes) -> None:
        self._work = None
        await self._stream.write(data)

    def close(self) -> None:
        """Leave the source; steps fail until another model joins."""
        self._stream.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
