"""One session with an OPC UA server, with the nodes that it reads and the subscriptions for them.

The session uses asyncua for the channel, the security and the requests, but watches the connection
itself. The session ends at the first error. The connector then opens a new session with new objects, so
that no late answer of the old session can be mistaken for one of the new session.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
import struct
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from asyncua import Client, ua
from asyncua.client.ua_client import UASocketProtocol
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import Buffer
from asyncua.crypto import security_policies
from asyncua.ua import ua_binary

from shmio.connectors import tcp
from shmio.connectors.opcua import decode
from shmio.connectors.opcua.data_types import DataTypes, Structures
from shmio.connectors.opcua.decode import FaultError, MalformedError, Publication, Sample
from shmio.connectors.opcua.options import Credentials, OpcUaOptions
from shmio.errors import ConnectorError
from shmio.layout.addresses.opcua import Address, BrowsePath
from shmio.model.statuses import BAD_NODE_ID_UNKNOWN, BAD_WAITING_FOR_INITIAL_DATA, GOOD, describe

MAX_CHUNK_BYTES: Final = 65_535
MAX_MESSAGE_BYTES: Final = 64 << 20
MAX_PER_CALL: Final = 1_000
"""Maximum number of nodes in a request. The server may have a lower limit, which then applies."""
MAX_PUBLISH_REQUESTS: Final = 20
RETRY_S: Final = 10.0
"""Interval in s at which the session requests nodes again that the server did not know."""
SESSION_TIMEOUT_MS: Final = 30_000
PROBES: Final = 0.25
"""Interval between requests that check whether the server answers, as a fraction of the time-out."""
CLOSE_S: Final = 1.0
_CHANNEL_LIFETIME_MS: Final = 3_600_000
_NAMESPACES, _STATE = 2255, 2259
_LIMITS: Final = (11705, 11707, 11712, 11714)
"""Nodes with the server's limits for a request: nodes to read, nodes to write, browse paths, monitored items."""
_HIERARCHICAL: Final = 33
_CLASSES: Final = 1 | 2
"""The node classes Object and Variable, as a mask."""
REFERENCES_AT_ONCE: Final = 500
_ORIGINS_AT_ONCE: Final = 20
_BAD_NO_CONTINUATION_POINTS: Final = 0x804B0000
_RUNNING: Final = 0
STATES: Final = (
    "Running",
    "Failed",
    "NoConfiguration",
    "Suspended",
    "Shutdown",
    "Test",
    "CommunicationFault",
    "Unknown",
)
_AGAIN: Final = frozenset({0x80330000, 0x80340000})  # BadNodeIdInvalid, BadNodeIdUnknown
_UNDECIDED: Final = (GOOD, BAD_WAITING_FOR_INITIAL_DATA)
_FILTERS: Final = frozenset({0x80430000, 0x80440000, 0x80450000, 0x808E0000})
_BAD_TOO_MANY_PUBLISH_REQUESTS: Final = 0x80780000
_BAD_TOO_MANY_ITEMS: Final = 0x80DB0000
_BAD_TIMEOUT: Final = 0x800A0000

log = logging.getLogger("shmio.source")


@dataclass(eq=False)
class Item:
    """A node that the source reads, and its state."""

    index: int
    """Index of the node among the nodes that the layout's registers need. A reload may change the index."""
    handle: int
    """The client's number of the monitored item. No other item gets this number during the connection."""
    address: Address
    deadband: float
    """Dead-band in the node's own numbers, without the register's scale; 0 if there is none."""
    session: int = 0
    """Index of the session that reads the node."""
    node: Any = None
    """The node id; None if the server has not resolved the address yet."""
    code: int = BAD_WAITING_FOR_INITIAL_DATA
    """Status code of the newest sample, or why the node has none."""
    subscription: Subscription | None = None
    monitored: int = 0
    """The server's id of the monitored item."""
    seen: Sample | None = None
    """The newest sample."""
    last: Sample | None = None
    """The newest sample with a value."""
    settles_ns: int = 0
    """Time (ns of CLOCK_MONOTONIC) until which samples from before the last write may arrive; 0: none will arrive."""
    written_ns: int = 0
    """Source time of the value that was read back after the last write."""
    is_structure: bool = False
    """True if the node's registers are members of its value."""
    structures: Structures = field(default_factory=dict)
    """The structures that the node may have as values."""
    unread: bool = False
    """True if the newest value does not fit the known structures."""
    skipped: bool = False
    """True if a sample was skipped because it may be from before the last write."""


@dataclass(eq=False)
class Subscription:
    """A subscription, with the parameters that the server chose."""

    number: int
    publishing_s: float
    silent_s: float
    """The subscription counts as lost after this time in s without a message from the server."""
    alive_ns: int
    sequence: int = 0
    items: list[Item] = field(default_factory=list)


Deliver = Callable[[list[tuple[Item, Sample]]], None]


class Session:
    """A session, from its connection to its end. Use it only in its event loop, except for :meth:`check`."""

    def __init__(
        self, options: OpcUaOptions, credentials: Credentials, items: Sequence[Item], deliver: Deliver
    ) -> None:
        """Create the session without connecting.

        Args:
            options: The source's keys.
            credentials: The certificate or password of the client.
            items: The nodes to read.
            deliver: Called with new samples. The sample of a failed item has no value.

        """
        self._options, self._credentials, self._deliver_to = options, credentials, deliver
        self._items = [*items]
        self._by_handle = {item.handle: item for item in items}
        self._timeout_s = options.timeout / 1000
        self._client: Any = None
        self._protocol: Any = None
        self._newest: _Protocol | None = None
        """The newest connection; it may be the one that only asks for the server's certificate."""
        self._stage = ""
        """Probable reason if the server closes the connection without an error; empty once the session exists."""
        self._subscriptions: dict[int, Subscription] = {}
        self._publishing = 0
        self._wanted = 0
        self._acknowledge: list[Any] = []
        self._tasks: list[asyncio.Task[None]] = []
        self._retrying: asyncio.Task[None] | None = None
        self._per_read = self._per_write = self._per_path = self._per_items = MAX_PER_CALL
        self._answered_ns = time.monotonic_ns()
        self.failure = asyncio.get_running_loop().create_future()
        """Future whose result is the error that ended the session."""
        self.state = _RUNNING
        """The server's state, as an index of ``STATES``."""

    # -- connection ----------------------------------------------------------------------------------------------------

    async def open(self) -> None:
        """Connect, resolve the nodes, and subscribe to them.

        Raises:
            ConnectorError: The server cannot be reached, or refuses the session.

        """
        try:
            await self._open()
        except Exception as error:  # noqa: BLE001  whatever a server does, its session has failed
            raise self.explained(error) from None

    async def _open(self) -> None:
        options = self._options
        policy = await self._policy()
        self._client = client = self._new_client()
        if policy is not None:
            client.security_policy = policy
            client.uaclient.set_security(policy)
            self._stage = f"it may not trust this client's certificate, {options.certificate}"
        if options.username is not None:
            client.set_user(options.username)
            client.set_password(self._credentials.password)
        if self._credentials.user is not None:
            from shmio.connectors.opcua.trust import check_dates  # noqa: PLC0415  not needed without security

            client.user_certificate, client.user_private_key = self._credentials.user
            check_dates(client.user_certificate, f"the user's certificate {options.user_certificate}")
        await client.connect_socket()
        self._protocol = client.uaclient.protocol
        await client.send_hello()
        await client.open_secure_channel()
        await client.create_session()
        try:
            await client.activate_session(client._username, client._password, client.user_certificate)
        except ua.UaStatusCodeError as error:
            raise ConnectorError(_refused_user(error.code, options)) from None
        self._stage = ""
        client.uaclient.pre_request_hook = None
        self._tasks.append(asyncio.create_task(self._renew()))
        await self._ask_limits()
        await self._resolve(self._items)
        await self._learn(self._items)
        if options.mode == "subscribe":
            await self._subscribe([item for item in self._items if item.node is not None])
        self._report_failed(self._items)
        self._answered_ns = time.monotonic_ns()
        self._tasks += [asyncio.create_task(one()) for one in (self._probe, self._watch)]
        self._retrying = asyncio.create_task(self._retry())

    def _new_client(self) -> Any:
        client = Client(self._options.full_url, timeout=self._timeout_s)
        client.name = client.description = "shmio"
        client.application_uri = self._credentials.application_uri
        client.secure_channel_timeout = _CHANNEL_LIFETIME_MS
        client.session_timeout = max(SESSION_TIMEOUT_MS, 10 * self._options.timeout)
        client.max_messagesize = MAX_MESSAGE_BYTES
        low = client.uaclient

        def protocol() -> _Protocol:
            made = _Protocol(
                self._timeout_s, low.security_policy, TransportLimits(MAX_CHUNK_BYTES, MAX_CHUNK_BYTES, 0, 0)
            )
            made.on_connection_lost = self._lost
            self._newest = made
            low.protocol = made
            return made

        low._make_protocol = protocol
        return client

    async def _policy(self) -> Any:
        """Return the security policy with the server's certificate; None for no security."""
        options = self._options
        if options.security == "None" or self._credentials.identity is None or options.trusted is None:
            return None
        from shmio.connectors.opcua.trust import check_server  # noqa: PLC0415  not needed without security

        kind = getattr(security_policies, f"SecurityPolicy{options.policy}")
        mode = getattr(ua.MessageSecurityMode, options.security)
        asking = self._new_client()
        low = asking.uaclient
        try:
            await asking.connect_socket()
            low.protocol.on_connection_lost = None
            await asking.send_hello()
            await asking.open_secure_channel()
            endpoints = await asking.get_endpoints()
        finally:
            if low.protocol is not None and low.protocol.transport is not None:
                low.protocol.transport.abort()
        offered = {(one.SecurityPolicyUri.rpartition("#")[2], one.SecurityMode.name): one for one in endpoints}
        for one in endpoints:
            if one.SecurityPolicyUri == kind.URI and one.SecurityMode == mode and one.ServerCertificate:
                host = urlsplit(options.url).hostname or ""
                certificate = check_server(bytes(one.ServerCertificate), Path(options.trusted), host)
                return kind(certificate, *self._credentials.identity, mode)
        names = ", ".join(sorted({f"{name} with {how}" if name != "None" else "None" for name, how in offered}))
        raise ConnectorError(
            f"the server does not offer policy {options.policy} with security {options.security}; it offers: {names}"
        )

    async def _renew(self) -> None:
        """Renew the secure channel each time before it expires."""
        while True:
            await asyncio.sleep(0.75 * max(1.0, self._client.secure_channel_timeout / 1000))
            try:
                await self._client.open_secure_channel(renew=True)
                self._client.uaclient.revolve_security_token()
            except Exception as error:  # noqa: BLE001  whatever it is, the channel will not last
                self.fail(self.explained(error))
                return

    def _lost(self, error: Exception | None) -> None:
        if (refusal := self._refusal) is not None:
            return self.fail(refusal)
        reason = getattr(self._protocol, "reason", "")
        peer = self._options.peer
        why = getattr(error, "strerror", None) or error or self._stage
        return self.fail(ConnectorError(reason or f"{peer} closed the connection{f': {why}' if why else ''}"))

    @property
    def _refusal(self) -> ConnectorError | None:
        """The error that the server sent when it closed the connection; None if it sent none."""
        code = self._newest.refused if self._newest is not None else 0
        return ConnectorError(_explained_code(code, self._options)) if code else None

    def fail(self, error: ConnectorError) -> None:
        """Mark the session as failed. Only the first error is kept."""
        if not self.failure.done():
            self.failure.set_result(error)

    async def close(self, *, polite: bool) -> None:
        """Close the connection. If ``polite``, first send CloseSession to the server."""
        tasks = [*self._tasks, *([self._retrying] if self._retrying is not None else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._client is None:
            return
        low = self._client.uaclient
        if polite and self._protocol is not None and self._protocol.transport is not None:
            with contextlib.suppress(Exception):
                async with asyncio.timeout(CLOSE_S):
                    await low.session.close_session(True)
                    await low.close_secure_channel()
        if not self.failure.done():
            self.failure.cancel()
        protocol = low.protocol
        if protocol is not None and protocol.transport is not None:
            transport = protocol.transport
            if polite:
                transport.close()
                await asyncio.sleep(0)
            transport.abort()
        await asyncio.sleep(0)

    def explained(self, error: BaseException) -> ConnectorError:
        """Convert any error of this connection to a ConnectorError with a text for the operator."""
        options, peer = self._options, self._options.peer
        reason = getattr(self._protocol, "reason", "")
        if isinstance(error, ConnectorError):
            return ConnectorError(_explained_code(error.code, options)) if isinstance(error, FaultError) else error
        if self.failure.done() and not self.failure.cancelled():
            return self.failure.result()
        if (refusal := self._refusal) is not None:
            return refusal
        if reason:
            return ConnectorError(reason)
        if isinstance(error, TimeoutError):
            return ConnectorError(f"no answer within {options.timeout} ms from {peer}")
        if isinstance(error, ConnectionRefusedError):
            return tcp.refused(peer)
        if isinstance(error, ua.UaStatusCodeError):
            return ConnectorError(_explained_code(error.code, options))
        if isinstance(error, socket.gaierror):
            return tcp.unresolved(options.address.host, error)
        if isinstance(error, OSError):
            closed = f"{peer} closed the connection" + (f": {self._stage}" if self._stage else "")
            return ConnectorError(
                closed if isinstance(error, ConnectionError) else f"{peer} cannot be reached: {error.strerror or error}"
            )
        if isinstance(error, ua.UaError | ValueError | struct.error | TypeError | AttributeError | LookupError):
            return ConnectorError(
                f"{peer} sent data that is not OPC UA, or not the requested answer: {str(error)[:200]}"
            )
        return ConnectorError(f"{peer}: {type(error).__name__}: {str(error)[:200]}")

    # -- requests ------------------------------------------------------------------------------------------------------

    async def _answer(self, request: Any) -> bytes:
        """Send a request; return the body of its answer. Raise TimeoutError if none comes in time."""
        if self._protocol is None:
            raise ConnectionError
        future = self._protocol._send_request(request, self._timeout_s)
        body = await asyncio.wait_for(future, self._timeout_s)
        self._answered_ns = time.monotonic_ns()
        return bytes(body)

    async def _response(self, kind: Any, request: Any) -> Any:
        """Send a request; return its answer, decoded by the library. Raise FaultError if the server refuses it."""
        body = await self._answer(request)
        decode.check_fault(body)  # a fault has another type, without the answer's fields
        return ua_binary.struct_from_binary(kind, Buffer(body))

    async def _samples(self, nodes: Sequence[Any], attribute: Any = ua.AttributeIds.Value) -> list[Sample]:
        """Read the values of nodes, or another attribute, in requests of the size that the server accepts."""
        parts = [nodes[at : at + self._per_read] for at in range(0, len(nodes), self._per_read)]

        async def read(part: Sequence[Any]) -> list[Sample]:
            ids = [ua.ReadValueId(node, attribute) for node in part]
            request = ua.ReadRequest()
            request.Parameters = ua.ReadParameters(0, ua.TimestampsToReturn.Both, ids)
            try:
                found = decode.read_response(await self._answer(request))
            except FaultError as error:
                if not _asked_too_much(error.code) or len(part) < 2:
                    raise
                half = len(part) // 2
                self._per_read = min(self._per_read, half)
                return [*await read(part[:half]), *await read(part[half:])]
            if len(found) != len(part):
                raise MalformedError
            return found

        return [sample for found in await asyncio.gather(*map(read, parts)) for sample in found]

    async def _ask_limits(self) -> None:
        """Read how many nodes the server accepts in a request."""
        found = await self._samples([ua.NodeId(one) for one in _LIMITS])
        limits = [
            min(one.value, MAX_PER_CALL)
            if one.kind == decode.UINT32 and one.dims is None and one.value
            else MAX_PER_CALL
            for one in found
        ]
        self._per_read, self._per_write, self._per_path, self._per_items = limits

    async def _resolve(self, items: Iterable[Item]) -> None:
        """Find the node id for the address of each item."""
        names = await self.namespaces()
        paths: list[tuple[Item, BrowsePath]] = []
        for item in items:
            address = item.address
            if isinstance(address, BrowsePath):
                paths.append((item, address))
            elif isinstance(address.namespace, int):
                item.node = ua.NodeId(address.identifier, address.namespace)
            elif address.namespace in names:
                item.node = ua.NodeId(address.identifier, names.index(address.namespace))
            else:
                item.node, item.code = None, BAD_NODE_ID_UNKNOWN
        for at in range(0, len(paths), self._per_path):
            await self._translate(paths[at : at + self._per_path])

    async def namespaces(self) -> list[str]:
        """Return the URIs of the server's namespaces, by their numbers."""
        (found,) = await self._samples([ua.NodeId(_NAMESPACES)])
        return found.value if found.kind == decode.STRING and found.dims is not None else []

    async def _translate(self, paths: Sequence[tuple[Item, BrowsePath]]) -> None:
        asked = []
        for _, path in paths:
            steps = [
                ua.RelativePathElement(ua.NodeId(33), False, True, ua.QualifiedName(name, space))
                for space, name in path.steps
            ]
            asked.append(ua.BrowsePath(ua.NodeId(84), ua.RelativePath(steps)))
        results = await self._client.uaclient.session.translate_browsepaths_to_nodeids(asked)
        if len(results) != len(paths):
            raise MalformedError
        for (item, _), result in zip(paths, results, strict=True):
            code, targets = result.StatusCode.value, result.Targets or []
            item.node = None
            if code >> 30 or not targets:
                item.code = BAD_NODE_ID_UNKNOWN
            elif targets[0].RemainingPathIndex != 0xFFFF_FFFF:
                item.code = BAD_NODE_ID_UNKNOWN  # the rest of the path is in another server
            else:
                target = targets[0].TargetId
                item.node = ua.NodeId(target.Identifier, target.NamespaceIndex)

    async def _learn(self, items: Iterable[Item]) -> None:
        """Ask the server for the definitions of the structures whose members are registers."""
        wanted = [item for item in items if item.is_structure and item.node is not None]
        if not wanted:
            return
        types = DataTypes(self)
        try:
            await types.learn([item.node for item in wanted])
        except FaultError as error:
            log.warning("the server refuses to define its structures: %s", describe(error.code))
        for item in wanted:
            item.structures = types.structures

    async def read(self, nodes: Sequence[Any], attribute: Any) -> list[Sample]:
        """Read an attribute of each node."""
        return await self._samples(nodes, attribute)

    async def origins(self, nodes: Sequence[Any], reference: Any) -> list[Any]:
        """For each node, return a node that refers to it by ``reference``; None if there is none."""
        found: list[Any] = []
        for at in range(0, len(nodes), _ORIGINS_AT_ONCE):
            part = nodes[at : at + _ORIGINS_AT_ONCE]
            request = ua.BrowseRequest()
            request.Parameters.RequestedMaxReferencesPerNode = 1
            request.Parameters.NodesToBrowse = [
                ua.BrowseDescription(node, ua.BrowseDirection.Inverse, reference, False, 0, 63) for node in part
            ]
            results = (await self._response(ua.BrowseResponse, request)).Results
            if len(results) != len(part):
                raise MalformedError
            found += [one.References[0].NodeId if one.References else None for one in results]
            if points := [one.ContinuationPoint for one in results if one.ContinuationPoint]:
                release = ua.BrowseNextRequest()
                release.Parameters.ReleaseContinuationPoints = True
                release.Parameters.ContinuationPoints = points
                await self._response(ua.BrowseNextResponse, release)
        return found

    async def browse(self, nodes: Sequence[Any], most: int) -> tuple[list[list[Any]], bool]:
        """Return the hierarchical references from nodes to objects and variables. Unknown nodes have none.

        Args:
            nodes: The node ids.
            most: Once there are more references than this, the server is asked for no more.

        Returns:
            The references of each node, and whether some were left out.

        """
        request = ua.BrowseRequest()
        request.Parameters.RequestedMaxReferencesPerNode = REFERENCES_AT_ONCE
        request.Parameters.NodesToBrowse = [
            ua.BrowseDescription(node, ua.BrowseDirection.Forward, ua.NodeId(_HIERARCHICAL), True, _CLASSES, 63)
            for node in nodes
        ]
        results = (await self._response(ua.BrowseResponse, request)).Results
        if len(results) != len(nodes):
            raise MalformedError
        found: list[list[Any]] = [list(one.References or []) for one in results]
        open_points = [(place, one.ContinuationPoint) for place, one in enumerate(results) if one.ContinuationPoint]
        left_out = False
        for place, one in enumerate(results):
            if one.StatusCode.value & 0xFFFF0000 == _BAD_NO_CONTINUATION_POINTS and len(nodes) > 1:
                (found[place],), less = await self.browse([nodes[place]], most)
                left_out = left_out or less
        while open_points:
            following = ua.BrowseNextRequest()
            full = sum(map(len, found)) > most
            following.Parameters.ReleaseContinuationPoints = full
            following.Parameters.ContinuationPoints = [point for _, point in open_points]
            answer = await self._response(ua.BrowseNextResponse, following)
            if full:
                left_out = True
                break
            results = answer.Parameters.Results
            if len(results) != len(open_points):
                raise MalformedError
            before = sum(map(len, found))
            for (place, _), one in zip(open_points, results, strict=True):
                found[place] += one.References or []
            open_points = [
                (place, one.ContinuationPoint)
                for (place, _), one in zip(open_points, results, strict=True)
                if one.ContinuationPoint
            ]
            if open_points and sum(map(len, found)) == before:
                raise MalformedError  # such a server could continue for ever
        return found, left_out

    # -- reading -------------------------------------------------------------------------------------------------------

    async def poll(self) -> None:
        """Read all nodes and deliver their samples."""
        items = [item for item in self._items if item.node is not None]
        self._deliver(list(zip(items, await self._samples([item.node for item in items]), strict=True)))

    async def read_back(self, items: Sequence[Item]) -> None:
        """Read nodes that were just written, and deliver the samples before older ones can arrive."""
        found = await self._samples([item.node for item in items])
        now_ns = time.monotonic_ns()
        for item, sample in zip(items, found, strict=True):
            if item.subscription is not None:
                item.settles_ns, item.written_ns = now_ns + round(self._settle_s(item) * 1e9), sample.source_ns
        self._deliver(list(zip(items, found, strict=True)))

    async def present(self, item: Item) -> Sample:
        """Read the present value of a node."""
        (found,) = await self._samples([item.node])
        return found

    async def has_ranges(self, item: Item, elements: str, dims: tuple[int, ...] | None) -> bool:
        """Return whether the server can read single elements of an array: an array of these dimensions.

        A server that does not know index ranges may ignore them, and replace the whole array.
        """
        request = ua.ReadRequest()
        asked = ua.ReadValueId(item.node, ua.AttributeIds.Value, elements)
        request.Parameters = ua.ReadParameters(0, ua.TimestampsToReturn.Neither, [asked])
        (found,) = decode.read_response(await self._answer(request))
        return found.code >> 30 == 0 and found.dims == dims

    async def write(self, values: Sequence[tuple[Item, str | None, Sample]]) -> list[int]:
        """Write whole values, or elements of arrays; return the status code of each write.

        Each write has an index range, or None for the whole value. There may be at most
        :attr:`per_write` writes, and only one for each node.
        """
        request = ua.WriteRequest()
        for item, elements, sample in values:
            value = ua.DataValue(_variant(sample), StatusCode=None)
            request.Parameters.NodesToWrite.append(ua.WriteValue(item.node, ua.AttributeIds.Value, elements, value))
        answer = await self._response(ua.WriteResponse, request)
        if len(answer.Results) != len(values):
            raise MalformedError
        return [int(code.value) for code in answer.Results]

    @property
    def per_write(self) -> int:
        """Maximum number of values that a request may write."""
        return self._per_write

    @property
    def ready(self) -> bool:
        """True if the connection is open, as far as the client knows."""
        return self._protocol is not None and self._protocol.transport is not None and not self.failure.done()

    @property
    def waiting(self) -> bool:
        """True if a node still waits for its first value."""
        return any(item.code == BAD_WAITING_FOR_INITIAL_DATA for item in self._items)

    @property
    def subscriptions(self) -> int:
        """Number of subscriptions."""
        return len(self._subscriptions)

    def check(self) -> str:
        """Return why the session may be dead; "" if there is no sign of this. Any thread may call this."""
        now_ns = time.monotonic_ns()
        options = self._options
        for one in tuple(self._subscriptions.values()):
            if now_ns - one.alive_ns > one.silent_s * 1e9:
                return f"no answer within {one.silent_s * 1000:.0f} ms from {options.peer}: a subscription is silent"
        # A probe is sent every quarter of a time-out, so that it has three quarters for its answer.
        if now_ns - self._answered_ns > options.timeout * 1_000_000:
            return f"no answer within {options.timeout} ms from {options.peer}"
        return ""

    # -- subscriptions -------------------------------------------------------------------------------------------------

    async def _subscribe(self, items: Sequence[Item]) -> None:
        """Monitor items, in as many subscriptions as the options and the server's limits require."""
        left = deque(items)
        most = self._options.max_items
        while left:
            part = [left.popleft() for _ in range(min(most, len(left)))]
            one = await self._new_subscription()
            await self._fill(one, part)
            if one.items:
                beyond = [item for item in part if item.subscription is None and item.code == _BAD_TOO_MANY_ITEMS]
                if beyond:  # the server takes fewer in a subscription
                    most = len(one.items)
                    left.extendleft(reversed(beyond))
            elif len(self._subscriptions) > 1:
                await self._drop(one)

    async def _drop(self, subscription: Subscription) -> None:
        """Delete a subscription without items. Never delete the last one: publish requests need a subscription."""
        del self._subscriptions[subscription.number]
        request = ua.DeleteSubscriptionsRequest()
        request.Parameters = ua.DeleteSubscriptionsParameters([subscription.number])
        await self._response(ua.DeleteSubscriptionsResponse, request)

    async def _new_subscription(self) -> Subscription:
        options = self._options
        publishing_ms = float(options.publishing_ms)
        count = max(1, int(options.timeout * PROBES / publishing_ms))
        lifetime = max(3 * count, math.ceil(max(10 * options.timeout, SESSION_TIMEOUT_MS) / publishing_ms))
        asked = ua.CreateSubscriptionParameters(publishing_ms, lifetime, count, 0, True, 0)
        request = ua.CreateSubscriptionRequest()
        request.Parameters = asked
        answer = await self._response(ua.CreateSubscriptionResponse, request)
        made = answer.Parameters
        revised_ms = made.RevisedPublishingInterval
        if not 0 < revised_ms < 86_400_000 or not 0 < made.RevisedMaxKeepAliveCount < 1 << 31:
            raise MalformedError
        keep_alive_s = revised_ms * made.RevisedMaxKeepAliveCount / 1000
        if keep_alive_s > self._timeout_s:
            log.warning(
                "the server's keep-alive interval is %.3g s: shmio may need that long to notice a lost subscription",
                keep_alive_s,
            )
        one = Subscription(
            int(made.SubscriptionId),
            revised_ms / 1000,
            keep_alive_s + (1 - PROBES) * self._timeout_s,
            time.monotonic_ns(),
        )
        self._subscriptions[one.number] = one
        self._wanted = min(2 * len(self._subscriptions) + 1, MAX_PUBLISH_REQUESTS)
        self._publish()
        return one

    async def _fill(self, subscription: Subscription, items: Sequence[Item], *, filters: bool = True) -> None:
        """Create monitored items. An item that the server refuses gets the status code of the refusal."""
        unfiltered: list[Item] = []
        at = 0
        while part := items[at : at + self._per_items]:
            request = ua.CreateMonitoredItemsRequest()
            request.Parameters = ua.CreateMonitoredItemsParameters(
                subscription.number, ua.TimestampsToReturn.Both, [self._monitor(item, filters) for item in part]
            )
            for item in part:
                item.subscription = subscription
            try:
                answer = await self._response(ua.CreateMonitoredItemsResponse, request)
            except FaultError as error:
                if not _asked_too_much(error.code) or len(part) < 2:
                    raise
                self._per_items = len(part) // 2
                continue
            at += len(part)
            if len(answer.Results) != len(part):
                raise MalformedError
            for item, result in zip(part, answer.Results, strict=True):
                code = int(result.StatusCode.value)
                if code >> 30 == 0:
                    item.monitored = int(result.MonitoredItemId)
                    if item.code == _BAD_TOO_MANY_ITEMS:  # from another subscription
                        item.code = BAD_WAITING_FOR_INITIAL_DATA
                    subscription.items.append(item)
                elif filters and item.deadband and code & 0xFFFF0000 in _FILTERS:
                    unfiltered.append(item)
                else:
                    item.subscription, item.code = None, code
        if unfiltered:
            await self._fill(subscription, unfiltered, filters=False)

    def _monitor(self, item: Item, filters: bool) -> Any:
        chosen = None
        if filters and item.deadband:
            chosen = ua.DataChangeFilter(ua.DataChangeTrigger.StatusValue, 1, item.deadband)
        wanted = ua.MonitoringParameters(
            item.handle, float(self._options.sampling_ms), chosen, self._options.queue, True
        )
        return ua.MonitoredItemCreateRequest(
            ua.ReadValueId(item.node, ua.AttributeIds.Value), ua.MonitoringMode.Reporting, wanted
        )

    def _publish(self) -> None:
        """Send publish requests until the server holds the wanted number of them."""
        while self._publishing < self._wanted and self.ready:
            request = ua.PublishRequest()
            request.Parameters.SubscriptionAcknowledgements, self._acknowledge = self._acknowledge, []
            future = self._protocol._send_request(request, 0)
            self._publishing += 1
            future.add_done_callback(self._published)

    def _published(self, future: asyncio.Future[Any]) -> None:
        self._publishing -= 1
        lost = not future.cancelled() and future.exception() is not None  # reading it stops a warning of asyncio
        if future.cancelled() or self.failure.done():
            return
        if lost and not self.ready:
            self.fail(self.explained(future.exception() or ConnectionError()))
            return
        try:
            self._take(decode.publish_response(bytes(future.result())))
        except FaultError as error:
            if error.code == _BAD_TOO_MANY_PUBLISH_REQUESTS and self._publishing:
                self._wanted = self._publishing
            elif error.code != _BAD_TIMEOUT:
                self.fail(self.explained(error))
                return
        except Exception as error:  # noqa: BLE001  an error in a message ends only the session
            self.fail(self.explained(error))
            return
        try:
            self._publish()
        except Exception as error:  # noqa: BLE001
            self.fail(self.explained(error))

    def _take(self, found: Publication) -> None:
        one = self._subscriptions.get(found.subscription)
        if one is None:
            return
        one.alive_ns = self._answered_ns = time.monotonic_ns()
        if found.closed:
            raise ConnectorError(f"{self._options.peer} ended a subscription: {describe(found.closed)}")
        if found.keep_alive:
            return
        if one.sequence and found.sequence != one.sequence % 0xFFFF_FFFF + 1:
            raise ConnectorError(f"a message of {self._options.peer} is missing: values may be lost")
        one.sequence = found.sequence
        self._acknowledge.append(ua.SubscriptionAcknowledgement(one.number, found.sequence))
        taken: list[tuple[Item, Sample]] = []
        for handle, sample in found.values:
            item = self._by_handle.get(handle)
            if item is None or item.subscription is not one:
                continue
            if item.settles_ns and self._is_from_before(item, sample):
                item.skipped = True
                continue
            taken.append((item, sample))
        if taken:
            self._deliver(taken)

    def _is_from_before(self, item: Item, sample: Sample) -> bool:
        """Return whether a sample may be older than the item's last write."""
        if time.monotonic_ns() > item.settles_ns:
            return False
        if sample.source_ns and item.written_ns:
            return sample.source_ns < item.written_ns
        return item.last is not None and sample.value != item.last.value

    # -- other nodes ---------------------------------------------------------------------------------------------------

    @property
    def items(self) -> Sequence[Item]:
        """The nodes that the session reads."""
        return self._items

    def switch(self, kept: Sequence[Item], new: Sequence[Item], deliver: Deliver) -> list[Item]:
        """From now on, read the nodes in ``kept``, which the session already reads, and in ``new``, and no others.

        Samples of these nodes go to ``deliver``, and the previous function gets no more samples.
        Call :meth:`follow` next.

        Returns:
            The nodes that the session no longer reads.

        """
        if self._retrying is not None:
            self._retrying.cancel()  # it may be about to subscribe to nodes that are no longer read
        present = self._items
        self._items, self._deliver_to = [*kept, *new], deliver
        self._by_handle = {item.handle: item for item in self._items}
        return [item for item in present if item.handle not in self._by_handle]

    async def follow(self, gone: Sequence[Item], new: Sequence[Item]) -> None:
        """End the subscriptions to nodes that are no longer read; resolve the new nodes and subscribe to them."""
        for one in [*self._subscriptions.values()]:
            await self._unsubscribe(one, [item for item in gone if item.subscription is one])
        await self._resolve(new)
        await self._learn(new)
        if self._options.mode == "subscribe":
            await self._subscribe_into_room([item for item in new if item.node is not None])
            for one in [*self._subscriptions.values()]:
                if not one.items and len(self._subscriptions) > 1:
                    await self._drop(one)
        self._report_failed(new)
        self._retrying = asyncio.create_task(self._retry())

    async def learn_again(self) -> None:
        """Ask the server again for the definitions of all structures, which may have changed."""
        await self._learn(self._items)

    async def _unsubscribe(self, subscription: Subscription, items: Sequence[Item]) -> None:
        """Delete monitored items of a subscription."""
        for at in range(0, len(items), self._per_items):
            part = items[at : at + self._per_items]
            request = ua.DeleteMonitoredItemsRequest()
            request.Parameters = ua.DeleteMonitoredItemsParameters(
                subscription.number, [item.monitored for item in part]
            )
            await self._response(ua.DeleteMonitoredItemsResponse, request)
            for item in part:
                item.subscription = None
        left = {*items}
        subscription.items = [item for item in subscription.items if item not in left]

    def _deliver(self, samples: list[tuple[Item, Sample]]) -> None:
        """Deliver samples, but not those of nodes that are no longer read."""
        if wanted := [one for one in samples if self._by_handle.get(one[0].handle) is one[0]]:
            self._deliver_to(wanted)

    # -- supervision ---------------------------------------------------------------------------------------------------

    async def _probe(self) -> None:
        """Read the server's state at intervals, to notice a dead server and to keep the session alive."""
        while True:
            try:
                (found,) = await self._samples([ua.NodeId(_STATE)])
            except Exception as error:  # noqa: BLE001
                self.fail(self.explained(error))
                return
            if found.kind == decode.INT32 and found.dims is None:
                self.state = found.value
            await asyncio.sleep(min(PROBES * self._timeout_s, max(0.1, self._client.session_timeout / 3000)))

    async def _watch(self) -> None:
        """End the session if the server is silent. Read written nodes again whose samples were skipped.

        A node is read once no sample from before its last write can arrive any more.
        """
        while True:
            await asyncio.sleep(min(0.05, self._timeout_s / 8))
            if reason := self.check():
                self.fail(ConnectorError(reason))
                return
            now_ns = time.monotonic_ns()
            settled = [item for item in self._items if item.settles_ns and now_ns > item.settles_ns]
            again = [item for item in settled if item.skipped]
            for item in settled:
                item.settles_ns, item.skipped = 0, False
            if again:
                try:
                    self._deliver(list(zip(again, await self._samples([item.node for item in again]), strict=True)))
                except Exception as error:  # noqa: BLE001
                    self.fail(self.explained(error))
                    return

    async def _retry(self) -> None:
        """Request nodes again, at intervals, that the server did not know or refused to monitor."""
        while True:
            await asyncio.sleep(RETRY_S)
            subscribes = self._options.mode == "subscribe"
            unknown = [
                item
                for item in self._items
                if item.node is None
                or item.code & 0xFFFF0000 in _AGAIN
                or (subscribes and item.subscription is None)  # the server refused it
            ]
            try:
                dead = await self._find_dead([item for item in self._items if item.subscription is not None])
                if unknown:
                    await self._resolve(unknown)
                again = {*unknown}
                await self._learn_again([item for item in self._items if item.unread or item in again])
                if subscribes:
                    await self._subscribe_again([item for item in (*unknown, *dead) if item.node is not None])
            except Exception as error:  # noqa: BLE001
                self.fail(self.explained(error))
                return

    async def _learn_again(self, items: Sequence[Item]) -> None:
        """Ask again for the definitions of structures, and deliver again the values that did not fit the old ones."""
        await self._learn(items)
        self._deliver([(item, item.seen) for item in items if item.unread and item.seen is not None])

    async def _find_dead(self, items: Sequence[Item]) -> list[Item]:
        """Return the monitored items for which the server has stopped sending changes.

        Some servers send nothing more for a node that was removed, even after it was added again.
        Such an item is found by reading its node: the value differs from the last sample. An item
        whose node does not exist becomes bad.
        """
        items = [item for item in items if item.code & 0xFFFF0000 not in _AGAIN]
        found = await self._samples([item.node for item in items]) if items else []
        removed = [(item, one) for item, one in zip(items, found, strict=True) if one.code & 0xFFFF0000 in _AGAIN]
        self._deliver([(item, Sample(0, None, None, one.code, 0)) for item, one in removed])
        doubtful = [(item, item.seen) for item, one in zip(items, found, strict=True) if _differs(item, one)]
        if not doubtful:
            return []
        await asyncio.sleep(max(self._settle_s(item) for item, _ in doubtful))  # changes may be on their way
        silent = [item for item, seen in doubtful if item.seen is seen and item.subscription is not None]
        again = await self._samples([item.node for item in silent]) if silent else []
        return [item for item, one in zip(silent, again, strict=True) if _differs(item, one)]

    def _settle_s(self, item: Item) -> float:
        """Return the maximum time in s for which a sample may be in flight."""
        publishing_s = item.subscription.publishing_s if item.subscription is not None else 0.0
        return 2 * (publishing_s + max(0, self._options.sampling_ms) / 1000) + 0.2

    async def _subscribe_again(self, items: Sequence[Item]) -> None:
        there = await self._samples([item.node for item in items]) if items else []
        known = [item for item, one in zip(items, there, strict=True) if one.code & 0xFFFF0000 not in _AGAIN]
        for item in known:
            if item.subscription is not None:
                await self._unsubscribe(item.subscription, [item])
            item.code = BAD_WAITING_FOR_INITIAL_DATA
        await self._subscribe_into_room(known)
        self._report_failed(known)

    async def _subscribe_into_room(self, items: Sequence[Item]) -> None:
        """Monitor items in the present subscriptions, as far as these have room, and in new ones."""
        at = 0
        beyond: list[Item] = []
        for one in [*self._subscriptions.values()]:
            room = max(0, self._options.max_items - len(one.items))
            if part := items[at : at + room]:
                await self._fill(one, part)
                beyond += [item for item in part if item.subscription is None and item.code == _BAD_TOO_MANY_ITEMS]
            at += room
        await self._subscribe([*beyond, *items[at:]])

    def _report_failed(self, items: Iterable[Item]) -> None:
        """Deliver the status codes of items that cannot be read, but not of monitored items, which get samples."""
        failed = [item for item in items if item.subscription is None and item.code not in _UNDECIDED]
        if failed:
            self._deliver([(item, Sample(0, None, None, item.code, 0)) for item in failed])


class _Protocol(UASocketProtocol):
    """The client's end of the connection. It limits the size of the server's messages."""

    reason = ""
    """Why this client closed the connection."""
    refused = 0
    """Status code with which the server has closed the connection; 0 if it sent none."""

    def _fail_all_pending(self, exc: BaseException) -> None:
        """Remember the server's error: the library loses one that answers the request for a secure channel."""
        if isinstance(exc, ua.UaStatusCodeError):
            self.refused = self.refused or int(exc.code)
        super()._fail_all_pending(exc)

    def data_received(self, data: bytes) -> None:
        """Process received bytes; close the connection if a message is too large."""
        super().data_received(data)
        left = self.receive_buffer
        too_long = left is not None and len(left) >= 8 and int.from_bytes(left[4:8], "little") > MAX_CHUNK_BYTES + 64
        if (too_long or self._connection._incoming_size > MAX_MESSAGE_BYTES) and self.transport is not None:
            self.reason = "the server sent data that is not OPC UA, or a message that is too large"
            self.transport.abort()


def _differs(item: Item, found: Sample) -> bool:
    """Return whether a value that was read differs from the newest sample, so that a sample is missing."""
    seen = item.seen
    if seen is None or (seen.code ^ found.code) & 0xFFFF0000:
        return True
    if seen.value == found.value or repr(seen.value) == repr(found.value):  # NaN is not equal to itself
        return False
    before, now = (one.value if isinstance(one.value, list) else [one.value] for one in (seen, found))
    if item.deadband and len(before) == len(now) and all(isinstance(one, int | float) for one in (*before, *now)):
        return any(abs(one - other) > item.deadband for one, other in zip(before, now, strict=True))
    return True


def _asked_too_much(code: int) -> bool:
    """Return whether a status code means that the request or its answer was too large."""
    return code & 0xFFFF0000 in (0x80100000, 0x80080000, 0x80B80000, 0x80B90000)


_WRAPPED: Final = {
    ua.VariantType.LocalizedText: ua.LocalizedText,
    ua.VariantType.StatusCode: ua.StatusCode,
    ua.VariantType.Guid: uuid.UUID,
    ua.VariantType.XmlElement: ua.XmlElement,
}
"""The classes of values that the library does not encode as Python's own."""


def check_encoding(sample: Sample) -> None:
    """Raise ValueError if the library cannot encode a value, so that its request is never sent."""
    try:
        ua_binary.variant_to_binary(_variant(sample))
    except Exception as error:
        name = decode.NAMES[sample.kind] if sample.kind < len(decode.NAMES) else f"type {sample.kind}"
        raise ValueError(f"shmio cannot encode the value as a {name}: {str(error)[:200]}") from error


def _variant(sample: Sample) -> Any:
    """Convert a sample to a variant of the library."""
    kind = ua.VariantType(sample.kind)

    def there(value: Any) -> Any:
        if kind in _WRAPPED:
            return _WRAPPED[kind](value)
        if kind == ua.VariantType.DateTime:
            return ua.datetime.fromtimestamp(0, ua.timezone.utc) + ua.timedelta(microseconds=value // 1000)
        if isinstance(value, decode.Extension):
            return ua.ExtensionObject(ua_binary.nodeid_from_binary(Buffer(value.encoding)), value.body)
        return value

    if sample.dims is None:
        return ua.Variant(there(sample.value), kind)
    flat = [there(one) for one in _flat(sample.value)]
    return ua.Variant(flat, kind, list(sample.dims) if len(sample.dims) > 1 else None, is_array=True)


def _flat(values: list[Any]) -> list[Any]:
    return [inner for one in values for inner in (_flat(one) if isinstance(one, list) else [one])]


def _refused_user(code: int, options: OpcUaOptions) -> str:
    if options.user_certificate is not None:
        return (
            f"the server refuses the user's certificate ({describe(code)}); let the server trust "
            f"{options.user_certificate}, and admit users with certificates"
        )
    if options.username is None:
        return (
            f"the server does not admit clients without a user ({describe(code)}); set username and password_file, or "
            "user_certificate and user_key"
        )
    return f"the server refuses the user {options.username!r} ({describe(code)}); check username and password_file"


def _explained_code(code: int, options: OpcUaOptions) -> str:
    name = describe(code)
    if (0x80120000 <= code < 0x801F0000 or code & 0xFFFF0000 == 0x810D0000) and options.security != "None":
        return f"the server refuses this client's certificate ({name}); let the server trust {options.certificate}"
    if code & 0xFFFF0000 in (0x80560000, 0x80770000, 0x80DB0000):  # sessions, subscriptions, monitored items
        return f"the server has no free resources ({name}); close other clients, or read less"
    if code & 0xFFFF0000 in (0x80540000, 0x80550000):
        return f"the server refuses security {options.security} ({name}); set security and policy to what it offers"
    return f"the server refuses the request: {name}"


def bound_decoding() -> None:
    """Make the library refuse arrays of nulls, because a short message can claim to have any number of nulls."""
    original = ua_binary.unpack_uatype_array

    def unpack(vtype: Any, data: Any) -> Any:
        if vtype == ua.VariantType.Null:
            raise MalformedError
        return original(vtype, data)

    ua_binary.unpack_uatype_array = unpack


bound_decoding()
