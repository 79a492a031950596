"""Sends the messages of the backlog: new ones at once, and those that an outage delayed when it is over."""

from __future__ import annotations

import asyncio
import heapq
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from shmio.endpoints.fabric.backlog import Backlog, Kept, Row
from shmio.endpoints.fabric.history import History
from shmio.fabric.connection import INSTALL, wants_reply
from shmio.fabric.messages import MissingRequest, with_age
from shmio.libraries import library

if TYPE_CHECKING:
    from nats.aio.msg import Msg

    from shmio.fabric.client import FabricClient

WINDOW_BYTES: Final = 2 << 20
"""Maximum number of bytes that are sent and not yet confirmed by the server. Messages beyond wait in the backlog."""
LATE_BYTES: Final = WINDOW_BYTES // 2
"""Part of the window that late messages may use, so that new messages always have room."""
CONFIRM_S: Final = 0.1
"""Pause between two questions to the server whether it has the messages, in s."""
LIVE_NS: Final = 1_000_000_000
"""If the next message is older than this, in ns, newer messages pass it, and it follows as late."""
CONFIRM_TIMEOUT_S: Final = 5.0
TURN_BYTES: Final = 128 << 10
"""What is sent of an answer before another one has its turn, in bytes."""

log = logging.getLogger("shmio.fabric")


class _Sent(NamedTuple):
    """A message that was sent and is not confirmed."""

    place: int
    kept: Kept
    size: int


class _Turns:
    """Gives turns to answers: the next one is of the answer that has had the fewest, and of these the first to ask."""

    def __init__(self) -> None:
        self._taken = False
        self._asked = 0
        self._waiting: list[tuple[int, int, asyncio.Event]] = []

    @asynccontextmanager
    async def turn(self, had: int) -> AsyncIterator[None]:
        """Wait for a turn; ``had`` is the number of turns that the answer has had."""
        self._asked += 1
        place = had, self._asked, asyncio.Event()
        heapq.heappush(self._waiting, place)
        if not self._taken:
            self._next()
        try:
            await place[2].wait()
            yield
        finally:
            if place in self._waiting:  # cancelled before its turn
                self._waiting.remove(place)
                heapq.heapify(self._waiting)
            else:
                self._next()

    def _next(self) -> None:
        self._taken = bool(self._waiting)
        if self._taken:
            heapq.heappop(self._waiting)[2].set()


class Publisher:
    """Sends the messages of a backlog. Use it only in the event loop's thread."""

    def __init__(self, backlog: Backlog, history: History | None = None) -> None:
        """Create the publisher. With a history, a message is confirmed when the servers have stored it."""
        self._history = history
        if history is not None:
            history.wake = self.wake
        self.sent = 0
        """Number of messages that were sent."""
        self.sent_bytes = 0
        self.late = 0
        """Number of messages that were sent as late."""
        self._backlog = backlog
        self.begun = asyncio.Event()
        """Set while messages are being sent."""
        self._client: FabricClient | None = None
        self._due = asyncio.Event()
        self._asked = asyncio.Event()
        self._hurry = asyncio.Event()
        self._place = 0
        self._unconfirmed: deque[_Sent] = deque()
        self._unconfirmed_bytes = 0
        self._tasks: list[asyncio.Task[None]] = []
        self._turns = _Turns()
        self._errors = library("nats.errors", INSTALL)

    @property
    def up(self) -> bool:
        """True if messages are being sent."""
        return self._client is not None

    def begin(self, client: FabricClient) -> None:
        """Send messages on a new or restored connection, beginning with those that the server may not have."""
        self.end()
        for row in self._backlog.rows.values():
            row.begin_again()
        self._client = client
        self.begun.set()
        loop = asyncio.get_running_loop()
        self._tasks = [loop.create_task(self._send_all(client)), loop.create_task(self._confirm_all(client))]
        self._due.set()

    def end(self) -> None:
        """Stop sending, because the connection was lost."""
        self._client = None
        self.begun.clear()
        for task in self._tasks:
            task.cancel()
        self._tasks = []
        self._unconfirmed.clear()
        self._unconfirmed_bytes = 0
        self._asked.clear()

    def wake(self) -> None:
        """Send the new messages of the backlog."""
        self._due.set()

    async def finish(self, timeout_s: float) -> None:
        """Wait until the server has all messages, at most for a time in s."""
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while self.up and (self._backlog.waiting or self._unconfirmed or self._stores):
                    self._hurry.set()
                    await asyncio.sleep(0.01)

    @property
    def _stores(self) -> bool:
        """True if servers are storing messages."""
        return self._history is not None and self._history.waiting and not self._history.problem

    # ---- sending -----------------------------------------------------------------------------------------------------

    async def _send_all(self, client: FabricClient) -> None:
        with suppress(self._errors.Error):  # the connection is lost: begin() sends these messages again
            while True:
                await self._due.wait()
                self._due.clear()
                await self._send_new(client)
                await self._send_late(client)

    async def _send_new(self, client: FabricClient) -> None:
        now_ns = time.monotonic_ns()
        for row in tuple(self._backlog.rows.values()):
            following = row.find(row.next)
            if row.next <= row.last and (following is None or now_ns - following.made_ns > LIVE_NS):
                row.skip()
            while row.next <= row.last and self._unconfirmed_bytes < WINDOW_BYTES:
                kept = row.find(row.next)
                row.next += 1
                if kept is not None:
                    await self._send(client, row.live, row, kept)

    async def _send_late(self, client: FabricClient) -> None:
        """Send late messages, the oldest of all rows first, as long as they leave room for new ones."""
        while self._unconfirmed_bytes < LATE_BYTES:
            oldest: tuple[Row, Kept] | None = None
            for row in self._backlog.rows.values():
                while row.late and row.find(row.late[0]) is None:  # the backlog has dropped it
                    row.late.popleft()
                kept = row.find(row.late[0]) if row.late else None
                if kept is not None and (oldest is None or kept.made_ns < oldest[1].made_ns):
                    oldest = row, kept
            if oldest is None:
                return
            row, kept = oldest
            row.late.popleft()
            self.late += 1
            await self._send(client, row.late_subject, row, kept)

    async def _send(self, client: FabricClient, subject: str, row: Row, kept: Kept) -> None:
        data = aged(kept)
        try:
            if self._history is None:
                await client.publish(subject, data)
            else:
                await self._history.publish(client, subject, data, row, kept.number)
        except self._errors.MaxPayloadError:
            log.warning(
                "source %s: the server refuses a message of %d bytes; raise its max_payload to 1 MB, or publish fewer "
                "registers",
                row.source,
                len(data),
            )
            kept.sent = kept.confirmed = True
            self._backlog.dropped += 1
            return
        kept.sent = True
        self.sent += 1
        self.sent_bytes += len(data)
        self._place += 1
        self._unconfirmed.append(_Sent(self._place, kept, kept.size))
        self._unconfirmed_bytes += kept.size
        self._asked.set()
        if self._unconfirmed_bytes >= LATE_BYTES // 2:
            self._hurry.set()

    # ---- confirmation ------------------------------------------------------------------------------------------------

    async def _confirm_all(self, client: FabricClient) -> None:
        """Ask the server again and again whether it has what was sent. It answers in the order of sending."""
        with suppress(self._errors.Error):
            while True:
                await self._asked.wait()
                if not self._hurry.is_set():
                    with suppress(TimeoutError):
                        async with asyncio.timeout(CONFIRM_S):
                            await self._hurry.wait()
                self._hurry.clear()
                self._asked.clear()
                place = self._place
                await client.confirm()
                self._confirm(place)

    def _confirm(self, place: int) -> None:
        while self._unconfirmed and self._unconfirmed[0].place <= place:
            _, kept, size = self._unconfirmed.popleft()
            if self._history is None:
                kept.confirmed = True
            self._unconfirmed_bytes -= size
        if self._backlog.waiting:
            self._due.set()

    # ---- requests for missing messages -------------------------------------------------------------------------------

    async def answer(self, row: Row | None, message: Msg) -> None:
        """Answer a request for missing messages, and end the answer with an empty message.

        Answers take turns, so that a reader who asks for much delays others by little.
        """
        if not wants_reply(message) or self._client is None:
            return
        client = self._client
        try:
            wanted = msgspec.json.decode(message.data, type=MissingRequest)
        except msgspec.MsgspecError:
            wanted = MissingRequest(0, 0, 0)
        known = row is not None and row.stream == wanted.stream
        numbers = iter(row.between(wanted.first, wanted.last) if row is not None and known else ())
        with suppress(self._errors.Error, TimeoutError):
            turns = 0
            more = row is not None
            while more and row is not None:
                async with self._turns.turn(turns):
                    more = await self._send_some(client, message.reply, row, numbers)
                turns += 1
            await client.publish(message.reply, b"")

    async def _send_some(self, client: FabricClient, reply: str, row: Row, numbers: Iterator[int]) -> bool:
        """Send the next messages of an answer, and return whether there are more."""
        size = 0
        for number in numbers:
            if (kept := row.find(number)) is None:
                continue
            await client.publish(reply, aged(kept))
            size += kept.size
            if size >= TURN_BYTES:
                async with asyncio.timeout(CONFIRM_TIMEOUT_S):
                    await client.confirm()
                return True
        return False


def aged(kept: Kept) -> bytes:
    """Return a message with its present age; a message that was just made has the age 0."""
    age_ns = time.monotonic_ns() - kept.made_ns
    return with_age(kept.data, age_ns if age_ns > FRESH_NS else 0)


FRESH_NS: Final = 20_000_000
"""Age in ns below which a message counts as just made."""
