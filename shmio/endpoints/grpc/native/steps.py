"""Steps: a stream on which a client has time stepped, without a call for each."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Final

from shmio.endpoints.grpc.encoding import field
from shmio.endpoints.grpc.stepper import Stepper
from shmio.wire import shmio_v1_pb2 as wire

MAX_ANSWERS: Final = 1024
"""Of so many that wait to be read the next step waits, too."""

STEPS: Final = wire.StepsResponse.DESCRIPTOR.fields_by_name["steps"].number


class Steps:
    """One call of Steps."""

    def __init__(self, stepper: Stepper, peer: str) -> None:
        """``peer``: whose it is."""
        self._stepper = stepper
        self._peer = peer
        self._answers: list[bytes] = []
        self._news = asyncio.Event()  # there is an answer, or there will be no more
        self._room = asyncio.Event()

    async def messages(self, requests: AsyncIterator[wire.StepsRequest]) -> AsyncIterator[bytes]:
        """Serialised StepsResponses: what is done while one is sent shares the next. Time goes on meanwhile.

        TimeError: a step has failed, after the answers to those before it; ValueRangeError.
        """
        working = asyncio.get_running_loop().create_task(self._work(requests))
        working.add_done_callback(lambda _: self._news.set())
        try:
            while self._answers or not working.done():
                if not self._answers:
                    self._news.clear()
                    await self._news.wait()
                    continue
                answers, self._answers = self._answers, []
                self._room.set()
                yield b"".join(answers)
            working.result()
        finally:
            working.cancel()

    async def _work(self, requests: AsyncIterator[wire.StepsRequest]) -> None:
        async for request in requests:
            for _ in range(request.count or 1):
                while len(self._answers) >= MAX_ANSWERS:
                    self._room.clear()
                    await self._room.wait()
                step = await self._stepper.step(request.dt_ns or None, self._peer)
                answer = wire.Step(number=step.number, time_ns=step.time_ns)
                self._answers.append(field(STEPS, answer.SerializeToString()))
                self._news.set()
