"""The WebSocket connection of a rosbridge client. It needs the library websockets, which is optional."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from websockets.exceptions import ConnectionClosedOK
from websockets.frames import Frame, Opcode
from websockets.sync.client import ClientConnection

from shmio.errors import ConnectorError

MAX_FRAGMENTS: Final = 10_000
"""Maximum number of fragments in a message."""
_DATA: Final = frozenset({Opcode.TEXT, Opcode.BINARY, Opcode.CONT})


class Connection(ClientConnection):
    """A connection that handles each message in the library's own thread.

    The library would put the message into a queue, for another thread. To wake that thread takes
    longer than to handle most messages.
    """

    def __init__(
        self,
        *arguments: Any,
        handle: Callable[[bytes], None],
        end: Callable[[BaseException | None], None],
        **options: Any,
    ) -> None:
        """Create the connection, as the library does.

        Args:
            arguments: Arguments of the library.
            handle: Is called with each message. If it raises an error, the connection ends.
            end: Is called when the connection has ended, with that error or with the library's. The
                argument is None if the server has closed the connection in order.
            options: Options of the library.

        """
        self._handle, self._end = handle, end
        self._fragments: list[bytes] = []
        self._error: BaseException | None = None
        super().__init__(*arguments, **options)  # starts the thread

    def process_event(self, event: Any) -> None:
        """Handle the answer to the handshake, or a frame. The library calls this in its thread."""
        if self.response is None or event.opcode not in _DATA:
            super().process_event(event)
        elif self._error is None:
            try:
                self._take(event)
            except Exception as error:  # noqa: BLE001  the caller of `end` reports it
                self._error = error
                self.close_socket()

    def _take(self, frame: Frame) -> None:
        """Handle a frame with data. The library limits the bytes of a message, but not the number of its fragments."""
        if frame.opcode is Opcode.BINARY:
            raise ConnectorError("sent a binary message, which shmio did not request")
        if frame.fin and not self._fragments:
            self._handle(bytes(frame.data))
            return
        self._fragments.append(bytes(frame.data))
        if len(self._fragments) > MAX_FRAGMENTS:
            raise ConnectorError(f"sent a message of more than {MAX_FRAGMENTS} fragments")
        if frame.fin:
            message, self._fragments = b"".join(self._fragments), []
            self._handle(message)

    def recv_events(self) -> None:
        """Receive until the connection ends. The library calls this in its thread."""
        try:
            super().recv_events()
        finally:
            closed = self.protocol.close_exc
            self._end(self._error or (None if isinstance(closed, ConnectionClosedOK) else closed))
