"""An injection of a program."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from typing import Any, Self

from shmio.client import calls, injection
from shmio.client.aio.transport import Background, Channel, Condition, Duplex
from shmio.client.update import Update
from shmio.errors import CommandError, RemoteError, ShmioError
from shmio.model.outcome import Outcome


class Shadow(AsyncIterator[Update]):
    """A present injection; several tasks may give values, and one may iterate over the originals.

    ``table`` has the registers that it covers, with the latest originals.
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
        """Lay an injection; see :meth:`Client.inject`."""
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
        """Give values, and wait for their outcomes.

        Args:
            values: Values by path.
            arrays: Values by the columns of ``table``.
            raw: Values as raw bytes.

        Returns:
            An outcome for each value: the worst for all of them. It is ``rejected`` if a path or value is
            wrong, or the injection does not cover it.

        Raises:
            ValueRangeError: A value is of no type that has values.
            CommandError: The injection is over.
            RemoteError: Somebody has lifted the injection, or the instance has ended.
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
        """Give values as in :meth:`set`, without waiting for their outcomes.

        A wrong value ends the injection; the next call raises the error.
        """
        async with self._turn:
            self._check()
            _, data = self._held.request(values or {}, arrays, raw, answered=False)
        await self._stream.write(data)

    async def __anext__(self) -> Update:
        """Wait for the next original, if ``originals`` was given; ends with the injection."""
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
        """Lift the injection, unless ``keep`` was given."""
        await self._stream.finish()
        await self._reading.join(self._channel.timeout_s)
        self._stream.close()
        await self._reading.join()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
