"""The history: the stream in which the servers keep the messages, and their acknowledgements."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from shmio.config.model import FabricHistory
from shmio.endpoints.fabric.backlog import Row
from shmio.fabric.connection import INSTALL
from shmio.fabric.history_stream import create_history
from shmio.fabric.names import CellName
from shmio.fabric.registry import ELECTION, is_away, was_refused
from shmio.libraries import library

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg

ACK_NS: Final = 5_000_000_000
"""Time in ns after which a message without an acknowledgement counts as not stored."""
_ID: Final = "Nats-Msg-Id"

log = logging.getLogger("shmio.fabric")


class _Answer(msgspec.Struct):
    """The answer of a server to a message for a stream."""

    error: dict[str, Any] | None = None


class _Awaited(NamedTuple):
    """A message whose acknowledgement has not come yet."""

    row: Row
    number: int
    sent_ns: int


class History:
    """Stores messages in a stream. Use it only in the event loop's thread.

    A message that the servers do not acknowledge is sent again, as late, when they store messages
    again.
    """

    def __init__(self, cell: CellName, settings: FabricHistory) -> None:
        self.problem = ""
        """Why the servers store no messages; empty if they do."""
        self.wake: Callable[[], object] = lambda: None
        """Called when messages are to be sent again."""
        self._cell, self._settings = cell, settings
        self._created = False
        self._client: Client | None = None
        self._inbox = ""
        self._place = 0
        self._awaited: dict[int, _Awaited] = {}
        self._unstored: dict[tuple[int, int], Row] = {}
        """Rows of the messages that were not stored, by the row's stream and the number, in the order of sending."""

    async def begin(self, client: Client) -> None:
        """Create the stream, and listen to acknowledgements, on a new or restored connection."""
        self._awaited.clear()
        self._unstored.clear()
        if client is not self._client:  # a restored connection keeps its subscriptions
            self._inbox = client.new_inbox()
            await client.subscribe(f"{self._inbox}.*", cb=self._on_answer)
            self._client = client
        self._created = await self._create(client)

    async def _create(self, client: Client) -> bool:
        """Create the stream. Return False if the servers do not: :attr:`problem` says why."""
        errors, name = library("nats.js.errors", INSTALL), self._cell.history
        try:
            await create_history(client, self._cell, self._settings)
        except library("nats.errors", INSTALL).TimeoutError:
            if was_refused(client):
                self._complain(
                    f"fabric.history: the servers do not let this cell create or change the stream {name}; run "
                    f"shmio fabric prepare --history {self._cell} as their administrator, with the same limits"
                )
            else:
                self._complain(f"fabric.history: the servers do not answer about the stream {name}; {ELECTION}")
            return False
        except errors.Error as error:
            why = getattr(error, "description", None) or str(error) or type(error).__name__
            why = f"{why}; {ELECTION}" if is_away(error) else why
            self._complain(f"fabric.history: the servers do not create the stream {name}: {why}")
            return False
        self.problem = ""
        return True

    async def publish(self, client: Client, subject: str, data: bytes, row: Row, number: int) -> None:
        """Publish a message, and expect an acknowledgement."""
        self._place += 1
        self._awaited[self._place] = _Awaited(row, number, time.monotonic_ns())
        headers = {_ID: f"{row.stream}.{number}"}
        await client.publish(subject, data, reply=f"{self._inbox}.{self._place}", headers=headers)

    async def _on_answer(self, message: Msg) -> None:
        awaited = self._awaited.pop(int(message.subject.rpartition(".")[2]), None)
        if awaited is None:
            return
        gone = False
        try:
            error = msgspec.json.decode(message.data, type=_Answer).error
            why = "" if error is None else str(error.get("description", error))
        except msgspec.MsgspecError:
            why, gone = f"there is no stream; {ELECTION}", True  # an empty answer with the status 503
        if why:
            self._failed([awaited], why)
            self._created = self._created and not gone  # the next check creates the stream if it is still missing
            return
        if (kept := awaited.row.find(awaited.number)) is not None:
            kept.confirmed = True
        if self.problem:
            log.info("the servers store the history again")
            self.problem = ""
        self._resend_all()

    async def check(self) -> None:
        """Count messages without an acknowledgement as not stored, and try whether the servers store again."""
        if not self._created and self._client is not None:
            self._created = await self._create(self._client)
        old_ns = time.monotonic_ns() - ACK_NS
        silent = []
        for place, awaited in list(self._awaited.items()):
            if awaited.sent_ns > old_ns:
                break
            silent.append(self._awaited.pop(place))
        if silent:
            self._failed(silent, "no acknowledgement has come")
        if self._unstored and not self._awaited:  # one message, to see whether the servers store it
            (stream, number), row = next(iter(self._unstored.items()))
            del self._unstored[stream, number]
            row.resend([number])
            self.wake()

    def _failed(self, messages: list[_Awaited], why: str) -> None:
        for row, number, _ in messages:
            self._unstored[row.stream, number] = row
        if self._created:
            self._complain(f"fabric.history: the servers do not store messages: {why}; the backlog keeps them")

    def _complain(self, problem: str) -> None:
        if problem != self.problem:
            self.problem = problem
            log.warning("%s", problem)

    def _resend_all(self) -> None:
        rows: dict[int, tuple[Row, list[int]]] = {}
        for (stream, number), row in self._unstored.items():
            rows.setdefault(stream, (row, []))[1].append(number)
        self._unstored.clear()
        for row, numbers in rows.values():
            row.resend(numbers)
            self.wake()

    @property
    def waiting(self) -> bool:
        """True if acknowledgements have not come yet."""
        return bool(self._awaited)
