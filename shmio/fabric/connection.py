"""Connects to the NATS servers of the fabric."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import ssl
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from shmio.config.address import Address
from shmio.config.credentials import read_secret
from shmio.config.fabric import server_address
from shmio.config.model import Fabric, MqttTls
from shmio.config.tls import client_context
from shmio.errors import ConfigError, RemoteError
from shmio.fabric.own_seed import find_seed
from shmio.fabric.tasks import end
from shmio.libraries import library

if TYPE_CHECKING:
    from nats.aio.msg import Msg

    from shmio.fabric.client import FabricClient

INSTALL: Final = "pip install 'shmio[fabric]'"
CONNECT_S: Final = 5.0
PING_S: Final = 1.0
"""Interval between two pings of the server, in s."""
MAX_PINGS: Final = 2
"""Number of unanswered pings after which the connection counts as lost."""
RETRY_S: Final = 0.5
"""Wait between two attempts to connect again, in s."""
MAX_CREDENTIALS_BYTES: Final = 1 << 16
MAX_REASONS: Final = 32
INBOX: Final = "_INBOX"
"""Beginning of the subjects at which clients without credentials receive replies."""
OWN_INBOX: Final = f"{INBOX}.own"
"""The same for the processes of an embedded server's user. No others may subscribe to it."""
"""Maximum number of reasons that are remembered because they were logged."""

FARM: Final = "shmio_farm"
"""Name of the stream and of the object store of a farm, and first token of its subjects."""

_UNTRUSTED: Final = (18, 19, 20, 21)
"""OpenSSL's codes for a certificate whose authority is unknown."""

_VIOLATION: Final = re.compile(
    r"permissions violation for (?P<verb>publish|subscription) to \"(?P<subject>[^\"]*)\"", re.IGNORECASE
)

log = logging.getLogger("shmio.fabric")


class RefusedError(RemoteError):
    """The user needs other credentials: the server does not know them, or they do not permit what was asked."""


class Access(msgspec.Struct, frozen=True):
    """The addresses of the servers, and what shmio presents to them.

    Attributes:
        servers: URLs such as ``nats://host:4222``. The client tries them in turn.
        tls: PEM files; None: without TLS, unless the URL begins with ``tls://``.
        credentials: Path of a file with a JWT and its NKey (``.creds``), or with the seed of an
            NKey; None: without authentication.
        pinned: PEM file with the certificate of the instance's own server, the only one to trust;
            None: an authority must have issued the server's certificate.
        options: True if options of a command name the files, instead of keys of ``[fabric]``.
        own: True for the processes of an instance that runs the server. Other clients without
            credentials use the seed of this user's own server, too, if it is there.

    """

    servers: tuple[str, ...]
    tls: MqttTls | None = None
    credentials: str | None = None
    pinned: str | None = None
    options: bool = False
    own: bool = False

    @classmethod
    def of(cls, fabric: Fabric, *, process: bool = False) -> Access:
        """Return the access to the servers of a checked section, for a process of the instance or another client."""
        if not fabric.embedded:
            return cls(tuple(fabric.servers), fabric.tls, fabric.credentials)
        listen = Address.parse(str(fabric.listen))
        url = f"nats://{listen.here}"
        if fabric.tls is None:
            return cls((url,), own=process)
        shown = fabric.tls if fabric.tls.ca is not None else None  # the server asks its clients for certificates
        return cls((url,), shown, pinned=fabric.tls.certificate, own=process)

    def __str__(self) -> str:
        return ", ".join(self.servers)

    def key(self, name: str) -> str:
        """Return the option or key with this name, for messages."""
        return f"--{name}" if self.options else f"fabric.{name}"


async def connect(
    access: Access,
    name: str,
    *,
    patient: bool = True,
    lost: Callable[[], Awaitable[None]] | None = None,
    back: Callable[[], Awaitable[None]] | None = None,
    failed: Callable[[str], object] | None = None,
) -> FabricClient:
    """Connect to the first server that answers.

    The connection is restored by itself when it is lost. While it is lost, publishing raises
    ``nats.errors.OutboundBufferLimitError`` instead of storing messages.

    Args:
        access: The servers.
        name: Name of this client for the server's monitoring.
        patient: True: try until a server accepts the connection. False: try each server once.
        lost: Called when the connection is lost.
        back: Called when the connection is restored.
        failed: Called with the reason after each attempt that fails. If a server refuses the
            credentials, this stays the reason, whatever the other servers answer.

    Raises:
        ConfigError: A TLS or credentials file cannot be used.
        MissingLibraryError: nats-py is not installed.
        RefusedError: With ``patient`` False, a server refuses the credentials, or asks for some.
        RemoteError: With ``patient`` False, no server can be reached.

    """
    errors = library("nats.errors", INSTALL)
    from shmio.fabric.client import FabricClient  # noqa: PLC0415  it needs the extra

    attempts = _Attempts(access, failed, patient=patient)
    connected = False

    async def on_lost() -> None:
        if connected and lost is not None:  # the library also calls this for a connection that it gives up
            await lost()

    async def on_error(error: BaseException) -> None:
        attempts.add(error, up=client.is_connected)

    async def on_back() -> None:
        attempts.clear()
        if back is not None:
            await back()

    options: dict[str, Any] = {
        "servers": list(access.servers),
        "name": name,
        "error_cb": on_error,
        "disconnected_cb": on_lost,
        "reconnected_cb": on_back,
        "connect_timeout": CONNECT_S,
        "reconnect_time_wait": RETRY_S,
        "max_reconnect_attempts": -1 if patient else 1,
        "allow_reconnect": patient,
        "ping_interval": PING_S,
        "max_outstanding_pings": MAX_PINGS,
        "pending_size": 0,  # a message for a dead link is not stored for later
        **_tls(access),
        **read_credentials(access),
    }
    client = FabricClient()
    if access.credentials is None:
        client.own = access.own or None
        if access.own or any(find_seed(*_host(server)) for server in access.servers):
            options["inbox_prefix"] = OWN_INBOX
    try:
        await client.connect(**options)
    except asyncio.CancelledError:  # the library would leave its connection open
        await client.abandon()
        raise
    except (OSError, errors.Error) as error:  # a time-out is an OSError
        await client.abandon()
        refused = attempts.refused or _is_refusal(error)
        raise (RefusedError if refused else RemoteError)(attempts.why or _why(access, error)) from None
    connected = True
    attempts.clear()
    return client


async def connect_or_stop(
    access: Access,
    name: str,
    stop: asyncio.Event,
    *,
    lost: Callable[[], Awaitable[None]] | None = None,
    back: Callable[[], Awaitable[None]] | None = None,
) -> FabricClient | None:
    """Connect as :func:`connect` does, but only until ``stop`` is set; return None then.

    Raises:
        ConfigError: A TLS or credentials file cannot be used.
        MissingLibraryError: nats-py is not installed.

    """
    connecting = asyncio.create_task(connect(access, name, lost=lost, back=back))
    stopping = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait((connecting, stopping), return_when=asyncio.FIRST_COMPLETED)
        if connecting.done():
            return connecting.result()
        await end(connecting)
        if not connecting.cancelled() and connecting.exception() is None:
            await connecting.result().leave()  # it connected at the same moment
        return None
    finally:
        await end(stopping)
        await end(connecting)


def _host(url: str) -> tuple[str, int]:
    address = server_address("server", url, "")
    return address.host, address.port


def is_stored(message: Msg) -> bool:
    """Return whether a server sent a message of a stream, as a user asked it to do.

    A user who may read histories can let it send them to any subject, so readers of ``.live`` and the
    owner of a source ignore such messages.
    """
    return message.reply.startswith("$JS.") or "Nats-Stream" in (message.headers or ())


def wants_reply(message: Msg) -> bool:
    """Return whether a message names a subject for the reply at which a client may receive it.

    The sender chooses the subject, but the owner of a source sends the reply with its own
    permissions. So a sender could let it write into the fabric or to the servers.
    """
    return bool(message.reply) and not message.reply.startswith(("shmio.", "$"))


async def call_once(
    access: Access, work: Callable[[FabricClient], Coroutine[Any, Any, Any]], name: str = "shmio"
) -> Any:
    """Connect once, and return the result of ``work`` with the connection; the server knows it by ``name``.

    Raises:
        RefusedError: The user needs other credentials.
        RemoteError: No server can be reached, or it does not answer.

    """
    client = await connect(access, name, patient=False)
    try:
        return await call(access, client, work)
    except (TimeoutError, library("nats.errors", INSTALL).Error) as error:
        raise RemoteError(f"{access}: {reason(error)}") from None
    finally:
        await client.leave()


async def call(access: Access, client: FabricClient, work: Callable[[FabricClient], Coroutine[Any, Any, Any]]) -> Any:
    """Return the result of ``work``. If it fails since the server refuses something to this user, say so.

    Raises:
        RefusedError: The server refuses what ``work`` asks.

    """
    try:
        return await work(client)
    except (TimeoutError, RemoteError, library("nats.errors", INSTALL).Error):
        if not (why := refusal(access, client.refused)):
            raise
        raise RefusedError(f"{access}: {why}") from None


def _tls(access: Access) -> dict[str, Any]:
    if access.pinned is not None:
        return {"tls": _pinned(access)}
    if access.tls is not None:
        return {"tls": client_context(access.tls, access.key("" if access.options else "tls."))}
    if any(server.startswith("tls://") for server in access.servers):
        return {"tls": ssl.create_default_context()}
    return {}


def _pinned(access: Access) -> ssl.SSLContext:
    """Return a TLS context that trusts one certificate, whatever names it has."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    try:
        context.load_verify_locations(access.pinned)
        if access.tls is not None and access.tls.certificate is not None:
            context.load_cert_chain(access.tls.certificate, access.tls.key)
    except OSError as error:  # an SSLError is an OSError
        raise ConfigError(f"fabric.tls: {access.pinned}: {error.strerror or error}") from None
    return context


def read_credentials(access: Access) -> dict[str, Any]:
    """Return the client's options for the credentials.

    Raises:
        ConfigError: The file cannot be used, or other users may have read it.

    """
    if access.credentials is None:
        return {}
    library("nkeys", INSTALL)
    key = f"{access.key('credentials')}: {access.credentials}"
    try:
        text = read_secret(key, access.credentials, MAX_CREDENTIALS_BYTES, instead="a new seed").decode("ascii")
    except UnicodeDecodeError:
        raise ConfigError(f"{key}: the file is not text") from None
    if "BEGIN NATS USER JWT" in text:
        return {"user_credentials": access.credentials}
    seed = text.strip()
    if not seed.startswith("SU"):
        raise ConfigError(f"{key} is neither a .creds file nor the seed of a user's NKey, which begins with SU")
    return {"nkeys_seed_str": seed, "inbox_prefix": inbox_prefix(public_key(seed, access.credentials))}


def public_key(seed: str, file: str | Path) -> str:
    """Return the public NKey of a user's seed.

    Raises:
        ConfigError: The text is not a seed. The message names the file.

    """
    nkeys = library("nkeys", INSTALL)
    try:
        key: str = nkeys.from_seed(bytearray(seed, "ascii")).public_key.decode()
    except (nkeys.NkeysError, ValueError):
        raise ConfigError(f"fabric.credentials: {file}: the seed is damaged; copy the file again") from None
    return key


def inbox_prefix(key: str) -> str:
    """Return the beginning of the subjects at which the user with this public NKey receives replies.

    Each user has another one, so that a server can keep a user from reading the replies to others.
    """
    return f"{INBOX}.{key}"


class _Attempts:
    """The reasons why attempts to connect fail.

    A patient client logs each once until there is a connection. Others raise an error with the
    reason, so only refused subscriptions are logged: these fail without an error.
    """

    def __init__(self, access: Access, failed: Callable[[str], object] | None, *, patient: bool) -> None:
        self._access, self._failed, self._patient = access, failed, patient
        self._logged: set[str] = set()
        self.refused = False
        self.why = ""

    def add(self, error: BaseException, *, up: bool) -> None:
        """Take an error; ``up`` is True if there is a connection, so that the error has not ended it."""
        if not up and self.refused and not _is_refusal(error):
            return  # a server that refuses a client may also reset its connection
        text = (refusal(self._access, str(error)) or reason(error)) if up else _why(self._access, error)
        if text not in self._logged and (self._patient or "subscription" in str(error).lower()):
            if len(self._logged) >= MAX_REASONS:
                self._logged.clear()
            self._logged.add(text)
            log.warning("fabric: %s%s", text, "" if up else "; trying again")
        if up:
            return
        self.refused, self.why = _is_refusal(error), text
        if self._failed is not None:
            self._failed(text)

    def clear(self) -> None:
        """Forget the reasons: there is a connection."""
        self._logged.clear()
        self.refused, self.why = False, ""


def _is_refusal(error: BaseException) -> bool:
    return any(word in str(error).lower() for word in ("authorization", "authentication"))


def _why(access: Access, error: BaseException) -> str:
    """Return why an attempt to connect has failed."""
    return f"{access}: {_refused(access) if _is_refusal(error) else _unreachable(access, error)}"


def _unreachable(access: Access, error: BaseException) -> str:
    if not isinstance(error, ssl.SSLCertVerificationError):
        why = reason(error)
        return why if why.startswith("the server is ") else f"no NATS server can be reached: {why}"
    if access.pinned is not None:
        return f"the server's certificate is not {access.pinned}; another program listens there"
    if error.verify_code in _UNTRUSTED:
        key = access.key("ca" if access.options else "tls.ca")
        remedy = "give" if access.tls is None or access.tls.ca is None else "name its authority in"
        return f"the server's certificate is not trusted; {remedy} {key}"
    return f"the server's certificate is not valid: {error.verify_message}"


def _refused(access: Access) -> str:
    if access.credentials is None:
        return f"the server asks for credentials; name the file with this host's seed in {access.key('credentials')}"
    return f"the server does not know the credentials in {access.credentials}, or has removed them"


def refusal(access: Access, text: str, cell: object = None) -> str:
    """Return what a user may not do, and which credentials may.

    Args:
        access: The servers, and the user's credentials.
        text: The server's words, such as ``permissions violation for publish to "shmio.a.b.c.d.live"``.
        cell: The name under which the user publishes; None: it is in the subject.

    Returns:
        The sentence; empty if the text is about something else.

    """
    found = _VIOLATION.search(text)
    if found is None:
        return ""
    who = "this user" if access.credentials is None else f"the user of the credentials in {access.credentials}"
    subject = found["subject"]
    parts = subject.split(".")
    unknown = access.credentials is None  # to a server that an instance runs, it need not be
    if subject.lower().startswith("$js."):
        more = "; if an instance runs the server, be its user on its host" if unknown else ""
        return f"{who} may not {_refused_request(subject.lower())}{more}"
    if parts[0] == "shmio" and len(parts) > 5:
        own = parts[6:9] if parts[5] == "command" and found["verb"] == "publish" else parts[1:4]
    elif parts[0].lower() == "$kv":
        own = parts[2:5] if len(parts) == 5 else ["a cell"]  # a layout, not an entry
    else:
        return f"{who} may not {'publish to' if found['verb'] == 'publish' else 'subscribe to'} {subject}"
    more = "; if an instance runs the server, name the cell in its [[fabric.allow]]" if unknown else ""
    return f"{who} may not publish as {cell or '.'.join(own)}; use the seed of this cell{more}"


def _refused_request(subject: str) -> str:
    """Return what a request to JetStream would do, and which credentials may; its subject is in lower case."""
    if FARM in subject:
        return "use a farm; use the seed of a farm user"
    if ".kv_" in subject:
        if subject.startswith(("$js.api.stream.info.", "$js.api.stream.msg.get.")):
            return "read the registry; use the seed of a cell or viewer"
        return "create the registry; run shmio fabric prepare once with admin.seed, the administrator's seed"
    if subject.startswith("$js.api.stream.create."):
        return "create histories; use admin.seed, the administrator's seed"
    return (
        "use histories; reading them needs the seed of a history reader, and creating them admin.seed, the "
        "administrator's seed"
    )


def reason(error: BaseException) -> str:
    """Return in words why a server cannot be reached, or why a request failed."""
    if isinstance(error, TimeoutError):  # its text is empty, or says less
        return "the server does not answer"
    if isinstance(error, OSError) and not isinstance(error, ssl.SSLError) and error.errno and error.strerror:
        text = os.strerror(error.errno) if error.errno > 0 else error.strerror  # negative: of the name's resolution
        return text[:1].lower() + text[1:]
    return str(error) or type(error).__name__
