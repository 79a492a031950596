"""A client's session: checks the client's roles and the limits, and serves its requests."""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Callable, Iterable
from itertools import islice
from typing import Any, Final

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.server.internal_session import InternalSession

from shmio.audit import trail
from shmio.audit.trail import Actor
from shmio.endpoints.opcua.access import User
from shmio.endpoints.opcua.nodes import Method, RegisterNode, bad
from shmio.endpoints.opcua.subscriptions import Subscription
from shmio.endpoints.opcua.values import data_type
from shmio.errors import CommandError, ShmioError, ValueRangeError
from shmio.layout.model import Register
from shmio.layout.topic import shorten
from shmio.segment import DONE, EventKind

MAX_NODES: Final = 10_000
"""Maximum number of nodes, items or paths in a request. The server's OperationLimits contain this number."""
MAX_WRITES: Final = 1_000
MAX_CALLS: Final = 10
MAX_RESPONSE_BYTES: Final = 8 << 20
"""Approximate maximum size of the values in a response to Read."""
MAX_REFERENCES: Final = 20_000
"""Maximum number of references in a response to Browse. BrowseNext returns further ones."""
MAX_CONTINUATIONS: Final = 20
"""Maximum number of continuation points of a session."""
TURN: Final = 500
"""Number of nodes after which a request lets other tasks run."""

_OUTCOMES: Final = {
    EventKind.REJECTED: ua.StatusCodes.BadRequestNotAllowed,
    EventKind.REFUSED: ua.StatusCodes.BadDeviceFailure,
    EventKind.EXPIRED: ua.StatusCodes.BadNoCommunication,
    EventKind.UNKNOWN: ua.StatusCodes.BadTimeout,
}
"""The status code of a failed write, by the command's outcome."""

_ACTIONS: Final = {"LiftAll": "lift"}
"""The action of a method in the audit log, where it is not the method's name in lower case."""

log = logging.getLogger("shmio.opcua")

Fault = ua.StatusCodes


class Session(InternalSession):
    """A client's session, with the services that the client may use. Use it only in the event loop's thread."""

    iserver: Any  # InternalServer of the module server, which imports this one
    user: Any

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        if self.external:  # asyncua numbers tokens, so a client could guess those of other clients
            self.iserver.unregister_external_session(self)
            self.auth_token = ua.NodeId(secrets.token_bytes(32), 0, ua.NodeIdType.ByteString)
            self.iserver.register_external_session(self)
        self.trusted_channel = False
        """True if the client may send its password in plain text: the channel is encrypted, or stays on this host."""
        self._continuations: dict[bytes, Any] = {}

    @property
    def roles(self) -> frozenset[str]:
        """Roles of the client."""
        return self.user.roles if isinstance(self.user, User) else frozenset()

    @property
    def actor(self) -> Actor:
        """The client's identity for the audit log."""
        host, port, *_ = self.name if isinstance(self.name, tuple) else (str(self.name), 0)
        origin = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        if not isinstance(self.user, User) or self.user.kind == "anonymous":
            return Actor("anonymous", "", origin)
        return Actor(self.user.kind, self.user.name, origin)

    def need(self, role: str, action: str = "read", what: trail.What | None = None) -> None:
        """Check that the client has a role. Refusals are recorded in the audit log.

        Args:
            role: The role.
            action: The action that needs the role, for the audit log.
            what: What the action is about, for the audit log; None for nothing.

        Raises:
            ServiceError: The client lacks the role.
        """
        if role not in self.roles:
            self.iserver.counters.refused += 1
            reason = f"it needs the role {role}"
            trail.record(action, what or {}, "denied", reason, who=trail.Acting(self.actor, "opcua"))
            raise ServiceError(Fault.BadUserAccessDenied)

    def activate_session(
        self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None
    ) -> ua.ActivateSessionResult:
        """Identify the client. To take over an existing session, a client must be the same user."""
        before = self.user if self.is_activated() else None
        shown = getattr(params.UserIdentityToken, "UserName", None) or ""
        try:
            result = super().activate_session(params, peer_certificate)
            if before is not None and before.name != self.user.name:
                self.user = before
                raise ServiceError(Fault.BadIdentityTokenRejected)
        except ServiceError as error:
            actor = self.actor._replace(kind="account" if shown else "anonymous", name=str(shown))
            name = ua.StatusCode(error.code).name
            trail.record("sign in", {}, "denied", name, who=trail.Acting(actor, "opcua"))
            raise
        if before is None:
            trail.record("sign in", {}, "done", who=trail.Acting(self.actor, "opcua"))
        return result

    async def close_session(self, delete_subs: bool = True) -> None:  # noqa: ARG002  the subscriptions always end
        """End the session and its subscriptions. No other session can take over the subscriptions."""
        self._continuations.clear()
        if self.external:
            self.iserver.subscriptions.delete(self.iserver.subscriptions.of(self))
        await super().close_session(delete_subs=False)

    # ---- reading -----------------------------------------------------------------------------------------------------

    async def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Return attributes of nodes."""
        if not self.external:
            return await super().read(params)
        self.need("read")
        _bound(params.NodesToRead, MAX_NODES)
        if not params.MaxAge >= 0:
            raise ServiceError(Fault.BadMaxAgeInvalid)
        self.iserver.catch_up()
        found, size = [], 0
        for number, asked in enumerate(params.NodesToRead):
            if number % TURN == TURN - 1:
                await asyncio.sleep(0)
            value = self._read(asked)
            size += _size(value)
            if size > MAX_RESPONSE_BYTES:
                raise ServiceError(Fault.BadResponseTooLarge)
            found.append(value)
        return found

    def _read(self, asked: ua.ReadValueId) -> ua.DataValue:
        value = self.iserver.space.read(asked.NodeId, asked.AttributeId, self.roles)
        if asked.DataEncoding is not None and asked.DataEncoding.Name not in (None, "", "Default Binary"):
            return bad(Fault.BadDataEncodingUnsupported)
        return _part(value, asked.IndexRange) if asked.IndexRange else value

    async def browse(self, params: ua.BrowseParameters) -> list[ua.BrowseResult]:
        """Return the references from nodes."""
        if not self.external:
            return await super().browse(params)
        self.need("read")
        _bound(params.NodesToBrowse, MAX_NODES)
        room, results = MAX_REFERENCES, []
        for number, asked in enumerate(params.NodesToBrowse):
            if number % TURN == TURN - 1:
                await asyncio.sleep(0)
            references = self.iserver.space.browse(asked)
            if references is None:
                results.append(ua.BrowseResult(ua.StatusCode(Fault.BadNodeIdUnknown)))
                continue
            most = min(params.RequestedMaxReferencesPerNode or MAX_REFERENCES, MAX_REFERENCES)
            result = self._portion(references, most, room)
            room -= len(result.References)
            results.append(result)
        return results

    def browse_more(self, params: ua.BrowseNextParameters) -> list[ua.BrowseResult]:
        """Return further references. If the client releases the continuation points, discard them instead."""
        self.need("read")
        _bound(params.ContinuationPoints, MAX_NODES)
        room, results = MAX_REFERENCES, []
        for point in params.ContinuationPoints:
            found = self._continuations.pop(point or b"", None)
            if found is None:
                results.append(ua.BrowseResult(ua.StatusCode(Fault.BadContinuationPointInvalid)))
            elif params.ReleaseContinuationPoints:
                results.append(ua.BrowseResult(ua.StatusCode()))
            else:
                results.append(self._portion(found[0], found[1], room))
                room -= len(results[-1].References)
        return results

    def _portion(self, references: Any, most: int, room: int) -> ua.BrowseResult:
        """Return as many references as fit. A continuation point holds the rest."""
        found = list(islice(references, min(most, room)))
        result = ua.BrowseResult(ua.StatusCode(), None, found)
        following = next(references, None)
        if following is None:
            return result
        if len(self._continuations) >= MAX_CONTINUATIONS:
            return ua.BrowseResult(ua.StatusCode(Fault.BadNoContinuationPoints))
        result.ContinuationPoint = secrets.token_bytes(8)
        self._continuations[result.ContinuationPoint] = _joined(following, references), most
        return result

    async def translate_browsepaths_to_nodeids(self, params: list[ua.BrowsePath]) -> list[ua.BrowsePathResult]:
        """Return the nodes at the end of each path of browse names."""
        if not self.external:
            return await super().translate_browsepaths_to_nodeids(params)
        self.need("read")
        _bound(params, MAX_NODES)
        results = []
        for number, path in enumerate(params):
            if number % TURN == TURN - 1:
                await asyncio.sleep(0)
            result = ua.BrowsePathResult()
            try:
                found = self.iserver.space.follow(path.StartingNode, path.RelativePath.Elements)
                if not found:
                    raise ServiceError(Fault.BadNoMatch)
                result.Targets = [ua.BrowsePathTarget(node, ua.Index(0xFFFFFFFF)) for node in found]
            except ServiceError as error:
                result.StatusCode = ua.StatusCode(error.code)
            results.append(result)
        return results

    # ---- writing and calling -----------------------------------------------------------------------------------------

    async def write(self, params: ua.WriteParameters) -> list[ua.StatusCode]:
        """Write registers. Each write is a command to its source, and its status is the command's outcome."""
        if not self.external:
            return await super().write(params)
        self.need("write", "write", _first_values(params.NodesToWrite))
        _bound(params.NodesToWrite, MAX_WRITES)
        with trail.acting(self.actor, "opcua"):
            codes = await asyncio.gather(*(self._write(asked) for asked in params.NodesToWrite))
        counters = self.iserver.counters
        counters.writes += len(codes)
        counters.refused += sum(code != Fault.Good for code in codes)
        return [ua.StatusCode(code) for code in codes]

    async def _write(self, asked: ua.WriteValue) -> int:
        """Write one register, and return its status."""
        node = self.iserver.space.find(asked.NodeId)
        path = f"{node.feed.block.source}/{node.register.path}" if isinstance(node, RegisterNode) else str(asked.NodeId)
        with trail.Attempt("write", {path: _value(asked)}) as attempt:
            code = await self._carry_out(asked, attempt)
            attempt.end("refused", ua.StatusCode(code).name)  # no effect if the command has ended the attempt
        return code

    async def _carry_out(self, asked: ua.WriteValue, attempt: trail.Attempt) -> int:
        node = self.iserver.space.find(asked.NodeId)
        if node is None:
            return Fault.BadNotWritable if self.iserver.space.knows(asked.NodeId) else Fault.BadNodeIdUnknown
        if asked.AttributeId != ua.AttributeIds.Value or not isinstance(node, RegisterNode) or not node.writable:
            return Fault.BadNotWritable
        if asked.IndexRange:
            return Fault.BadWriteNotSupported  # elements have nodes of their own
        status = asked.Value.StatusCode
        if status is not None and status.value != Fault.Good:
            return Fault.BadWriteNotSupported
        value = _plain(asked.Value.Value, node.register)
        if value is None:
            return Fault.BadTypeMismatch
        try:
            kind, reason = await node.feed.commands.write(node.register, value, attempt)
        except ValueRangeError as error:
            log.info("a client's value was not written: %s", shorten(str(error)))
            attempt.end("refused", str(error))
            return Fault.BadOutOfRange
        except CommandError as error:
            log.warning("a client's value was not written: %s", shorten(str(error)))
            attempt.end("refused", str(error))
            return Fault.BadResourceUnavailable
        if kind in DONE:
            return Fault.Good
        path = f"{node.feed.block.source}/{node.register.path}"
        log.warning("the write to %s was not carried out: %s: %s", shorten(path, 400), kind, reason)
        return _OUTCOMES.get(kind, Fault.BadUnexpectedError)

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Call methods."""
        _bound(params, MAX_CALLS)
        with trail.acting(self.actor, "opcua"):
            return [await self._call(asked) for asked in params]

    async def _call(self, asked: ua.CallMethodRequest) -> ua.CallMethodResult:
        result = ua.CallMethodResult()
        try:
            if not self.iserver.space.knows(asked.ObjectId):
                raise ServiceError(Fault.BadNodeIdUnknown)
            method = self.iserver.space.find(asked.MethodId)
            if not isinstance(method, Method) or method.parent is None or method.parent.id != asked.ObjectId:
                raise ServiceError(Fault.BadMethodInvalid)
            action = _ACTIONS.get(method.name, method.name.lower())
            self.need(method.role, action)
            given = asked.InputArguments or []
            if len(given) < len(method.inputs):
                raise ServiceError(Fault.BadArgumentsMissing)
            if len(given) > len(method.inputs):
                raise ServiceError(Fault.BadTooManyArguments)
            for one, argument in zip(given, method.inputs, strict=True):
                right = one.VariantType.value == argument.DataType.Identifier and not one.is_array
                result.InputArgumentResults.append(ua.StatusCode(Fault.Good if right else Fault.BadTypeMismatch))
            if any(not one.is_good() for one in result.InputArgumentResults):
                raise ServiceError(Fault.BadInvalidArgument)
            arguments = {one.Name: shown.Value for one, shown in zip(method.inputs, given, strict=True)}
            with trail.Attempt(action, arguments) as attempt:
                result.OutputArguments = await method.call(*(one.Value for one in given))
                if method.role == "control":  # the commands that other methods send have entries of their own
                    attempt.end("done")
        except ServiceError as error:
            result.StatusCode = ua.StatusCode(error.code)
        except ShmioError as error:
            log.warning("a client's call failed: %s", shorten(str(error), 400))
            result.StatusCode = ua.StatusCode(Fault.BadInvalidState)
        return result

    # ---- subscriptions -----------------------------------------------------------------------------------------------

    async def create_subscription(
        self,
        params: ua.CreateSubscriptionParameters,
        callback: Callable[..., Any],
        request_callback: Callable[..., Any] | None = None,
    ) -> ua.CreateSubscriptionResult:
        """Create a subscription."""
        self.need("read")
        found = self.iserver.subscriptions.create(self, params)
        self.attach(found, callback, request_callback)
        found.start()
        return ua.CreateSubscriptionResult(found.id, found.interval_ms, found.lifetime, found.keep_alive)

    def attach(self, found: Subscription, callback: Any, request_callback: Any) -> None:
        """Make a subscription publish through this session's connection.

        Args:
            found: The subscription.
            callback: Sends a publication.
            request_callback: Returns a waiting Publish request.
        """
        found.pub_result_callback, found.pub_request_callback = callback, request_callback
        found.can_send = callback.__self__.can_send

    def sent(self, result: ua.PublishResult, request: Any, subscription: Subscription) -> None:
        """Send a publication of a subscription, as the answer to a Publish request."""
        subscription.pub_result_callback.__self__.publish(result, request)

    def modify_subscription(self, params: ua.ModifySubscriptionParameters) -> ua.ModifySubscriptionResult:
        """Change the interval and the limits of a subscription."""
        found = self.iserver.subscriptions.find(params.SubscriptionId, self)
        found.revise(params)
        return ua.ModifySubscriptionResult(found.interval_ms, found.lifetime, found.keep_alive)

    async def set_publishing_mode(self, params: ua.SetPublishingModeParameters) -> list[ua.StatusCode]:
        """Switch the publishing of subscriptions on or off."""
        _bound(params.SubscriptionIds, MAX_NODES)

        def switch(number: int) -> None:
            self.iserver.subscriptions.find(number, self).enabled = bool(params.PublishingEnabled)

        return [_status(switch, number) for number in params.SubscriptionIds]

    async def delete_subscriptions(self, ids: list[int]) -> list[ua.StatusCode]:
        """End subscriptions."""
        if not self.external:
            return await super().delete_subscriptions(ids)
        _bound(ids, MAX_NODES)
        own = self.iserver.subscriptions
        return [_status(lambda number: own.delete([own.find(number, self)]), number) for number in ids]

    async def transfer_subscriptions(
        self,
        params: ua.TransferSubscriptionsParameters,
        callback: Callable[..., Any],  # noqa: ARG002
    ) -> list[ua.TransferResult]:
        """Refuse the transfer, because no session may take over the subscriptions of another session."""
        _bound(params.SubscriptionIds, MAX_NODES)
        return [ua.TransferResult(ua.StatusCode(Fault.BadSubscriptionIdInvalid)) for _ in params.SubscriptionIds]

    def publish(self, acks: Iterable[ua.SubscriptionAcknowledgement] | None = None) -> tuple[int, list[ua.StatusCode]]:
        """Process a Publish request's acknowledgements.

        Returns:
            The number of subscriptions of the session, and the status of each acknowledgement.

        Raises:
            ServiceError: The session has no subscription.
        """
        own = self.iserver.subscriptions
        mine = own.of(self)
        if not mine:
            raise ServiceError(Fault.BadNoSubscription)
        for one in mine:
            one.reset_lifetime()
        results = []
        for ack in acks or ():
            try:
                results.append(ua.StatusCode(own.find(ack.SubscriptionId, self).acknowledge(ack.SequenceNumber)))
            except ServiceError as error:
                results.append(ua.StatusCode(error.code))
        return len(mine), results

    def republish(self, params: ua.RepublishParameters) -> ua.NotificationMessage:
        """Return an unacknowledged message, so that it is sent again."""
        return self.iserver.subscriptions.find(params.SubscriptionId, self).republish(params.RetransmitSequenceNumber)

    async def create_monitored_items(self, params: ua.CreateMonitoredItemsParameters) -> list[Any]:
        """Start to monitor variables."""
        self.need("read")
        _bound(params.ItemsToCreate, MAX_NODES)
        self.iserver.catch_up()
        found = self.iserver.subscriptions.find(params.SubscriptionId, self)
        room, results = self.iserver.subscriptions.room(self), list[Any]()
        for number, asked in enumerate(params.ItemsToCreate):
            if number % TURN == TURN - 1:
                await asyncio.sleep(0)
            try:
                if room <= 0:
                    raise ServiceError(Fault.BadTooManyMonitoredItems)
                target = asked.ItemToMonitor
                if target.AttributeId == ua.AttributeIds.EventNotifier:
                    raise ServiceError(Fault.BadServiceUnsupported)  # there are no events
                if target.IndexRange:
                    raise ServiceError(Fault.BadIndexRangeInvalid)  # elements have nodes of their own
                watch, fastest_ms = self.iserver.space.watch(target.NodeId, target.AttributeId, self.roles)
                results.append(found.add(watch, asked, fastest_ms))
                room -= 1
            except ServiceError as error:
                results.append(ua.MonitoredItemCreateResult(ua.StatusCode(error.code)))
        return results

    async def modify_monitored_items(self, params: ua.ModifyMonitoredItemsParameters) -> list[Any]:
        """Change the parameters of monitored items."""
        _bound(params.ItemsToModify, MAX_NODES)
        found = self.iserver.subscriptions.find(params.SubscriptionId, self)
        results = list[Any]()
        for asked in params.ItemsToModify:
            try:
                results.append(found.modify(asked, 0.0))
            except ServiceError as error:
                results.append(ua.MonitoredItemModifyResult(ua.StatusCode(error.code)))
        return results

    async def set_monitoring_mode(self, params: ua.SetMonitoringModeParameters) -> list[ua.StatusCode]:
        """Change the monitoring mode of items."""
        _bound(params.MonitoredItemIds, MAX_NODES)
        found = self.iserver.subscriptions.find(params.SubscriptionId, self)
        mode = ua.MonitoringMode(params.MonitoringMode)
        return [_status(lambda number: found.set_mode(number, mode), number) for number in params.MonitoredItemIds]

    async def delete_monitored_items(self, params: ua.DeleteMonitoredItemsParameters) -> list[ua.StatusCode]:
        """Stop monitoring variables."""
        _bound(params.MonitoredItemIds, MAX_ITEMS_PER_REQUEST)
        found = self.iserver.subscriptions.find(params.SubscriptionId, self)
        return [_status(found.remove, number) for number in params.MonitoredItemIds]


MAX_ITEMS_PER_REQUEST: Final = 50_000
"""Maximum number of items that one request may delete. It is the number that a session can have."""


def _value(asked: ua.WriteValue) -> Any:
    return None if asked.Value is None or asked.Value.Value is None else asked.Value.Value.Value


def _first_values(asked: Iterable[ua.WriteValue] | None) -> dict[str, Any]:
    """Return the first values of a request by node, for the audit log."""
    return {str(one.NodeId.Identifier): _value(one) for one in islice(asked or (), trail.MAX_NAMED)}


def _bound(asked: list[Any] | None, most: int) -> None:
    """Raise ServiceError if a request has no items, or too many."""
    if not asked:
        raise ServiceError(Fault.BadNothingToDo)
    if len(asked) > most:
        raise ServiceError(Fault.BadTooManyOperations)


def _status(do: Callable[[int], object], number: int) -> ua.StatusCode:
    try:
        do(number)
    except ServiceError as error:
        return ua.StatusCode(error.code)
    return ua.StatusCode()


def _joined(first: Any, rest: Any) -> Any:
    yield first
    yield from rest


def _size(value: ua.DataValue) -> int:
    """Return the approximate size of a value in bytes."""
    content = None if value.Value is None else value.Value.Value
    if not isinstance(content, list | str | bytes):
        return 32
    return 32 + _length(content, 1 if value.Value.VariantType in _BYTES else 8)


_BYTES: Final = (ua.VariantType.Boolean, ua.VariantType.Byte, ua.VariantType.SByte)


def _length(content: Any, element: int) -> int:
    if isinstance(content, list):
        nested = content and isinstance(content[0], list | str | bytes)
        return sum(_length(one, element) for one in content) if nested else element * len(content)
    return 4 + len(content) * (4 if isinstance(content, str) else 1)


def _plain(given: ua.Variant | None, register: Register) -> Any:
    """Return the value of a variant, or None if its type does not fit the register."""
    if given is None or given.Value is None:
        return None
    if register.dims and given.VariantType == ua.VariantType.ByteString and data_type(register) == ua.VariantType.Byte:
        return list(given.Value)
    if given.VariantType != data_type(register) or bool(given.is_array) != bool(register.dims):
        return None
    return given.Value


def _part(value: ua.DataValue, text: str) -> ua.DataValue:
    """Return the part of a one-dimensional array that ``2`` or ``2:5`` selects (OPC 10000-4, section 7.27)."""
    first, colon, last = text.partition(":")
    if not (first.isdecimal() and (last.isdecimal() if colon else True)) or len(text) > 20:
        return bad(Fault.BadIndexRangeInvalid)
    low, high = int(first), int(last if colon else first)
    if colon and low >= high:
        return bad(Fault.BadIndexRangeInvalid)
    if value.Value is None:
        return value
    content = value.Value.Value
    whole = isinstance(content, list) and not value.Value.Dimensions
    if not whole or low >= len(content):
        return bad(Fault.BadIndexRangeNoData)
    found = ua.Variant(content[low : high + 1], value.Value.VariantType, is_array=True)
    return ua.DataValue(found, value.StatusCode, value.SourceTimestamp, value.ServerTimestamp)
