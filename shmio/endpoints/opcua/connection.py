"""Handles a client's connection within limits: splits messages, opens the secure channel, processes requests."""

from __future__ import annotations

import asyncio
import logging
import struct
import time
from collections import Counter
from typing import Any, Final

from asyncua import ua
from asyncua.common.connection import MessageChunk
from asyncua.common.utils import Buffer, NotEnoughData, ServiceError
from asyncua.server.binary_server_asyncio import OPCUAProtocol
from asyncua.server.uaprocessor import UaProcessor
from asyncua.ua.ua_binary import header_from_binary, uatcp_to_binary

from shmio.audit import trail
from shmio.audit.trail import Acting, Actor
from shmio.endpoints.opcua.requests import SERVICES, Service, decode, encode
from shmio.endpoints.shares import Share
from shmio.logs import fields

MAX_CONNECTIONS: Final = 100
"""Maximum number of connections with an activated session."""
MAX_PENDING: Final = 100
"""Number of connections without an activated session, above which a new one replaces the oldest."""
MAX_SESSIONS: Final = 100
MAX_SMALL_BYTES: Final = 65_536
"""Maximum size of a request that needs no activated session."""
MAX_ACKNOWLEDGEMENTS: Final = 1_000
"""Maximum number of acknowledgements in a Publish request."""
MAX_CHUNK_BYTES: Final = 65_535
MAX_MESSAGE_BYTES: Final = 4 << 20
MAX_CHUNKS: Final = MAX_MESSAGE_BYTES // MAX_CHUNK_BYTES + 1
MAX_WAITING: Final = 32
"""Number of waiting messages above which the endpoint reads no more from the connection."""
MAX_UNSENT_BYTES: Final = 1 << 20
"""Number of unsent bytes for a client above which the endpoint does not process the client's requests."""
STUCK_S: Final = 30.0
"""Time in s after which the endpoint disconnects a client that does not read."""
ACTIVATION_S: Final = 10.0
"""Time in s that a new client has to activate a session."""

_KINDS: Final = (b"HEL", b"OPN", b"MSG", b"CLO")
_IDS = ua.ObjectIds
_WITHOUT_SESSION: Final = frozenset({
    _IDS.GetEndpointsRequest_Encoding_DefaultBinary, _IDS.FindServersRequest_Encoding_DefaultBinary,
    _IDS.CloseSecureChannelRequest_Encoding_DefaultBinary,
})  # fmt: skip
_SESSIONS: Final = frozenset({
    _IDS.CreateSessionRequest_Encoding_DefaultBinary, _IDS.ActivateSessionRequest_Encoding_DefaultBinary,
    _IDS.CloseSessionRequest_Encoding_DefaultBinary,
})  # fmt: skip
_SERVED: Final = frozenset({
    *SERVICES,
    _IDS.CreateSubscriptionRequest_Encoding_DefaultBinary, _IDS.ModifySubscriptionRequest_Encoding_DefaultBinary,
    _IDS.PublishRequest_Encoding_DefaultBinary, _IDS.RepublishRequest_Encoding_DefaultBinary,
})  # fmt: skip
"""The services that a session may use. The endpoint refuses all others: some could change the address space."""

log = logging.getLogger("shmio.opcua")

Fault = ua.StatusCodes


class Processor(UaProcessor):
    """Processes the requests of one connection."""

    iserver: Any  # InternalServer of the module server, which imports this one
    session: Any

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.share = Share(self.iserver.shares)
        """The client's share of the endpoint's time."""
        self._pass = asyncio.Event()
        self._pass.set()
        self._sending = False
        """True while a response is being sent in several chunks, between which no other message may come."""

    def can_send(self) -> bool:
        """Return whether messages can be sent: whether the connection is open and free, and the client reads."""
        return self._pass.is_set() and not self._sending and not self._transport.is_closing()

    @property
    def pending(self) -> bool:
        """True if the client has not activated a session."""
        return self.session is None or not self.session.is_activated()

    def pause(self) -> None:
        """Stop processing requests until :meth:`resume`."""
        self._pass.clear()

    def resume(self) -> None:
        """Continue to process requests."""
        self._pass.set()

    async def proceed(self) -> None:
        """Wait while processing is paused."""
        await self._pass.wait()

    async def _respond(self, service: Service, requesthdr: Any, seqhdr: Any, body: Any) -> None:
        """Serve a request whose parameters and results are arrays, in slices of the client's share of the time."""
        session: Any = self.session
        parameters = await decode(service.parameters, body, service.most, self.share)
        results = await getattr(session, service.serve)(parameters)
        header = ua.ResponseHeader(RequestHandle=requesthdr.RequestHandle)
        await self._send(encode(service, header, results), seqhdr)

    async def _send(self, message: bytes, seqhdr: Any) -> None:
        """Send a response, and let other clients proceed between its chunks.

        Raises:
            ServiceError: The response is larger than the client allows.
        """
        connection, token = self._connection, self._connection.security_token
        chunks = MessageChunk.message_to_chunks(
            connection.security_policy, message, self._limits.max_send_buffer,
            channel_id=token.ChannelId, request_id=seqhdr.RequestId, token_id=token.TokenId,
        )  # fmt: skip
        if not self._fits(len(message), len(chunks)):
            raise ServiceError(Fault.BadResponseTooLarge)
        self._sending = True
        try:
            for chunk in chunks:
                connection._sequence_number = connection._sequence_number % 0xFFFFFFFF + 1
                chunk.SequenceHeader.SequenceNumber = connection._sequence_number
                self._transport.write(chunk.to_binary())
                await self.proceed()
                await self.share.turn()
        finally:
            self._sending = False

    def _fits(self, size: int, chunks: int) -> bool:
        """Return whether the client accepts a message. The limits of its Hello are known if they are below ours."""
        limits = self._limits
        bound_size, bound_chunks = limits.max_message_size, limits.max_chunk_count
        return (size <= bound_size or bound_size == MAX_MESSAGE_BYTES) and (
            chunks <= bound_chunks or bound_chunks == MAX_CHUNKS
        )

    def publish(self, result: ua.PublishResult, request: Any) -> None:
        """Send a publication as the answer to a Publish request."""
        response = ua.PublishResponse()
        response.Parameters = result
        result.Results = request.results
        self.send_response(request.requesthdr.RequestHandle, request.seqhdr, response)

    def open_secure_channel(self, algohdr: Any, seqhdr: Any, body: Any) -> None:
        """Open or renew a channel.

        If the configuration requires trusted certificates, the client's certificate is checked.
        """
        access = self.iserver.access
        certificate = self._connection.security_policy.peer_certificate
        if self.encrypted and access.asks_certificates and not (certificate and access.trusts(certificate)):
            who = Acting(Actor("anonymous", "", ":".join(map(str, self.name[:2]))), "opcua")
            trail.record("sign in", {}, "denied", "its certificate is not trusted", who=who)
            raise ua.uaerrors.UaStatusCodeError(Fault.BadCertificateUntrusted)
        super().open_secure_channel(algohdr, seqhdr, body)

    @property
    def encrypted(self) -> bool:
        """True if the channel is encrypted."""
        return bool(self._connection.security_policy.Mode == ua.MessageSecurityMode.SignAndEncrypt)

    async def _process_message(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Any) -> bool:
        try:
            return await self._serve(typeid, requesthdr, seqhdr, body)
        except (ServiceError, ua.uaerrors.UaStatusCodeError):
            raise
        except (NotEnoughData, RecursionError, UnicodeDecodeError, ua.UaError, ValueError, struct.error) as error:
            log.warning("a request cannot be decoded: %s", type(error).__name__, extra=fields(peer=str(self.name)))
            raise ServiceError(Fault.BadDecodingError) from None
        except Exception:
            log.exception("a request failed", extra=fields(peer=str(self.name)))
            raise ServiceError(Fault.BadInternalError) from None

    async def _serve(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Any) -> bool:
        kind = typeid.Identifier if typeid.NamespaceIndex == 0 else None
        if len(body) > MAX_SMALL_BYTES and kind not in SERVICES and kind != _IDS.PublishRequest_Encoding_DefaultBinary:
            raise ServiceError(Fault.BadRequestTooLarge)
        if kind not in _WITHOUT_SESSION:
            # Every client may open a channel without security to ask which endpoints there are.
            if not self.encrypted and not self.iserver.plain_text:
                raise ServiceError(Fault.BadSecurityPolicyRejected)
            if kind not in _SESSIONS and kind not in _SERVED:
                raise ServiceError(Fault.BadServiceUnsupported)
        if kind == _IDS.CreateSessionRequest_Encoding_DefaultBinary:
            if self.session is not None:
                await self.session.close_session()  # asyncua would never remove the old session
                self.session = None
            await self.iserver.make_room()
        elif kind == _IDS.ActivateSessionRequest_Encoding_DefaultBinary:
            return await self._activate(typeid, requesthdr, seqhdr, body)
        elif kind in _SERVED and self.session is not None:
            session: Any = self.session
            if not session.is_activated():
                raise ServiceError(Fault.BadSessionNotActivated)
            if requesthdr.AuthenticationToken != session.auth_token:
                raise ServiceError(Fault.BadSessionIdInvalid)
            if kind in SERVICES:
                self.session_last_activity = time.monotonic()
                session.touch()
                await self._respond(SERVICES[kind], requesthdr, seqhdr, body)
                return True
            if kind == _IDS.PublishRequest_Encoding_DefaultBinary:
                (acknowledged,) = struct.unpack("<i", body.copy(4).read(4))
                if acknowledged > MAX_ACKNOWLEDGEMENTS:
                    raise ServiceError(Fault.BadTooManyOperations)
        return bool(await super()._process_message(typeid, requesthdr, seqhdr, body))

    async def _activate(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Any) -> bool:
        session: Any = self.session or self.iserver.lookup_external_session(requesthdr.AuthenticationToken)
        if session is None or session.auth_token != requesthdr.AuthenticationToken:
            raise ServiceError(Fault.BadSessionIdInvalid)
        session.trusted_channel = self.encrypted or self.iserver.loopback
        session.share = self.share
        taken_over = self.session is None
        try:
            done = bool(await super()._process_message(typeid, requesthdr, seqhdr, body))
        except BaseException:
            if taken_over:
                self.session = None
            raise
        session.detached = False
        for one in self.iserver.subscriptions.of(session):
            session.attach(one, self.forward_publish_response, self.get_publish_request)
        return done

    def _should_close_session_on_transport_loss(self) -> bool:
        session: Any = self.session
        if session is not None:
            session.detached = True
        if session is None or not session.is_activated():
            return session is not None
        return not self.iserver.subscriptions.of(session)


class _CountedTransport:
    """A connection's transport that counts the messages and bytes written to it."""

    def __init__(self, transport: asyncio.BaseTransport, counters: Any) -> None:
        self._transport: Any = transport
        self._counters = counters
        self.share: Share | None = None
        """The client's share of the endpoint's time."""

    def write(self, data: bytes) -> None:
        self._counters.sent_messages += 1
        self._counters.sent_bytes += len(data)
        if self.share is not None:
            self.share.count_bytes(len(data))
        self._transport.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)


class Protocol(OPCUAProtocol):
    """Receives messages, limits their size and number, and disconnects clients that violate the protocol."""

    iserver: Any  # InternalServer of the module server, which imports this one

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.messages: asyncio.Queue[tuple[Any, Any]] = asyncio.Queue()
        self._received = bytearray()
        self._greeted = False
        self._paused = False
        self._stuck: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Accept a connection. If too many have no activated session, the oldest of these is closed."""
        counted: Any = _CountedTransport(transport, self.iserver.counters)
        pending: list[Any] = [one for one in self.clients if one.processor is None or one.processor.pending]
        if len(pending) >= MAX_PENDING:
            hosts = Counter(one.peer_name[0] for one in pending)
            (most, _), *_ = hosts.most_common(1)
            oldest = next(one for one in pending if one.peer_name[0] == most)
            oldest.drop("too many clients have connected without a session, and it is the oldest of its host")
        super().connection_made(counted)
        if self.transport is None:  # refused
            return
        self.processor: Any = Processor(self.iserver, self.transport, self.limits)
        self.processor.set_policies(self.policies)
        counted.share = self.processor.share
        self.transport.set_write_buffer_limits(high=MAX_UNSENT_BYTES)

    def connection_lost(self, ex: BaseException | None) -> None:
        """Stop the timer, and let the library clean up. asyncio calls this when the connection has ended."""
        if self._stuck is not None:
            self._stuck.cancel()
        if self.transport is not None:
            self.processor.share.close()
            super().connection_lost(ex)

    def pause_writing(self) -> None:
        """Stop processing a client's requests, because it does not read; disconnect it after ``STUCK_S``."""
        if self.processor is not None:
            self.processor.pause()
        self._stuck = asyncio.get_running_loop().call_later(STUCK_S, self.drop, "it does not read what it is sent")

    def resume_writing(self) -> None:
        """Process requests again, now that the client reads."""
        if self._stuck is not None:
            self._stuck.cancel()
            self._stuck = None
        if self.processor is not None:
            self.processor.resume()

    def data_received(self, data: bytes) -> None:
        """Split received bytes into messages."""
        self._received += data
        while len(self._received) >= 8:
            kind, chunk, size = struct.unpack_from("<3scI", self._received)
            known = kind in _KINDS and chunk in (b"F", b"C", b"A") and (kind == b"HEL") != self._greeted
            if not known or not (12 if self._greeted else 8) < size <= MAX_CHUNK_BYTES:
                self.drop("it sent data that is not OPC UA")
                return
            if len(self._received) < size:
                return
            self._greeted = True
            message = Buffer(bytes(self._received[:size]))
            del self._received[:size]
            self.messages.put_nowait((header_from_binary(message), message))
        if self.messages.qsize() > MAX_WAITING and not self._paused and self.transport is not None:
            self._paused = True
            self.transport.pause_reading()

    async def _process_received_message_loop(self) -> None:
        while True:
            header, message = await self.messages.get()
            if header is None:
                return
            if self._paused and self.messages.qsize() < MAX_WAITING // 2 and self.transport is not None:
                self._paused = False
                self.transport.resume_reading()
            await self.processor.proceed()
            await self.processor.share.wait()  # at least lets other connections proceed
            try:
                if not await self.processor.share.count(self.processor.process(header, message)):
                    break
            except ua.uaerrors.UaStatusCodeError as error:
                self._fail(error.code)
                break
            except Exception as error:  # noqa: BLE001  an error in a message ends only its connection
                log.warning(
                    "a client was disconnected: its message cannot be processed: %s",
                    type(error).__name__, extra=fields(peer=str(self.peer_name)),
                )  # fmt: skip
                self._fail(Fault.BadTcpInternalError if header.MessageType == b"HEL" else Fault.BadDecodingError)
                break
        if self.transport is not None:
            self.transport.close()

    def _fail(self, code: int) -> None:
        """Send the client the reason for the disconnection."""
        if self.transport is not None and not self.transport.is_closing():
            self.transport.write(uatcp_to_binary(ua.MessageType.Error, ua.ErrorMessage(ua.StatusCode(code), "")))

    def drop(self, why: str) -> None:
        """Disconnect the client at once. The log says why."""
        log.warning("a client was disconnected: %s", why, extra=fields(peer=str(self.peer_name)))
        self._received.clear()
        if self.transport is not None:
            self.transport.abort()
