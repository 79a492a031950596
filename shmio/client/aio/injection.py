"""An injection as a program holds it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from typing import Any, Self

from shmio.client import calls, injection
from shmio.client.aio.transport import Background, Channel, Condition, Duplex
from shmio.client.update import Update
from shmio.errors import CommandError, RemoteError, ShmioError
from shmio.model.outcome import Outcome


class Shadow(AsyncIterator[Update]):
    """An injection that stands. Several tasks may give values; one may iterate over the originals.

    ``table``: the registers that it stands over, and the originals by now.
    """

    def __init__(self, channel: Channel, stream: Duplex, held: injection.Held) -> None:
        self._channel = channel
        self._stream = stream
        self._held = held
        self.number = held.number
        """By which anybody may lift it."""
        self.table = held.table
        self._turn = Condition()
        self._answers: dict[int, Any] = {}  # by sequence number: None until it has come
        self._updates: list[Update] = []
        self._error: ShmioError | None = None
        self._over = False
        self._reading = Background(self._read, f"shadow-{self.number}")

    @classmethod
    async def lay(cls, channel: Channel, method: Any, first: bytes) -> Self:
        """Lay it; what :meth:`Client.inject` says."""
        stream = Duplex(channel, method, first)
        try:
            return cls(channel, stream, injection.Held(await stream.first()))
        except BaseException:
            stream.close()
            raise

    async def set(
        self,
        values: Mapping[str, object] | None = None,
        arrays: injection.Arrays | None = None,
        raw: injection.Raw = (),
    ) -> list[Outcome]:
        """Give values by path, by the columns of ``table``, or as raw bytes; wait for what became of them.

        PathError, ValueRangeError; CommandError: it was lifted; RemoteError.
        """
        values, raw = values or {}, list(raw)
        async with self._turn:
            self._check()
            sequence, data = self._held.request(values, arrays, raw, answered=True)
            self._answers[sequence] = None
        try:
            await self._stream.write(data)
            async with self._turn:
                if not await self._turn.wait_until(
                    lambda: self._answers[sequence] is not None or self._over, calls.WRITE_PATIENCE_S
                ):
                    raise RemoteError(f"{self._channel.target.address}: it did not answer in time")
                if self._answers[sequence] is None:
                    self._check()
                return injection.ends(values, self._answers[sequence], more=bool(arrays or raw))
        finally:
            del self._answers[sequence]

    async def send(
        self,
        values: Mapping[str, object] | None = None,
        arrays: injection.Arrays | None = None,
        raw: injection.Raw = (),
    ) -> None:
        """The same without waiting. A value that is wrong ends the injection, which the next call tells."""
        async with self._turn:
            self._check()
            _, data = self._held.request(values or {}, arrays, raw, answered=False)
        await self._stream.write(data)

    async def __anext__(self) -> Update:
        """The next original, waited for; ends when it is over. Asked for with ``originals``."""
        async with self._turn:
            if not self._updates:
                await self._turn.wait_until(lambda: self._held.waits or self._over)
                if not self._held.waits:
                    if self._error is not None:
                        raise self._error
                    raise StopAsyncIteration
                self._updates.extend(self._held.originals())
            return self._updates.pop(0)

    def _check(self) -> None:
        if self._error is not None:
            raise self._error
        if self._over:
            raise CommandError(f"the injection {self.number} is over")

    async def _read(self) -> None:
        error: ShmioError | None = None
        try:
            async for found in self._stream:
                async with self._turn:
                    self._held.keep(found)
                    self._answers |= {
                        answer.sequence: answer.outcome for answer in found.answers if answer.sequence in self._answers
                    }
                    self._turn.notify_all()
        except ShmioError as caught:
            error = caught
        finally:
            async with self._turn:
                self._error, self._over = error, True
                self._turn.notify_all()

    async def close(self) -> None:
        """Lift it, unless it is to be kept."""
        await self._stream.finish()
        await self._reading.join(self._channel.timeout_s)
        self._stream.close()
        await self._reading.join()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
