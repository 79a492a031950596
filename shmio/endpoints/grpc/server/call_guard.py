"""Checks the access rights, limits and messages of each call.

The guard also refuses calls with unknown names.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from contextlib import aclosing
from dataclasses import dataclass
from importlib import import_module
from operator import attrgetter
from typing import Any, Final

import grpc
from google.protobuf.message import DecodeError

from shmio.audit import trail
from shmio.endpoints.grpc.server.access import (
    NEEDS,
    READ,
    Credentials,
    DeniedError,
    ListenerAccess,
    WrongTokenError,
    action_of,
    client_of,
    host_of,
)
from shmio.endpoints.grpc.server.error_status import Context
from shmio.endpoints.turns import Turns
from shmio.endpoints.wrong_tokens import WrongTokens
from shmio.errors import EndpointError
from shmio.layout.topic import shorten
from shmio.logs import fields

TURN_S: Final = 10.0
"""Length of the periods in which log lines are counted, in s."""
LINES: Final = 10
"""Maximum number of log lines in a period. One more line reports how many were left out."""

log = logging.getLogger("shmio.grpc")


class Refusals:
    """Counts and logs refused messages or calls. Use it only in the event loop's thread."""

    def __init__(self, what: str = "publish refused", about: str = "topic", turn_s: float = TURN_S) -> None:
        """Start counting.

        Args:
            what: The first words of each log line.
            about: The log field that names what was refused.
            turn_s: Length of the periods in which log lines are counted, in s.

        """
        self.count = 0
        self._what = what
        self._about = about
        self._turn_s = turn_s
        self._in_turn = 0

    def add(self, reason: str, name: str, peer: str) -> None:
        """Count a refusal, and log it unless this period has enough log lines already.

        Args:
            reason: Why it was refused.
            name: What was refused, such as the topic.
            peer: The client.
        """
        self.count += 1
        self._in_turn += 1
        if self._in_turn == 1:
            asyncio.get_running_loop().call_later(self._turn_s, self._end_turn)
        if self._in_turn <= LINES:
            log.warning("%s: %s", self._what, reason, extra=fields(**{self._about: shorten(name)}, peer=peer))

    def _end_turn(self) -> None:
        if self._in_turn > LINES:
            log.warning("%s: %d more times in %g s", self._what, self._in_turn - LINES, self._turn_s)
        self._in_turn = 0


Handler = Any
Decode = Callable[[bytes], Any]
Encode = Callable[[Any], bytes]


@dataclass(frozen=True, slots=True)
class CallLimits:
    """Limits on open connections and calls, for all addresses together.

    When fewer than ``reserve`` calls are free, only clients with fewer than ``share`` calls may
    open another call. So a client that opens thousands of calls leaves room for others.
    """

    connections: int = 2048
    calls: int = 4096
    reserve: int = 1024
    share: int = 64
    message_s: float = 10.0
    """Maximum time in s in which the client must send the only message of a call without a request stream."""


class _Call:
    """An open call.

    ``denial`` is the reason why the guard ends the call, or None.
    """

    __slots__ = ("access", "acting", "client", "denial", "method", "shown", "task")

    def __init__(
        self, method: str, access: ListenerAccess, shown: Credentials, client: str, acting: trail.Acting
    ) -> None:
        self.method = method
        self.access = access
        self.shown = shown
        self.client = client
        self.acting = acting
        self.task = asyncio.current_task()
        self.denial: DeniedError | None = None

    def end(self, denial: DeniedError) -> None:
        """Cancel the call; its status becomes ``denial``."""
        self.denial = denial
        if self.task is not None:
            self.task.cancel()


class OpenCalls:
    """All open calls, on all addresses. Use it only in the event loop's thread."""

    def __init__(self, limits: CallLimits | None = None) -> None:
        self.limits = limits or CallLimits()
        self.refusals = Refusals("call refused", "call")
        self.wrong = WrongTokens()
        self.turns = Turns()
        self.sent_bytes = 0
        """Size of all messages that were sent to clients, without the framing of gRPC and HTTP/2."""
        self._open: set[_Call] = set()
        self._by_client: Counter[str] = Counter()
        self._silent: dict[_Call, float] = {}  # deadlines, in order, of the calls whose message has not come yet
        self._timer: asyncio.TimerHandle | None = None

    def __len__(self) -> int:
        return len(self._open)

    def enter(self, method: str, access: ListenerAccess, context: Context) -> _Call:
        """Admit a call, or refuse it. The caller must call :meth:`leave` when an admitted call has ended.

        Args:
            method: The full name of the call.
            access: The access rules of the address.
            context: The context of the call.

        Raises:
            DeniedError: The call is refused.

        """
        peer = context.peer()
        shown = Credentials.of(context.invocation_metadata() or (), context.auth_context())
        acting = trail.act(access.actor(shown, peer), "grpc")
        try:
            client = client_of(peer, access.admit(method, shown))
            self._check(client)
        except DeniedError as error:
            self.refusals.add(str(error), method, peer)
            denied = error.code is not grpc.StatusCode.RESOURCE_EXHAUSTED
            if denied or NEEDS.get(method) != READ:
                what = {"call": method}
                trail.record(action_of(method), what, "denied" if denied else "refused", str(error), who=acting)
            raise
        call = _Call(method, access, shown, client, acting)
        self._open.add(call)
        self._by_client[client] += 1
        return call

    def leave(self, call: _Call) -> None:
        """Remove a call that has ended."""
        self._open.discard(call)
        self._by_client[call.client] -= 1
        if not self._by_client[call.client]:
            del self._by_client[call.client]

    async def message(self, call: _Call, context: Context) -> Any:
        """Return the only message of a call, or EOF. End the call if the message does not come in time."""
        loop = asyncio.get_running_loop()
        self._silent[call] = due_s = loop.time() + self.limits.message_s
        if self._timer is None:  # one timer for all calls, because nearly every message is there at once
            self._timer = loop.call_at(due_s, self._end_silent)
        try:
            return await context.read()
        finally:
            self._silent.pop(call, None)

    def _end_silent(self) -> None:
        loop = asyncio.get_running_loop()
        self._timer = None
        for call, due_s in list(self._silent.items()):
            if due_s > loop.time():
                self._timer = loop.call_at(due_s, self._end_silent)
                return
            del self._silent[call]
            limit = f"the client sent no message within {self.limits.message_s:g} s"
            call.end(DeniedError(grpc.StatusCode.DEADLINE_EXCEEDED, f"{call.method}: {limit}"))

    def review(self) -> int:
        """End the calls that the present access rules no longer allow. Return their number."""
        ended = 0
        for call in self._open:
            try:
                call.access.admit(call.method, call.shown)
            except DeniedError as error:
                call.end(error)
                ended += 1
        return ended

    def _check(self, client: str) -> None:
        limits, count = self.limits, len(self._open)
        if count >= limits.calls:
            raise DeniedError(
                grpc.StatusCode.RESOURCE_EXHAUSTED,
                f"{limits.calls} calls are open, which is the maximum; try again when others have ended",
            )
        if count >= limits.calls - limits.reserve and self._by_client[client] >= limits.share:
            raise DeniedError(
                grpc.StatusCode.RESOURCE_EXHAUSTED,
                f"this client has {self._by_client[client]} calls open, and the last {limits.reserve} of {limits.calls}"
                f" calls are for clients with fewer than {limits.share}; use SimlogAPI version 2 (one stream for all "
                "topics)",
            )


class CallGuard:
    """Checks every call at one listening address.

    It declares to gRPC that each call has a stream of requests. So it can check and count a call
    before the first message arrives. An invalid message then ends the call with a status, and
    leaves no traceback in the log.
    """

    def __init__(self, access: ListenerAccess, calls: OpenCalls) -> None:
        self._access = access
        self._calls = calls

    def guarded(self, method: str, handler: Handler) -> Handler:
        """Return a handler that checks a call, and then runs the call's own handler.

        Args:
            method: The full name of the call.
            handler: The call's own handler.

        """
        found: Any = handler  # its attributes depend on its kind
        behaviour = found.stream_stream or found.stream_unary or found.unary_stream or found.unary_unary
        decode = handler.request_deserializer
        many = inspect.isasyncgenfunction(behaviour)

        async def run(messages: AsyncIterator[bytes], context: Context) -> Any:
            try:
                call = self._calls.enter(method, self._access, context)
            except DeniedError as error:
                if isinstance(error, WrongTokenError):
                    await self._calls.wrong.slow_down(host_of(context.peer()))
                await context.abort(error.code, str(error))
            try:
                request: Any = messages
                if not handler.request_streaming:
                    request = await self._message(call, decode, context)
                elif decode is not None:
                    request = _decoded(method, decode, messages, context)
                if not many:
                    if handler.request_streaming or NEEDS.get(method) != READ:
                        return await behaviour(request, context)
                    async with self._calls.turns.of(call.client):
                        return await behaviour(request, context)
                async with aclosing(behaviour(request, context)) as responses:
                    async for response in responses:
                        await context.write(response)
            except asyncio.CancelledError:
                if call.denial is None:
                    raise
                _record_end(call, str(call.denial))
                await context.abort(call.denial.code, str(call.denial))
            except grpc.aio.AbortError:
                _record_end(call, context.details())
                raise
            except grpc.aio.InternalError:  # the client is gone, and nothing can be sent
                raise asyncio.CancelledError from None
            finally:
                self._calls.leave(call)

        encode = self._counting(handler.response_serializer)
        if handler.response_streaming:
            return grpc.stream_stream_rpc_method_handler(run, None, encode)
        return grpc.stream_unary_rpc_method_handler(run, None, encode)

    def _counting(self, encode: Encode | None) -> Encode:
        """Return an encoder that counts the bytes of the messages. gRPC sends each message that it encodes."""

        def counting(message: Any) -> bytes:
            data: bytes = message if encode is None else encode(message)
            self._calls.sent_bytes += len(data)
            return data

        return counting

    async def _message(self, call: _Call, decode: Decode | None, context: Context) -> Any:
        """Return the decoded single message of a call."""
        data = await self._calls.message(call, context)
        if data is grpc.aio.EOF:
            await context.abort(grpc.StatusCode.INVALID_ARGUMENT, f"{call.method}: the client sent no message")
        return await _parsed(call.method, decode, data, context)


def _record_end(call: _Call, reason: str) -> None:
    """Record in the audit log that a call has failed.

    Record nothing if the call needs only the role ``read``, or if its refusal is recorded already.
    """
    if NEEDS.get(call.method) != READ and not call.acting.refused:
        trail.record(action_of(call.method), {"call": call.method}, "refused", reason, who=call.acting)


async def _decoded(method: str, decode: Decode, messages: AsyncIterator[bytes], context: Context) -> AsyncIterator[Any]:
    async for data in messages:
        yield await _parsed(method, decode, data, context)


async def _parsed(method: str, decode: Decode | None, data: bytes, context: Context) -> Any:
    try:
        return data if decode is None else decode(data)
    except DecodeError:
        await context.abort(
            grpc.StatusCode.INVALID_ARGUMENT, f"{method}: {len(data)} bytes are not a valid message of this call"
        )


# ---- calls with unknown names ----------------------------------------------------------------------------
#
# grpcio's serving task decodes the name of every call that is not registered. A name that is not UTF-8 ends the
# task, and its cleanup frees memory that the core still writes to. All unregistered calls also share one queue. So
# the server registers every method: the core matches names by their bytes, and each method has its own queue. A few
# workers refuse all other calls. This needs private names of grpcio. The server does not start with a version that
# lacks them, or whose functions have other parameters.

cygrpc: Any = import_module("grpc._cython.cygrpc")
AioServer: Any = import_module("grpc.aio._server").Server

WORKERS: Final = 8
"""Maximum number of calls with unknown names that are refused at the same time."""

_NEEDED: Final = (
    "AioServer._make_request_call_future(self, method_bytes)",
    "AioServer._request_call(self)",
    "AioServer._request_registered_call(self, method)",
    "AioServer.add_registered_method_handlers(self, method_handlers)",
    "AioServer.is_running(self)",
    "AioServer.shutdown(self, grace)",
    "_ServicerContext.abort(self, code, details, trailing_metadata)",
    "_RequestCallError",
    "_handle_stream_stream_rpc(method_handler, rpc_state, loop)",
    "_handle_stream_unary_rpc(method_handler, rpc_state, loop)",
    "_schedule_rpc_coro(rpc_coro, rpc_state, loop, method_name)",
    "get_working_loop()",
)
"""The private names that this module uses, those of functions with their parameters."""
_NO_CALL: Final = "there is no such call; reflection lists the services"


def check_version() -> None:
    """Check that grpcio has the private names that this module uses, and that its functions have these parameters.

    Raises:
        EndpointError: This version of grpcio lacks some of them.

    """
    if missing := [needed for needed in _NEEDED if not _provided(needed)]:
        raise EndpointError(
            f"grpcio {grpc.__version__} does not have {', '.join(missing)}, without which unknown calls could stop the "
            "endpoint; install another version (tested: 1.84.0 to 1.85.3)"
        )


def _provided(needed: str) -> bool:
    name, _, parameters = needed.partition("(")
    try:
        found = attrgetter(name)(cygrpc)
        return not parameters or ", ".join(inspect.signature(found).parameters) == parameters.removesuffix(")")
    except (AttributeError, TypeError, ValueError):  # it is not there, or its parameters are unknown
        return False


class Core(getattr(cygrpc, "AioServer", object)):  # type: ignore[misc]
    """A gRPC core that starts the handlers of calls itself.

    grpcio's serving task would wait for the requests of all methods together, for each call anew, and then search for
    the handler. Here it waits only for the end of the core.
    """

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._handlers: dict[str, Handler] = {}
        self._tasks: set[asyncio.Task[None]] = set()  # asyncio itself holds tasks only weakly

    def add_registered_method_handlers(self, handlers: dict[str, Handler]) -> None:
        """Add handlers of calls, all with streams of requests, by the calls' full names."""
        super().add_registered_method_handlers(handlers)
        self._handlers |= handlers

    def start_workers(self) -> None:
        """Start the workers that refuse calls with unknown names."""
        self._taking = asyncio.Lock()  # only one worker at a time waits for a call
        self.refused = 0
        self._workers = [asyncio.create_task(self._refuse()) for _ in range(WORKERS)]

    @property
    def alive(self) -> bool:
        """True while the core serves.

        A core that has stopped cannot serve again, so the process must end.
        """
        return bool(self.is_running()) and not any(worker.done() for worker in self._workers)

    def _make_request_call_future(self, method: bytes | None) -> asyncio.Future[Any]:
        """Return a future for the next call; if it is cancelled, the core may still write to the request's memory."""
        request: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        if method is not None:  # the workers take calls of other methods
            self._start(self._take_calls(method, request))
        return request

    async def _take_calls(self, method: bytes, request: asyncio.Future[Any]) -> None:
        """Start the handler of each call of a method, until the core ends. Then fail the serving task's request."""
        name = method.decode()
        handler, loop = self._handlers[name], asyncio.get_running_loop()
        run = cygrpc._handle_stream_stream_rpc if handler.response_streaming else cygrpc._handle_stream_unary_rpc
        try:
            while True:
                state = await self._request_registered_call(method)
                self._start(cygrpc._schedule_rpc_coro(run(handler, state, loop), state, loop, name))
                del state  # it keeps the call alive
        except Exception as error:  # noqa: BLE001  the serving task handles it
            if not request.done():
                request.set_exception(error)

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _refuse(self) -> None:
        while self.is_running():
            async with self._taking:
                if not self.is_running():
                    return
                try:
                    state = await _kept(asyncio.create_task(self._request_call()))
                except cygrpc._RequestCallError:  # the core is shutting down
                    continue
            self.refused += 1
            context = cygrpc._ServicerContext(state, None, None, asyncio.get_running_loop())
            try:
                await context.abort(grpc.StatusCode.UNIMPLEMENTED, _NO_CALL)
            except (grpc.aio.AbortError, grpc.aio.InternalError):  # the status was sent, or the client is gone
                pass
            finally:
                del state, context  # they keep the call alive


class CoreServer(AioServer):  # type: ignore[misc]
    """An asyncio gRPC server that uses a :class:`Core`."""

    def __init__(self, options: Sequence[tuple[str, Any]], guard: CallGuard) -> None:
        """Create a server whose calls ``guard`` checks, and otherwise with the defaults of ``grpc.aio.server``."""
        check_version()
        self._guard = guard
        self._loop = cygrpc.get_working_loop()
        self._server: Core = Core(self._loop, None, (), (), tuple(options), None)

    @property
    def alive(self) -> bool:
        """True while the server serves."""
        return bool(self._server.alive)

    @property
    def refused(self) -> int:
        """Number of calls with unknown names that were refused since the start."""
        return int(self._server.refused)

    def add_registered_method_handlers(self, service: str, handlers: Mapping[str, Handler]) -> None:
        """Add the handlers of a service's calls, by name."""
        guarded = {name: self._guard.guarded(f"/{service}/{name}", handler) for name, handler in handlers.items()}
        super().add_registered_method_handlers(service, guarded)

    async def start(self) -> None:
        """Start serving."""
        await super().start()
        self._server.start_workers()


def _kept(request: asyncio.Task[Any]) -> asyncio.Future[Any]:
    """Shield a request for a call from cancellation, because the core writes to the request's memory."""
    request.add_done_callback(lambda done: done.cancelled() or done.exception())  # else asyncio may log the error
    return asyncio.shield(request)
