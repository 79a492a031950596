"""A connection by the rosbridge protocol: JSON over a WebSocket. Its own thread receives messages.

The protocol is rosbridge v2: ROSBRIDGE_PROTOCOL.md of rosbridge_suite.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import logging
import re
import socket
import struct
import threading
import time
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from shmio.config import Address
from shmio.connectors import json_text, tcp
from shmio.connectors.ros.messages import from_json
from shmio.errors import ConnectorError
from shmio.wording import printable

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

CLOSE_S: Final = 0.2
MAX_EXCESS: Final = 4
"""A message that is larger than the limit by more than this factor ends the connection; a smaller one is dropped."""
_HEAD_BYTES: Final = 2000
MAX_REPORTED: Final = 20
_SEND_TIMEOUT: Final = struct.Struct("@ll")

log = logging.getLogger("shmio.source")


class Received(NamedTuple):
    """The newest message of a topic as JSON, with the time of its receipt."""

    text: msgspec.Raw
    monotonic_ns: int
    utc_ns: int


class _Envelope(msgspec.Struct):
    """The fields of the operations that the server sends.

    ``msg`` is the message of a topic, or the text of a status; ``values`` is the answer of a service, or why there
    is none, and ``result`` whether there is one.
    """

    op: str
    topic: str = ""
    id: str | int | None = None
    level: str = ""
    msg: msgspec.Raw = msgspec.Raw(b"null")
    values: msgspec.Raw = msgspec.Raw(b"null")
    result: bool = True


_envelope = msgspec.json.Decoder(_Envelope)
_NAME: Final = rb'"topic"\s*:\s*("(?:[^"\\]|\\.){1,256}")'
_PUBLISH: Final = rb'"op"\s*:\s*"publish"'
_TOPIC: Final = re.compile(_PUBLISH + rb".{0,1000}?" + _NAME + rb"|" + _NAME + rb"\s*,\s*" + _PUBLISH, re.DOTALL)
_UNREADABLE: Final = (ValueError, RecursionError)
"""What decoders raise for text that is not JSON."""


class Link:
    """A connection to a rosbridge server."""

    def __init__(self, url: str, peer: Address, timeout_s: float, max_bytes: int, topics: Collection[str]) -> None:
        """Connect to the server.

        Args:
            url: The server's URL.
            peer: The server's host and port.
            timeout_s: Time-out for connecting, and for each answer of the server.
            max_bytes: The largest message that is read. A larger one counts as a message that cannot be read.
            topics: The topics whose messages are kept.

        Raises:
            ConnectorError: The server cannot be reached, or is not a WebSocket server.

        """
        from websockets.exceptions import WebSocketException  # noqa: PLC0415  the library is optional
        from websockets.sync.client import connect  # noqa: PLC0415

        from shmio.connectors.ros.connection import Connection  # noqa: PLC0415

        self._peer, self._timeout_s, self._topics = peer, timeout_s, topics
        self._max_bytes = max_bytes
        self._closed_errors = (WebSocketException, OSError)
        self._stack = contextlib.ExitStack()
        self._condition = threading.Condition()
        self._newest: dict[str, Received] = {}
        self._expected: tuple[str, str, Any] | None = None  # (topic, id, message)
        self._outcome: str | None = None
        self._answers: dict[str, _Envelope | None] = {}  # by the id of the call whose answer is awaited
        self._failure = ""
        self._reported = 0
        self._calls = itertools.count(1)
        self._pong: threading.Event | None = None
        self._pinged_ns = self.heard_ns = time.monotonic_ns()
        try:
            channel = tcp.connect(tcp.look_up(peer.host, peer.port, timeout_s), timeout_s)
        except TimeoutError:
            raise ConnectorError(f"no answer within {timeout_s * 1000:.0f} ms from {peer}") from None
        except ConnectionRefusedError:
            raise tcp.refused(peer) from None
        except OSError as error:
            raise ConnectorError(f"cannot connect to {peer}: {error.strerror or error}") from None
        try:
            channel.settimeout(None)  # the thread waits for ever; the option below limits the time of a send
            whole, part = divmod(timeout_s, 1)
            channel.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _SEND_TIMEOUT.pack(int(whole), int(part * 1e6)))
            connection: Any = functools.partial(Connection, handle=self._take, end=self._end)
            self._socket: ClientConnection = connect(
                url, sock=channel, open_timeout=timeout_s, close_timeout=CLOSE_S, max_size=MAX_EXCESS * max_bytes,
                ping_interval=None, compression=None, proxy=None, user_agent_header="shmio",
                create_connection=connection,
            )  # fmt: skip
            self._stack.enter_context(self._socket)
        except TimeoutError:
            channel.close()
            raise ConnectorError(f"no answer within {timeout_s * 1000:.0f} ms from {peer}") from None
        except self._closed_errors as error:
            channel.close()
            raise ConnectorError(f"{peer} did not open a WebSocket: {printable(str(error))[:200]}") from None

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(*self._closed_errors):
            self._stack.close()
        self._socket.close_socket()
        self._socket.recv_events_thread.join(CLOSE_S)

    def send(self, **message: Any) -> None:
        """Send an operation of the protocol, given by its fields.

        Raises:
            ConnectorError: The connection is lost.

        """
        try:
            self._socket.send(msgspec.json.encode(message).decode())
        except self._closed_errors as error:
            raise ConnectorError(self._failure or f"the connection to {self._peer} was lost: {_why(error)}") from None

    def newest(self) -> Mapping[str, Received]:
        """Return the newest message of each topic that has received one since the last call."""
        with self._condition:
            found, self._newest = self._newest, {}
        return found

    def keep(self, topics: Collection[str]) -> None:
        """From now on, keep only the messages of these topics."""
        with self._condition:
            self._topics = topics
            self._newest = {name: one for name, one in self._newest.items() if name in topics}

    def wait_newest(self, until_s: float) -> None:
        """Wait until a message has come on every topic since the last call of :meth:`newest`.

        Wait at most until ``until_s`` (CLOCK_MONOTONIC, in s).
        """
        with self._condition:
            self._condition.wait_for(
                lambda: self._failure or len(self._newest) == len(self._topics), max(0.0, until_s - time.monotonic())
            )

    def wait_any(self, until_s: float) -> None:
        """Wait until a message has come on any topic since the last call of :meth:`newest`.

        Wait at most until ``until_s`` (CLOCK_MONOTONIC, in s).
        """
        with self._condition:
            self._condition.wait_for(lambda: self._failure or self._newest, max(0.0, until_s - time.monotonic()))

    def check(self) -> None:
        """Check the connection, and send a ping if the server has been silent.

        Raises:
            ConnectorError: The connection is lost, or the server has not answered a ping in time.

        """
        if self._failure:
            raise ConnectorError(self._failure)
        now_ns, timeout_ns = time.monotonic_ns(), round(self._timeout_s * 1e9)
        if self._pong is not None:
            if self._pong.is_set():
                self.heard_ns, self._pong = max(self.heard_ns, self._pinged_ns), None
            elif now_ns - self._pinged_ns > timeout_ns:
                raise ConnectorError(f"no answer within {self._timeout_s * 1000:.0f} ms from {self._peer}")
        elif now_ns - max(self.heard_ns, self._pinged_ns) > timeout_ns // 2:
            try:
                self._pong, self._pinged_ns = self._socket.ping(), now_ns
            except self._closed_errors as error:
                raise ConnectorError(f"the connection to {self._peer} was lost: {_why(error)}") from None

    # -- confirmation --------------------------------------------------------------------------------------------------

    def publish(self, topic: str, message: Any, number: str) -> None:
        """Publish a message. The server sends it back, because this client also subscribes to the topic.

        Args:
            topic: The topic.
            message: The message.
            number: The id of the operation.

        Raises:
            ConnectorError: The message may or may not have been published.

        """
        with self._condition:
            self._expected, self._outcome = (topic, number, message), None
        self.send(op="publish", id=number, topic=topic, msg=message)

    def outcome(self, until_s: float) -> str | None:
        """Wait until the server has sent back the last published message.

        Returns:
            "" if the message came back, or why the server refused it; None if neither has happened
            by ``until_s``, a time of CLOCK_MONOTONIC.

        Raises:
            ConnectorError: The connection is lost.

        """
        with self._condition:
            self._condition.wait_for(
                lambda: self._outcome is not None or self._failure, max(0.0, until_s - time.monotonic())
            )
            if self._outcome is None and self._failure:
                raise ConnectorError(self._failure)
            return self._outcome

    # -- services ------------------------------------------------------------------------------------------------------

    def call(self, service: str, arguments: Mapping[str, object]) -> Any:
        """Call a service; return its answer.

        Raises:
            ConnectorError: The server does not answer in time, or reports that the call failed.

        """
        number = f"call:{service}:{next(self._calls)}"
        with self._condition:
            self._answers[number] = None
        self.send(op="call_service", id=number, service=service, args=arguments)
        with self._condition:
            self._condition.wait_for(lambda: self._answers[number] is not None or self._failure, self._timeout_s)
            answer = self._answers.pop(number)
        if answer is None:
            reason = self._failure or f"no answer within {self._timeout_s * 1000:.0f} ms from {self._peer} to {service}"
            raise ConnectorError(reason)
        values = decode(answer.values)
        if not answer.result:
            raise ConnectorError(f"{self._peer} does not answer {service}: {printable(str(values))[:200]}")
        return values

    # -- the connection's thread ---------------------------------------------------------------------------------------

    def _end(self, error: BaseException | None) -> None:
        """Keep why the connection has ended; ``error`` is None if the server closed it in order."""
        if error is None:
            failure = f"{self._peer} closed the connection"
        elif isinstance(error, ConnectorError):
            failure = f"{self._peer} {error}"
        elif isinstance(error, self._closed_errors):
            failure = f"the connection to {self._peer} was lost: {_why(error)}"
        else:
            log.error("a message of %s could not be handled", self._peer, exc_info=error)
            failure = f"a message of {self._peer} could not be handled; see the log"
        with self._condition:
            self._failure = failure
            self._condition.notify_all()

    def _take(self, text: bytes) -> None:
        if len(text) > self._max_bytes:
            envelope = _unreadable(text[:_HEAD_BYTES])
            self._report(f"sent a message of {len(text)} bytes; raise max_message_bytes to read it")
        else:
            envelope = _read(text)
        if envelope is None:
            raise ConnectorError("sent a message that is not of the rosbridge protocol")
        self.heard_ns = time.monotonic_ns()
        if envelope.op == "publish":
            self._take_message(envelope)
        elif envelope.op == "status":
            self._take_status(envelope)
        elif envelope.op == "service_response":
            with self._condition:
                if isinstance(envelope.id, str) and envelope.id in self._answers:
                    self._answers[envelope.id] = envelope
                    self._condition.notify_all()

    def _take_message(self, envelope: _Envelope) -> None:
        text = envelope.msg.copy()
        with self._condition:
            if envelope.topic not in self._topics:
                return
            self._newest[envelope.topic] = Received(text, self.heard_ns, time.time_ns())
            if self._expected is not None and self._expected[0] == envelope.topic:
                message = decode(text)
                if message is not None and _contains(message, self._expected[2]):
                    self._outcome, self._expected = "", None
            self._condition.notify_all()

    def _take_status(self, envelope: _Envelope) -> None:
        found = decode(envelope.msg)
        text = printable(found if isinstance(found, str) else "")[:300]
        with self._condition:
            if envelope.level == "error" and self._expected is not None and self._expected[1] == envelope.id:
                self._outcome, self._expected = (
                    f"the server refuses the message: {text}" if text else "the server refuses the message",
                    None,
                )
                self._condition.notify_all()
                return
        if envelope.level in ("error", "warning"):
            self._report(f"reports: {text}")

    def _report(self, what: str) -> None:
        """Log what the server does, but only ``MAX_REPORTED`` times in a connection."""
        self._reported += 1
        if self._reported <= MAX_REPORTED:
            log.warning("%s %s", self._peer, what)


def decode(text: msgspec.Raw) -> Any:
    """Return the document in a JSON message, which may also contain NaN and Infinity; None if it is not valid JSON."""
    with contextlib.suppress(*_UNREADABLE):
        return json_text.read(text)
    return None


def _read(text: bytes) -> _Envelope | None:
    """Return the operation in a text; None if it has none.

    rosbridge_suite writes NaN and Infinity, which JSON does not have. A text that cannot be read, but names its
    topic, is a message of this topic that cannot be read.
    """
    with contextlib.suppress(*_UNREADABLE):
        return _envelope.decode(text)
    with contextlib.suppress(*_UNREADABLE):
        fields = json_text.read(text)
        if isinstance(fields, dict):
            for name in {"msg", "values"} & fields.keys():
                fields[name] = msgspec.Raw(json.dumps(fields[name]).encode())
            return msgspec.convert(fields, _Envelope)
    return _unreadable(text)


def _unreadable(text: bytes) -> _Envelope | None:
    """Return an empty message of the topic that a text names; None if it names none."""
    for part in (text[:_HEAD_BYTES], text[-_HEAD_BYTES:]):  # the message may precede the name; all of it is too long
        with contextlib.suppress(*_UNREADABLE):
            if found := _TOPIC.search(part):
                return _Envelope("publish", json.loads(found[1] or found[2]))
    return None


def _contains(found: Any, expected: Any) -> bool:
    """Return whether ``found`` has all fields of ``expected``, with the same values."""
    if isinstance(expected, dict):
        return isinstance(found, dict) and all(
            name in found and _contains(found[name], value) for name, value in expected.items()
        )
    if isinstance(expected, list):
        found = from_json(found, "uint8[]")
        return (
            isinstance(found, list)
            and len(found) == len(expected)
            and all(_contains(one, other) for one, other in zip(found, expected, strict=True))
        )
    return bool(found == expected)


def _why(error: BaseException) -> str:
    return printable(str(error))[:200] or type(error).__name__
