"""The NATS client, changed: it leaves a dead connection at once, flushes reliably, and insists on TLS and a version.

Import this module only when nats-py is installed.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from nats.aio.client import PING_PROTO, Client, Srv
from nats.errors import ConnectionReconnectingError, Error

from shmio.fabric.own_seed import find_seed
from shmio.fabric.server_version import version_fault
from shmio.fabric.tasks import end

CLOSE_S: Final = 1.0
FLUSH_S: Final = 10
_VIOLATION: Final = "permissions violation"

log = logging.getLogger("shmio.fabric")


def _matters(record: logging.LogRecord) -> bool:
    """Return False for a warning that the end of each TLS connection would cause, and that means nothing."""
    return "eof_received() has no effect" not in str(record.msg)


logging.getLogger("asyncio").addFilter(_matters)


class FabricClient(Client):
    """A NATS client that drops its connection, and all that waits to be sent, when the connection is lost.

    The library's client first waits until the peer has taken what waits. A peer that is gone does not
    take anything, so the client would not connect again for minutes. Afterwards it would send what
    waited, as if it were new.
    """

    refused = ""
    """What the server has last refused to this user, in its words and in lower case; empty if nothing."""
    own: bool | None = False
    """Whether to use the seed of this user's embedded servers: None: if there is one; True: connect only with one."""

    async def confirm(self) -> None:
        """Wait until the server has all that was sent so far.

        Raises:
            nats.errors.Error: There is no connection, or it is lost meanwhile.

        """
        answer: asyncio.Future[bool] = asyncio.get_running_loop().create_future()
        await self._send_ping(answer)
        await asyncio.wait((answer,))
        if answer.cancelled():
            raise ConnectionReconnectingError

    async def flush(self, timeout: int = FLUSH_S) -> None:  # noqa: ASYNC109  the library's signature
        """Do the same for at most a time in s. The library's flush returns at once if the connection was just lost."""
        async with asyncio.timeout(timeout):
            await self.confirm()

    async def _process_op_err(self, e: Exception) -> None:
        if self.is_connected or self.is_connecting:
            self._abort()
        await super()._process_op_err(e)

    async def _process_err(self, err_msg: str) -> None:
        """Connect again after an error of the server: the library gives up, for example if the user was removed."""
        if _VIOLATION in err_msg.lower():
            self.refused = err_msg
            await super()._process_err(err_msg)
        else:
            await self._process_op_err(Error(err_msg))

    async def _connect_to_server(self, s: Srv) -> None:
        self._abort()  # of an attempt that failed: the library would leave its socket open
        await super()._connect_to_server(s)

    def _connect_command(self) -> bytes:
        """Refuse servers that are too old, or without TLS if TLS is required: the library would continue in plain text.

        A new server of this user may have a new seed, so each attempt to connect reads it.
        """
        writer = getattr(self._transport, "_io_writer", None)
        encrypted = isinstance(writer, asyncio.StreamWriter) and writer.get_extra_info("ssl_object") is not None
        if self.options.get("tls") and not encrypted:
            self._abort()
            raise Error("the server does not offer TLS, which this connection requires; connect to a server with TLS")
        if fault := version_fault(str(self._server_info.get("version", ""))):
            self._abort()
            raise Error(fault)
        if self.own is not False:
            self._use_own_seed()
        return bytes(super()._connect_command())

    def _use_own_seed(self) -> None:
        place = None if self._current_server is None else self._current_server.uri
        seed = None if place is None or place.hostname is None else find_seed(place.hostname, place.port or 0)
        if seed is None and self.own:
            self._abort()
            raise Error("there is no seed of this user for the server; is it another user's server?")
        self._nkeys_seed_str, self._auth_configured = seed, seed is not None
        if seed is not None:
            self._setup_nkeys_seed_connect()

    async def _send_ping(self, future: asyncio.Future[bool] | None = None) -> None:
        """Send a ping behind all that waits to be sent: the library's ping overtakes it, so flush() ends too soon."""
        if not self.is_connected:  # a ping of an old connection on a new one would confirm too much
            raise ConnectionReconnectingError
        self._pongs.append(asyncio.Future() if future is None else future)
        await self._send_command(PING_PROTO)
        await self._flush_pending()

    async def leave(self, timeout_s: float = CLOSE_S) -> None:
        """Close the connection. If the server does not take what waits within a time in s, drop that."""
        closing = asyncio.get_running_loop().create_task(self.close())
        await asyncio.wait((closing,), timeout=timeout_s)
        if not closing.done():
            self._abort()
            await end(closing)
        if not closing.cancelled() and (error := closing.exception()) is not None:
            log.debug("the connection has ended: %s", error)

    async def abandon(self) -> None:
        """Close a connection that was not established. After a failed TLS handshake, close() waits for ever."""
        self._abort()
        await self.leave()

    def _abort(self) -> None:
        self._pending = []
        self._pending_data_size = 0
        pongs, self._pongs = self._pongs, []
        for pong in pongs:
            pong.cancel()
        writer = getattr(self._transport, "_io_writer", None)
        if isinstance(writer, asyncio.StreamWriter):
            writer.transport.abort()
