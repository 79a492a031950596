"""The OPC UA server: asyncua's protocol stack, with this endpoint's nodes, sessions and limits."""

from __future__ import annotations

import asyncio
import logging
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from typing import Any, Final

from asyncua import Server as Library
from asyncua import ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import ServiceError
from asyncua.crypto import uacrypto
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_server import InternalServer as LibraryInternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.ua import ua_binary

from shmio.config import Address, OpcUa
from shmio.endpoints.opcua.access import Access
from shmio.endpoints.opcua.certificates import application_uri, read_identity
from shmio.endpoints.opcua.connection import (
    ACTIVATION_S,
    MAX_CHUNK_BYTES,
    MAX_CHUNKS,
    MAX_CONNECTIONS,
    MAX_MESSAGE_BYTES,
    MAX_PENDING,
    MAX_SESSIONS,
    Protocol,
)
from shmio.endpoints.opcua.requests import MAX_CALLS, MAX_NODES, MAX_WRITES
from shmio.endpoints.opcua.session import Session
from shmio.endpoints.opcua.space import Space
from shmio.endpoints.opcua.subscriptions import Subscriptions
from shmio.endpoints.shares import Shares
from shmio.errors import EndpointError
from shmio.version import __version__
from shmio.wording import cannot_listen

_ENCRYPTING: Final = (
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
    ua.SecurityPolicyType.Aes128Sha256RsaOaep_SignAndEncrypt,
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
)
_OAEP: Final[dict[str, Callable[[Any, bytes], bytes]]] = {
    "http://www.w3.org/2001/04/xmlenc#rsa-oaep": uacrypto.decrypt_rsa_oaep,
    "http://opcfoundation.org/UA/security/rsa-oaep-sha2-256": uacrypto.decrypt_rsa_oaep_sha256,
}
"""The accepted encryptions of passwords. PKCS 1.5 is missing, because padding attacks can break it."""
_SHA1: Final = "http://www.w3.org/2000/09/xmldsig#rsa-sha1"
SILENT_S: Final = 30.0
"""Time in s without a request after which a session ends if others need its place."""
_LIMITS: Final = {
    "MaxNodesPerRead": MAX_NODES, "MaxNodesPerWrite": MAX_WRITES, "MaxNodesPerMethodCall": MAX_CALLS,
    "MaxNodesPerBrowse": MAX_NODES, "MaxNodesPerTranslateBrowsePathsToNodeIds": MAX_NODES,
    "MaxNodesPerRegisterNodes": MAX_NODES, "MaxMonitoredItemsPerCall": MAX_NODES,
}  # fmt: skip

log = logging.getLogger("shmio.opcua")


@dataclass
class Counters:
    """Counts the clients' writes, the refused requests, and what was sent to clients."""

    writes: int = 0
    refused: int = 0
    sent_messages: int = 0
    sent_bytes: int = 0
    """Number of bytes that were written to the connections."""


class InternalServer(LibraryInternalServer):
    """The state that all connections of the server share."""

    time_task: Any

    def __init__(self, instance: str, access: Access, address: Address, *, plain_text: bool) -> None:
        self.counters = Counters()
        self.subscriptions = Subscriptions()
        self.shares = Shares()
        self.access = access
        self.loopback = address.loopback
        self.plain_text = plain_text
        """True if clients may use channels without security."""
        self.space: Space
        self.catch_up: Callable[[], object] = lambda: None
        """Function that reads all new frames, so that clients get the newest values."""
        super().__init__(user_manager=self)
        self.instance = instance
        self.allow_remote_admin = False
        self.max_connections = MAX_CONNECTIONS + MAX_PENDING
        self.max_pending_activation_seconds = ACTIVATION_S
        self.max_session_timeout_ms = 300_000

    async def init(self, shelffile: Any = None) -> None:
        """Create the nodes of the OPC UA standard, and the instance's root node."""
        await super().init(shelffile)
        self.space = Space(self.instance, self.aspace)

    async def stop(self) -> None:
        """Stop at once. The method of the library would wait for its clock task first."""
        if self.time_task is not None:
            self.time_task.cancel()
            await asyncio.wait((self.time_task,))
            self.time_task = None
        await super().stop()

    def create_session(self, name: str, user: Any = None, external: bool = False) -> InternalSession:  # noqa: ARG002
        """Create a session.

        Raises:
            ServiceError: There are too many sessions.
        """
        if self._activated >= MAX_SESSIONS:
            raise ServiceError(ua.StatusCodes.BadTooManySessions)
        return Session(self, self.aspace, self.subscription_service, name, external=external)

    @property
    def _activated(self) -> int:
        """Number of activated sessions. The number of others is bounded by that of their connections."""
        return sum(one.is_activated() for one in self._external_sessions.values())

    async def make_room(self) -> None:
        """If there are too many sessions, end one that has lost its connection, or has been silent for long."""
        if self._activated < MAX_SESSIONS:
            return
        silent_s = time.monotonic() - SILENT_S
        unused: list[Any] = [
            one for one in self._external_sessions.values() if one.detached or one._last_activity < silent_s
        ]
        if unused:
            oldest = min(unused, key=lambda one: (not one.detached, one._last_activity))
            log.warning("a session ends to make room for another one: its client does not use it")
            await oldest.close_session()

    @property
    def sessions(self) -> int:
        """Number of sessions."""
        return len(self._external_sessions)

    def get_user(self, _server: Any, username: str | None, password: str | None, certificate: bytes | None) -> Any:
        """Return the user with these credentials; None if they are wrong or give no role."""
        user = self.access.identify(username, password, certificate)
        if user is None:
            nameless = "it has no account and no certificate with a role, and opcua.anonymous is empty"
            log.warning("a client was refused: %s", "wrong name or password" if username else nameless)
        return user

    def decrypt_user_token(self, isession: Any, token: ua.UserNameIdentityToken) -> tuple[str, str]:
        """Return the name and the decrypted password in a client's token."""
        name, secret = token.UserName or "", token.Password or b""
        if not token.EncryptionAlgorithm:
            if not isession.trusted_channel:
                log.warning("a client sent its password without encryption; replace the password")
                raise ServiceError(ua.StatusCodes.BadIdentityTokenRejected)
            return name, secret.decode() if isinstance(secret, bytes) else str(secret)
        decrypt = _OAEP.get(token.EncryptionAlgorithm)
        if decrypt is None or self.private_key is None:
            raise ServiceError(ua.StatusCodes.BadIdentityTokenInvalid)
        plain = decrypt(self.private_key, secret)
        (length,) = struct.unpack_from("<I", plain)
        nonce = plain[4 + length - len(isession.nonce) : 4 + length]
        if (
            length < len(isession.nonce) or nonce != isession.nonce
        ):  # an attacker may have recorded the message and sent it again
            raise ServiceError(ua.StatusCodes.BadIdentityTokenInvalid)
        return name, plain[4 : 4 + length - len(isession.nonce)].decode()

    def verify_x509_token(self, isession: Any, token: ua.X509IdentityToken, signature: ua.SignatureData) -> bytes:
        """Return a client's certificate, after checking that it is trusted and that the client has its key."""
        if signature.Algorithm == _SHA1:
            raise ServiceError(ua.StatusCodes.BadIdentityTokenInvalid)
        if not self.access.trusts(token.CertificateData):
            raise ServiceError(ua.StatusCodes.BadIdentityTokenRejected)
        return super().verify_x509_token(isession, token, signature)


class _Listener(BinaryServer):
    """Accepts connections, and creates a :class:`Protocol` for each."""

    def _make_protocol(self) -> OPCUAProtocol:
        return Protocol(
            iserver=self.iserver,
            policies=self._policies,
            clients=self.clients,
            closing_tasks=self.closing_tasks,
            limits=self.limits,
        )


class Server(Library):
    """The OPC UA server of an instance. Use it only in the event loop's thread."""

    iserver: InternalServer

    def __init__(self, instance: str, config: OpcUa) -> None:
        """Read certificates and accounts.

        Raises:
            ConfigError: A file is not usable.

        """
        identity = read_identity(config)
        self.address = Address.parse(config.listen)
        plain_text = identity is None or config.insecure
        super().__init__(InternalServer(instance, Access(config), self.address, plain_text=plain_text))
        self.name = f"shmio {instance}"
        self.product_uri, self.manufacturer_name = "urn:shmio", "shmio"
        self.application_type = ua.ApplicationType.Server
        self.namespace = f"urn:shmio:{instance}"
        self._application_uri = f"urn:shmio:{instance}:server"
        policies = [ua.SecurityPolicyType.NoSecurity] if plain_text else []
        if identity is not None:
            self.iserver.certificate, self.iserver.private_key = identity
            self._application_uri = application_uri(identity[0]) or self._application_uri
            policies += _ENCRYPTING
        self.set_security_policy(policies)
        self._permission_ruleset = None  # each service itself checks the client's role
        tokens: list[type] = []
        if self.iserver.access.anonymous or config.client:
            tokens.append(ua.AnonymousIdentityToken)
        if config.account:
            tokens.append(ua.UserNameIdentityToken)
        if config.client:
            tokens.append(ua.X509IdentityToken)
        self.set_identity_tokens(tokens or [ua.AnonymousIdentityToken])
        host = f"[{self.address.host}]" if ":" in self.address.host else self.address.host
        self.set_endpoint(f"opc.tcp://{host}:{self.address.port}/")
        self.limits = TransportLimits(MAX_CHUNK_BYTES, MAX_CHUNK_BYTES, MAX_CHUNKS, MAX_MESSAGE_BYTES)

    async def init(self, shelf_file: Any = None) -> None:
        """Create the nodes of the OPC UA standard. Set the namespace, the build info and the limits."""
        await super().init(shelf_file)
        await self.register_namespace(self.namespace)
        await self.set_build_info(
            self.product_uri, self.manufacturer_name, "shmio", __version__, "0", datetime.now(UTC)
        )
        for name, most in _LIMITS.items():
            node = ua.NodeId(getattr(ua.ObjectIds, f"Server_ServerCapabilities_OperationLimits_{name}"))
            await self.get_node(node).write_value(most, ua.VariantType.UInt32)

    async def start(self) -> None:
        """Start to listen.

        Raises:
            EndpointError: The address cannot be used.
        """
        await self._setup_server_nodes()
        await self.iserver.start()
        listener = _Listener(self.iserver, self.address.host, self.address.port, self.limits)
        listener.set_policies(self._policies)
        try:
            await listener.start()
        except OSError as error:
            await self.iserver.stop()
            raise EndpointError(cannot_listen(self.address, error)) from None
        self.bserver = listener

    @property
    def port(self) -> int:
        """The port on which the server listens."""
        return self.bserver.port if self.bserver is not None else 0


_NESTED: Final = (ua.RelativePathElement, ua.SimpleAttributeOperand, ua.ContentFilterElement)
"""Structures of which one item of a request can have many."""
MAX_NESTED: Final = 1_000
"""Maximum number of such structures in an item."""


@cache
def bound_decoding() -> None:
    """Make the library refuse what would take too much time or memory, and read on where one item is wrong.

    The elements of an array of nulls take no bytes in a message, so a short message could fill the
    memory. An unknown number of an enumeration, or an extension object that cannot be decoded, makes the
    library refuse the whole request; now the item has the bare number, or the bare bytes.
    """
    unpack, create_list = ua_binary.unpack_uatype_array, ua_binary._create_list_deserializer
    create_enum, read_extension = ua_binary.create_enum_deserializer, ua_binary.extensionobject_from_binary

    def unpack_array(vtype: Any, data: Any) -> Any:
        if vtype == ua.VariantType.Null:
            raise ua.uaerrors.UaStatusCodeError(ua.StatusCodes.BadDecodingError)
        return unpack(vtype, data)

    @cache
    def create_list_reader(kind: Any) -> Callable[[Any], Any]:
        read = create_list(kind)

        def bounded(data: Any) -> Any:
            if struct.unpack("<i", data.copy(4).read(4))[0] > MAX_NESTED:
                raise ua.uaerrors.UaStatusCodeError(ua.StatusCodes.BadDecodingError)
            return read(data)

        return bounded if kind in _NESTED else read

    def create_enum_reader(kind: Any) -> Callable[[Any], Any]:
        read = create_enum(kind)

        def tolerant(data: Any) -> Any:
            number = data.copy(4)
            try:
                return read(data)
            except ValueError:
                return ua_binary.Primitives.Int32.unpack(number)

        return tolerant

    def read_extension_object(data: Any) -> Any:
        again = data.copy()
        try:
            return read_extension(data)
        except (ua.UaError, ValueError, struct.error, TypeError, RecursionError):
            kind, encoding = ua_binary.nodeid_from_binary(again), again.read(1)
            if encoding != b"\1" or (body := ua_binary.Primitives.ByteString.unpack(again)) is None:
                raise
            return ua.ExtensionObject(kind, body)

    ua_binary.unpack_uatype_array = unpack_array
    ua_binary._create_list_deserializer = create_list_reader
    ua_binary.create_enum_deserializer = create_enum_reader
    ua_binary.extensionobject_from_binary = read_extension_object
    for cached in (
        ua_binary._create_uatype_deserializer, ua_binary._create_uatype_array_deserializer,
        ua_binary._create_type_deserializer, ua_binary._create_dataclass_deserializer,
    ):  # fmt: skip
        cached.cache_clear()
