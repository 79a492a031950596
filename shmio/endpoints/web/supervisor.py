"""Sends the pages' requests to the supervisor."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from typing import Any, Final

from shmio.control import Request
from shmio.local.supervisor import ask_supervisor
from shmio.segment import Segment

MAX_REQUESTS: Final = 4
"""Maximum number of requests at a time. The supervisor can take more, so that commands can still reach it."""


class Supervisor:
    """Sends requests to the instance's supervisor. Use it in the event loop's thread only."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._room = asyncio.Semaphore(MAX_REQUESTS)

    async def ask(self, request: Request, timeout_s: float) -> dict[str, Any]:
        """Send a request, and return the supervisor's answer.

        A daemon thread waits for the answer. It does not keep this process alive, which the request
        may be about to restart.

        Args:
            request: The request.
            timeout_s: Maximum time to wait for the answer, in s.

        Raises:
            ControlError: The supervisor refuses, does not answer, or seems to be dead.

        """
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[dict[str, Any]] = loop.create_future()

        def settle(answer: dict[str, Any] | None, error: BaseException | None) -> None:
            self._room.release()
            if answered.done():  # the page was closed
                return
            if error is not None:
                answered.set_exception(error)
            elif answer is not None:
                answered.set_result(answer)

        def run() -> None:
            answer, failure = None, None
            try:
                answer = ask_supervisor(self._segment, request, timeout_s)
            except Exception as error:  # noqa: BLE001  raised by ``ask``
                failure = error
            with suppress(RuntimeError):  # the event loop has ended
                loop.call_soon_threadsafe(settle, answer, failure)

        await self._room.acquire()  # released when the thread ends, even if the page is closed earlier
        threading.Thread(target=run, name="ask", daemon=True).start()
        return await answered
