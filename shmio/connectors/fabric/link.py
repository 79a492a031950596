"""The connection of a mirror to the fabric, in a thread of its own."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import msgspec

from shmio.connectors.fabric.order import Announced, Missing
from shmio.errors import ShmioError
from shmio.fabric.connection import INSTALL, Access, connect, is_stored
from shmio.fabric.messages import (
    STATE_REQUEST,
    CommandReply,
    CommandRequest,
    MissingRequest,
    decode_reply,
    encode_command,
)
from shmio.fabric.names import CellName
from shmio.fabric.registry import CellEntry
from shmio.fabric.tasks import end
from shmio.libraries import library
from shmio.model.values import OutcomeKind

if TYPE_CHECKING:
    from nats.aio.msg import Msg

    from shmio.fabric.client import FabricClient

MAX_WAITING: Final = 65_536
"""Maximum number of messages that wait for the mirror's loop. It requests those that are dropped."""
MAX_STATUS: Final = 16
"""Maximum number of the owner's entries that wait."""
IDLE_S: Final = 1.0
"""Time without an answer after which a request for missing messages has ended, in s."""
_NOT_SENT: Final = "the connection to the fabric is lost"

log = logging.getLogger("shmio.source")


class Link:
    """Receives the messages of one source, and sends requests and commands to its owner.

    The methods may be called by any thread. ``received`` and ``told`` are called in the link's
    thread.
    """

    def __init__(
        self,
        access: Access,
        cell: CellName,
        source: str,
        client_name: str,
        sender: CellName | None,
        received: Callable[[bytes], None],
        told: Callable[[Missing | Announced], None],
    ) -> None:
        """Create the link; :meth:`start` connects it.

        Args:
            access: The servers.
            cell: The cell that owns the source.
            source: Name of the source in that cell.
            client_name: Name of this client for the server.
            sender: The cell to which this instance belongs; None if it has no name in the fabric,
                so that it can send no commands.
            received: Called with each message.
            told: Called with a request for missing messages when its answer is complete, and with
                what the owner's entry in the registry says.

        """
        self._access = access
        self._cell = cell
        self._source = source
        self._name = client_name
        self._sender = sender
        self._received = received
        self._told = told
        self._loop = asyncio.new_event_loop()
        self._client: FabricClient | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="fabric", daemon=True)
        self.problem = "the fabric is not connected yet"
        """Why there is no connection; empty if there is one."""
        self.stalled = False
        """True while the server answers nothing, although the connection does not count as lost."""
        self.host = ""
        """Name of the owner's host; empty until an entry of the owner has come."""

    @property
    def connected(self) -> bool:
        """True while the link is connected."""
        return not self.problem

    def start(self) -> None:
        """Connect in the background, again and again until a server answers."""
        self._thread.start()

    def close(self) -> None:
        """Close the connection, and end the thread."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()

    def request(self, missing: Missing) -> None:
        """Request missing messages. Each is passed to ``received``, then ``answered`` is called."""
        self._submit(self._request(missing))

    def command(self, request: CommandRequest, timeout_s: float) -> Future[CommandReply]:
        """Send a command to the owner, and return its reply as a future."""
        return self._submit(self._command(request, timeout_s))

    def request_state(self) -> None:
        """Ask the owner to publish the state of the source, if there is a connection."""
        self._submit(self._request_state())

    # ---- in the link's thread ------------------------------------------------------------------------------------

    def _submit(self, work: Coroutine[Any, Any, Any]) -> Future[Any]:
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def _run(self) -> None:
        loop = self._loop
        asyncio.set_event_loop(loop)
        opening = loop.create_task(self._open())
        try:
            loop.run_forever()
        finally:
            loop.run_until_complete(self._end(opening))
            loop.run_until_complete(loop.shutdown_asyncgens())
            loop.close()

    async def _end(self, opening: asyncio.Task[None]) -> None:
        self._closing = True
        await end(opening)
        if self._client is not None:
            await self._client.abandon()  # close() waits until a dead link has taken what waits
        others = asyncio.all_tasks() - {asyncio.current_task()}
        await asyncio.gather(*map(end, others))
        await asyncio.gather(opening, *others, return_exceptions=True)  # takes their errors, which nobody needs now

    async def _open(self) -> None:
        try:
            self._client = await connect(
                self._access, self._name, lost=self._lost, back=self._back, failed=self._failed
            )
            for subject in (self._cell.live(self._source), self._cell.late(self._source)):
                await self._client.subscribe(subject, cb=self._take, pending_msgs_limit=MAX_WAITING)
            await self._client.subscribe(self._cell.status, cb=self._on_status, pending_msgs_limit=MAX_STATUS)
            await self._client.flush()
        except ShmioError as error:
            self.problem = str(error)
            log.error("%s", error)
        except library("nats.errors", INSTALL).ConnectionReconnectingError:
            return  # _lost and _back follow
        except (OSError, library("nats.errors", INSTALL).Error) as error:
            self.problem = f"the fabric refuses the connection: {error}"
            log.error("%s", self.problem)
        else:
            self.problem = ""
            log.info("connected to the fabric at %s", self._access)

    async def _lost(self) -> None:
        if not self.problem and not self._closing:
            log.warning("%s", _NOT_SENT)
        self.problem = _NOT_SENT

    def _failed(self, why: str) -> None:
        self.problem = why

    async def _back(self) -> None:
        self.problem = ""
        log.info("connected to the fabric again")

    async def _take(self, message: Msg) -> None:
        if not is_stored(message):
            self._received(message.data)

    async def _on_status(self, message: Msg) -> None:
        if is_stored(message):
            return
        with suppress(msgspec.MsgspecError):  # not from shmio
            entry = msgspec.json.decode(message.data, type=CellEntry)
            source = entry.source(self._source)
            if source is not None and entry.cell == str(self._cell):
                self.host = entry.host
                self._told(Announced(source.stream, source.number, time.monotonic_ns()))

    async def _request(self, missing: Missing) -> None:
        client = self._client
        if client is None or not client.is_connected:
            return
        errors = library("nats.errors", INSTALL)
        inbox = client.new_inbox()
        answers = await client.subscribe(inbox)
        request = msgspec.json.encode(MissingRequest(missing.stream, missing.first, missing.last))
        try:
            await client.publish(self._cell.missing(self._source), request, reply=inbox)
            while True:
                try:
                    answer = await answers.next_msg(timeout=IDLE_S)
                except TimeoutError:
                    await self._await_server(client)
                    if not answers.pending_msgs:
                        return  # the loop repeats the request, or gives up
                    continue
                if answer.headers and answer.headers.get("Status") == "503":
                    return  # no uplink runs: the request is repeated
                if not answer.data:
                    self._told(missing)
                    return
                self._received(answer.data)
        except errors.Error:
            return  # the connection is lost
        finally:
            with suppress(errors.Error):
                await answers.unsubscribe()

    async def _await_server(self, client: FabricClient) -> None:
        """Wait until all that the server has sent so far has come, or the connection is lost."""
        self.stalled = True
        try:
            await client.confirm()
        finally:
            self.stalled = False

    async def _request_state(self) -> None:
        if self._client is not None and self._client.is_connected:
            with suppress(library("nats.errors", INSTALL).Error):
                await self._client.publish(self._cell.missing(self._source), msgspec.json.encode(STATE_REQUEST))

    async def _command(self, request: CommandRequest, timeout_s: float) -> CommandReply:
        errors = library("nats.errors", INSTALL)
        count, client = request.outcomes, self._client
        if self._sender is None:
            return _all(count, OutcomeKind.REJECTED, "this instance has no name in the fabric; set fabric.cell")
        if client is None or not client.is_connected:
            return _all(count, OutcomeKind.EXPIRED, self.problem or _NOT_SENT)
        subject = self._cell.command(self._source, self._sender)
        try:
            reply = await client.request(subject, encode_command(request), timeout=timeout_s)
            return decode_reply(reply.data, count)
        except errors.NoRespondersError:
            why = f"{self._cell} takes no commands: its uplink does not run, or fabric.allow names no sender"
            return _all(count, OutcomeKind.EXPIRED, why)
        except errors.MaxPayloadError:
            why = "the command is larger than the server's max_payload; write fewer registers at once"
            return _all(count, OutcomeKind.REJECTED, why)
        except errors.OutboundBufferLimitError:
            return _all(count, OutcomeKind.EXPIRED, _NOT_SENT)
        except (OSError, errors.Error, ValueError) as error:
            why = "no answer came" if isinstance(error, TimeoutError) else str(error)
            return _all(count, OutcomeKind.UNKNOWN, f"{self._cell}: {why}")


def _all(count: int, kind: OutcomeKind, reason: str) -> CommandReply:
    return CommandReply([kind.value] * count, [reason] * count)
