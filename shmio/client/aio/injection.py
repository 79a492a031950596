"""A program's injections: shadows, whose values the program gives, and declared injections."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from contextlib import suppress
from typing import Any, Protocol, Self

from shmio.client import calls, injection
from shmio.client.aio.transport import Background, Channel, Condition, Duplex, Stream
from shmio.client.update import Update
from shmio.errors import CommandError, PathError, RemoteError, ShmioError
from shmio.model.injection import InjectionEvent
from shmio.model.values import Outcome


class Shadow(AsyncIterator[Update]):
    """An injection to which this program gives values.

    Iterate over it to receive the originals: the values that the injection covers. Several tasks
    may give values, but only one may iterate. ``table`` has the covered registers with their latest
    originals.
    """

    def __init__(self, channel: Channel, stream: Duplex, state: injection.ShadowState) -> None:
        self._channel = channel
        self._stream = stream
        self._state = state
        self.number = state.number
        """Number of the injection. Any program may lift the injection by its number."""
        self.table = state.table
        self._changed = Condition()
        self._answers: dict[int, Any] = {}  # by sequence number; None until the answer comes
        self._updates: list[Update] = []
        self._error: ShmioError | None = None
        self._over = False
        self._reading = Background(self._read, f"shadow-{self.number}")

    @classmethod
    async def create(cls, channel: Channel, method: Any, first: bytes) -> Self:
        """Create an injection; see :meth:`Client.inject`."""
        stream = Duplex(channel, method, first)
        try:
            return cls(channel, stream, injection.ShadowState(await stream.first()))
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
            values: Values by path; None for none.
            arrays: Values by the columns of ``table``; None for none.
            raw: Values as raw bytes: see :data:`shmio.client.injection.Raw`.

        Returns:
            An outcome for each path in ``values``, and one with an empty path for all arrays and
            raw bytes together. All have the same kind: the worst outcome of any value. It is
            ``rejected`` if a path or value is wrong, or if the injection does not cover a path.

        Raises:
            ValueRangeError: A value has an unsupported Python type.
            CommandError: The injection has ended.
            RemoteError: Somebody has lifted the injection, or the instance has ended.
        """
        values, raw = values or {}, list(raw)
        async with self._changed:
            self._check()
            sequence, data = self._state.request(values, arrays, raw, answered=True)
            self._answers[sequence] = None
        try:
            await self._stream.write(data)
            async with self._changed:
                if not await self._changed.wait_until(
                    lambda: self._answers[sequence] is not None or self._over, calls.WRITE_PATIENCE_S
                ):
                    raise RemoteError(f"{self._channel.target.address}: the endpoint did not answer in time")
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

        A wrong value ends the injection; the error is raised by the next call.
        """
        async with self._changed:
            self._check()
            _, data = self._state.request(values or {}, arrays, raw, answered=False)
        await self._stream.write(data)

    async def __anext__(self) -> Update:
        """Wait for the next originals. They come only if ``originals`` was set at the creation."""
        async with self._changed:
            if not self._updates:
                await self._changed.wait_until(lambda: self._state.waits or self._over)
                if not self._state.waits:
                    if self._error is not None:
                        raise self._error
                    raise StopAsyncIteration
                self._updates.extend(self._state.originals())
            return self._updates.pop(0)

    def _check(self) -> None:
        if self._error is not None:
            raise self._error
        if self._over:
            raise CommandError(f"injection {self.number} has ended")

    async def _read(self) -> None:
        error: ShmioError | None = None
        try:
            async for found in self._stream:
                async with self._changed:
                    self._state.keep(found)
                    self._answers |= {
                        answer.sequence: answer.outcome for answer in found.answers if answer.sequence in self._answers
                    }
                    self._changed.notify_all()
        except ShmioError as caught:
            error = caught
        finally:
            async with self._changed:
                self._error, self._over = error, True
                self._changed.notify_all()

    async def close(self) -> None:
        """Lift the injection, unless it was created with ``keep``."""
        await self._stream.finish()
        await self._reading.join(self._channel.timeout_s)
        self._stream.close()
        await self._reading.join()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


class Lift(Protocol):
    """Function that lifts an injection of a source by its number."""

    async def __call__(self, source: str, number: int) -> None:
        """Lift an injection. Raise PathError or CommandError if that fails."""


class Campaign(AsyncIterator[InjectionEvent]):
    """Declared injections that this program has created in one call.

    Iterate over the campaign, in one task, to get the events of the injections. The iteration ends
    when all injections have ended. ``declared`` has the injections with their seeds, in the order
    of the declarations.
    """

    def __init__(self, stream: Stream, first: Any, lift: Lift, *, keep: bool) -> None:
        self._stream = stream
        self._lift = lift
        self._keep = keep
        self.declared = injection.declared(first)
        self._left = dict.fromkeys((one.source, one.number) for one in self.declared)
        self._events: list[InjectionEvent] = injection.events(first)

    @classmethod
    async def create(cls, stream: Stream, lift: Lift, *, keep: bool) -> Self:
        """Wait for the first answer to a call of Declare, and return the campaign that it has created.

        Args:
            stream: The call.
            lift: Lifts an injection.
            keep: Whether the injections stay when this program ends.
        """
        try:
            return cls(stream, await stream.first(), lift, keep=keep)
        except BaseException:
            stream.close()
            raise

    async def __anext__(self) -> InjectionEvent:
        """Wait for the next event.

        Raises:
            RemoteError: The events were not read fast enough, or the instance has ended.
        """
        while not self._events:
            self._events = injection.events(await anext(self._stream))
        event = self._events.pop(0)
        if event.what == "lifted":
            self._left.pop((event.source, event.number), None)
        return event

    async def close(self) -> None:
        """Lift the remaining injections, unless they were created with ``keep``."""
        left, self._left = self._left, {}
        try:
            for source, number in () if self._keep else left:
                with suppress(PathError, CommandError):  # it has ended, or a reload has removed its source
                    await self._lift(source, number)
        finally:
            self._stream.close()  # this lifts any that remain

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
