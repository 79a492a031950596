"""A client's session: checks the client's roles and the limits, and serves its requests."""

from __future__ import annotations

import asyncio
import logging
import secrets
import struct
from collections.abc import Callable, Iterable, Mapping
from itertools import islice
from typing import Any, Final

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.server.internal_session import InternalSession
from asyncua.ua.ua_binary import Primitives, nodeid_to_binary, struct_to_binary

from shmio.audit import trail
from shmio.audit.trail import Actor
from shmio.endpoints.opcua.access import User
from shmio.endpoints.opcua.nodes import Method, RegisterNode, bad
from shmio.endpoints.opcua.parts import plain, registers_of_part
from shmio.endpoints.opcua.subscriptions import Subscription
from shmio.endpoints.shares import Share
from shmio.errors import CommandError, ShmioError, ValueRangeError
from shmio.layout.model import Register
from shmio.layout.topic import shorten
from shmio.model.opcua_parts import read_part
from shmio.segment import DONE, EventKind

MAX_RESPONSE_BYTES: Final = 8 << 20
"""Approximate maximum size of the values in a response to Read."""
MAX_REFERENCES: Final = 20_000
"""Maximum number of references in a response to Browse. BrowseNext returns further ones."""
MAX_CONTINUATIONS: Final = 20
"""Maximum number of continuation points of a session."""

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
    share: Share
    """The client's share of the endpoint's time."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        if self.external:  # asyncua numbers tokens, so a client could guess those of other clients
            self.iserver.unregister_external_session(self)
            self.auth_token = ua.NodeId(secrets.token_bytes(32), 0, ua.NodeIdType.ByteString)
            self.iserver.register_external_session(self)
        self.trusted_channel = False
        """True if the client may send its password in plain text: the channel is encrypted, or stays on this host."""
        self.detached = False
        """True if the session has lost its connection."""
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

    async def serve_read(self, params: ua.ReadParameters) -> list[bytes]:
        """Return attributes of nodes."""
        self.need("read")
        _check_not_empty(params.NodesToRead)
        if not params.MaxAge >= 0:
            raise ServiceError(Fault.BadMaxAgeInvalid)
        if params.TimestampsToReturn not in _TIMESTAMPS:
            raise ServiceError(Fault.BadTimestampsToReturnInvalid)
        self.iserver.catch_up()
        found, size = [], 0
        for asked in params.NodesToRead:
            value = self._read(asked)
            size += len(value)
            if size > MAX_RESPONSE_BYTES:
                raise ServiceError(Fault.BadResponseTooLarge)
            found.append(value)
            await self.share.turn()
        return found

    def _read(self, asked: ua.ReadValueId) -> bytes:
        node = self.iserver.space.find(asked.NodeId)
        if asked.DataEncoding is not None and asked.DataEncoding.Name not in (None, "", "Default Binary"):
            return struct_to_binary(bad(Fault.BadDataEncodingUnsupported))
        if asked.IndexRange:
            value = self.iserver.space.read(asked.NodeId, asked.AttributeId, self.roles)
            return struct_to_binary(read_part(value, asked.IndexRange))
        if isinstance(node, RegisterNode) and asked.AttributeId == ua.AttributeIds.Value:
            return node.encoded()
        value = self.iserver.space.read(asked.NodeId, asked.AttributeId, self.roles)
        try:
            return struct_to_binary(value)
        except (ua.UaError, ValueError) as error:
            log.warning("an attribute of %s cannot be sent: %s", asked.NodeId, error)
            return struct_to_binary(bad(Fault.BadEncodingError))

    async def serve_browse(self, params: ua.BrowseParameters) -> list[bytes]:
        """Return the references from nodes."""
        self.need("read")
        _check_not_empty(params.NodesToBrowse)
        room, results = MAX_REFERENCES, []
        most = min(params.RequestedMaxReferencesPerNode or MAX_REFERENCES, MAX_REFERENCES)
        for asked in params.NodesToBrowse:
            if asked.BrowseDirection not in _DIRECTIONS:
                results.append(_no_references(Fault.BadBrowseDirectionInvalid))
            elif (references := self.iserver.space.browse(asked)) is None:
                results.append(_no_references(Fault.BadNodeIdUnknown))
            else:
                result, taken = await self._portion(references, most, room)
                room -= taken
                results.append(result)
            await self.share.turn()
        return results

    async def serve_browse_next(self, params: ua.BrowseNextParameters) -> list[bytes]:
        """Return further references. If the client releases the continuation points, discard them instead."""
        self.need("read")
        _check_not_empty(params.ContinuationPoints)
        room, results = MAX_REFERENCES, []
        for point in params.ContinuationPoints:
            found = self._continuations.pop(point or b"", None)
            if found is None:
                results.append(_no_references(Fault.BadContinuationPointInvalid))
            elif params.ReleaseContinuationPoints:
                results.append(_no_references(Fault.Good))
            else:
                result, taken = await self._portion(found[0], found[1], room)
                room -= taken
                results.append(result)
            await self.share.turn()
        return results

    async def _portion(self, references: Any, most: int, room: int) -> tuple[bytes, int]:
        """Return as many references as fit, and their number. A continuation point holds the rest."""
        found: list[bytes] = []
        most_now, following = min(most, room), None
        for reference in references:
            if reference is not None and len(found) >= most_now:
                following = reference
                break
            if reference is not None:  # None: one that the client does not want
                found.append(struct_to_binary(reference))
            await self.share.turn()
        point = None
        if following is not None:
            if len(self._continuations) >= MAX_CONTINUATIONS:
                return _no_references(Fault.BadNoContinuationPoints), 0
            point = secrets.token_bytes(8)
            self._continuations[point] = _joined(following, references), most
        head = struct_to_binary(ua.StatusCode()) + Primitives.ByteString.pack(point)
        return b"".join((head, Primitives.Int32.pack(len(found)), *found)), len(found)

    async def serve_paths(self, params: ua.TranslateBrowsePathsToNodeIdsParameters) -> list[bytes]:
        """Return the nodes at the end of each path of browse names."""
        self.need("read")
        _check_not_empty(params.BrowsePaths)
        results = []
        for path in params.BrowsePaths:
            result = ua.BrowsePathResult()
            try:
                found = await self.iserver.space.follow(path.StartingNode, path.RelativePath.Elements, self.share)
                if not found:
                    raise ServiceError(Fault.BadNoMatch)
                result.Targets = [ua.BrowsePathTarget(node, ua.Index(0xFFFFFFFF)) for node in found]
            except ServiceError as error:
                result.StatusCode = ua.StatusCode(error.code)
            results.append(struct_to_binary(result))
            await self.share.turn()
        return results

    async def serve_register(self, params: ua.RegisterNodesParameters) -> list[bytes]:
        """Return the same node ids, since registration makes nothing faster here."""
        self.need("read")
        _check_not_empty(params.NodesToRegister)
        return [nodeid_to_binary(one) for one in params.NodesToRegister]

    async def serve_unregister(self, params: ua.UnregisterNodesParameters) -> list[bytes]:
        """Do nothing, since registration has done nothing."""
        self.need("read")
        _check_not_empty(params.NodesToUnregister)
        return []

    # ---- writing and calling -----------------------------------------------------------------------------------------

    async def serve_write(self, params: ua.WriteParameters) -> list[bytes]:
        """Write registers. Each write is a command to its source, and its status is the command's outcome."""
        self.need("write", "write", _first_values(params.NodesToWrite))
        _check_not_empty(params.NodesToWrite)
        with trail.acting(self.actor, "opcua"):
            codes = await asyncio.gather(*(self._write(asked) for asked in params.NodesToWrite))
        counters = self.iserver.counters
        counters.writes += len(codes)
        counters.refused += sum(code != Fault.Good for code in codes)
        return [_STATUS.pack(code) for code in codes]

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
        if asked.AttributeId != ua.AttributeIds.Value or not isinstance(node, RegisterNode):
            return Fault.BadNotWritable
        status = asked.Value.StatusCode
        if status is not None and status.value != Fault.Good:
            return Fault.BadWriteNotSupported
        given: Mapping[Register, Any]
        if asked.IndexRange:
            try:
                given = registers_of_part(node, asked.IndexRange, asked.Value.Value)
            except ServiceError as error:
                return error.code
        else:
            given = {node.register: plain(asked.Value.Value, node.register)}
        if not all(map(node.feed.commands.is_writable, given)):
            return Fault.BadNotWritable
        if None in given.values():
            return Fault.BadTypeMismatch
        try:
            kind, reason = await node.feed.commands.write(given, attempt)
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

    async def serve_call(self, params: ua.CallParameters) -> list[bytes]:
        """Call methods."""
        _check_not_empty(params.MethodsToCall)
        with trail.acting(self.actor, "opcua"):
            return [struct_to_binary(await self._call(asked)) for asked in params.MethodsToCall]

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
        found.can_send, found.share = callback.__self__.can_send, self.share

    def sent(self, result: ua.PublishResult, request: Any, subscription: Subscription) -> None:
        """Send a publication of a subscription, as the answer to a Publish request."""
        subscription.pub_result_callback.__self__.publish(result, request)

    def modify_subscription(self, params: ua.ModifySubscriptionParameters) -> ua.ModifySubscriptionResult:
        """Change the interval and the limits of a subscription."""
        found = self.iserver.subscriptions.find(params.SubscriptionId, self)
        found.revise(params)
        return ua.ModifySubscriptionResult(found.interval_ms, found.lifetime, found.keep_alive)

    async def serve_publishing_mode(self, params: ua.SetPublishingModeParameters) -> list[bytes]:
        """Switch the publishing of subscriptions on or off."""

        def switch(number: int) -> None:
            self.iserver.subscriptions.find(number, self).enabled = bool(params.PublishingEnabled)

        return await self._each(params.SubscriptionIds, switch)

    async def _each(self, numbers: list[int], do: Callable[[int], object]) -> list[bytes]:
        """Do something with each number of a request, and return the statuses."""
        _check_not_empty(numbers)
        found = []
        for number in numbers:
            try:
                do(number)
            except ServiceError as error:
                found.append(_STATUS.pack(error.code))
            else:
                found.append(_STATUS.pack(Fault.Good))
            await self.share.turn()
        return found

    async def serve_delete_subscriptions(self, params: ua.DeleteSubscriptionsParameters) -> list[bytes]:
        """End subscriptions."""
        own = self.iserver.subscriptions
        return await self._each(params.SubscriptionIds, lambda number: own.delete([own.find(number, self)]))

    async def serve_transfer(self, params: ua.TransferSubscriptionsParameters) -> list[bytes]:
        """Refuse the transfer, because no session may take over the subscriptions of another session."""
        _check_not_empty(params.SubscriptionIds)
        refused = struct_to_binary(ua.TransferResult(ua.StatusCode(Fault.BadSubscriptionIdInvalid)))
        return [refused] * len(params.SubscriptionIds)

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

    async def serve_create_items(self, params: ua.CreateMonitoredItemsParameters) -> list[bytes]:
        """Start to monitor variables."""
        self.need("read")
        _check_not_empty(params.ItemsToCreate)
        if params.TimestampsToReturn not in _TIMESTAMPS:
            raise ServiceError(Fault.BadTimestampsToReturnInvalid)
        self.iserver.catch_up()
        found = self.iserver.subscriptions.find(params.SubscriptionId, self)
        results = []
        for asked in params.ItemsToCreate:
            try:
                result = self._create_item(found, asked, len(params.ItemsToCreate))
            except ServiceError as error:
                result = ua.MonitoredItemCreateResult(ua.StatusCode(error.code))
            results.append(struct_to_binary(result))
            await self.share.turn()
        return results

    def _create_item(
        self, found: Subscription, asked: ua.MonitoredItemCreateRequest, companions: int
    ) -> ua.MonitoredItemCreateResult:
        target = asked.ItemToMonitor
        if self.iserver.subscriptions.room(self) <= 0:
            raise ServiceError(Fault.BadTooManyMonitoredItems)
        if asked.MonitoringMode not in _MODES:
            raise ServiceError(Fault.BadMonitoringModeInvalid)
        if target.AttributeId == ua.AttributeIds.EventNotifier:
            raise ServiceError(Fault.BadServiceUnsupported)  # there are no events
        space = self.iserver.space
        watch, fastest_ms = space.watch(target.NodeId, target.AttributeId, self.roles, target.IndexRange or "")
        return found.add(watch, asked, fastest_ms, companions)

    async def serve_modify_items(self, params: ua.ModifyMonitoredItemsParameters) -> list[bytes]:
        """Change the parameters of monitored items."""
        self.need("read")
        _check_not_empty(params.ItemsToModify)
        found = self.iserver.subscriptions.find(params.SubscriptionId, self)
        results = []
        for asked in params.ItemsToModify:
            try:
                result = found.modify(asked)
            except ServiceError as error:
                result = ua.MonitoredItemModifyResult(ua.StatusCode(error.code))
            results.append(struct_to_binary(result))
            await self.share.turn()
        return results

    async def serve_monitoring_mode(self, params: ua.SetMonitoringModeParameters) -> list[bytes]:
        """Change the monitoring mode of items."""
        found = self.iserver.subscriptions.find(params.SubscriptionId, self)
        if params.MonitoringMode not in _MODES:
            raise ServiceError(Fault.BadMonitoringModeInvalid)
        mode = ua.MonitoringMode(params.MonitoringMode)
        return await self._each(params.MonitoredItemIds, lambda number: found.set_mode(number, mode))

    async def serve_delete_items(self, params: ua.DeleteMonitoredItemsParameters) -> list[bytes]:
        """Stop monitoring variables."""
        found = self.iserver.subscriptions.find(params.SubscriptionId, self)
        return await self._each(params.MonitoredItemIds, found.remove)


_STATUS: Final = struct.Struct("<I")
_TIMESTAMPS: Final = frozenset(ua.TimestampsToReturn) - {ua.TimestampsToReturn.Invalid}
_DIRECTIONS: Final = frozenset(ua.BrowseDirection) - {ua.BrowseDirection.Invalid}
_MODES: Final = frozenset(ua.MonitoringMode)


def _value(asked: ua.WriteValue) -> Any:
    return None if asked.Value is None or asked.Value.Value is None else asked.Value.Value.Value


def _first_values(asked: Iterable[ua.WriteValue] | None) -> dict[str, Any]:
    """Return the first values of a request by node, for the audit log."""
    return {str(one.NodeId.Identifier): _value(one) for one in islice(asked or (), trail.MAX_NAMED)}


def _check_not_empty(asked: list[Any] | None) -> None:
    """Raise ServiceError if a request has no items."""
    if not asked:
        raise ServiceError(Fault.BadNothingToDo)


def _no_references(code: int) -> bytes:
    return struct_to_binary(ua.BrowseResult(ua.StatusCode(code)))


def _joined(first: Any, rest: Any) -> Any:
    yield first
    yield from rest
