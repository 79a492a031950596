"""The call Replay of shmio.v1, which controls replays."""

from __future__ import annotations

import asyncio
import threading
from functools import partial
from typing import Any, Final

import grpc
import msgspec

from shmio.audit.trail import Attempt
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.errors import ShmioError, ValueRangeError
from shmio.local.replays import ReplayRequest, Replays
from shmio.model.replay import ReplayStatus
from shmio.segment import Segment
from shmio.wire import shmio_v1_pb2 as wire

MAX_TEXT: Final = 4096
MAX_SOURCES: Final = 256


class ReplayCalls:
    """Serves the call Replay."""

    def __init__(self, segment: Segment) -> None:
        self._replays = Replays(segment)
        self._lock = asyncio.Lock()

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handler of the call, by name."""
        request, response = wire.ReplayRequest.FromString, wire.ReplayResponse.SerializeToString
        return {"Replay": grpc.unary_unary_rpc_method_handler(self.replay, request, response)}

    async def replay(self, request: wire.ReplayRequest, context: Context) -> wire.ReplayResponse:
        """Control the replays, or return their status.

        The endpoint carries out one call at a time. If the client ends a call early, the search
        that it started ends, too.

        Statuses:
            INVALID_ARGUMENT: The speed or a time is not valid.
            NOT_FOUND: There is no such source or register.
            FAILED_PRECONDITION: No source replays a recording, the search finds nothing, or a
                source does not answer.
        """
        try:
            wanted = _wanted(request)
            if wanted.nothing:
                found = await asyncio.to_thread(self._replays.status, wanted.sources)
            else:
                with Attempt("replay", partial(msgspec.to_builtins, wanted)) as attempt:
                    found = await self._change(wanted)
                    attempt.end("done")
        except ShmioError as error:
            await refuse(context, error)
        return wire.ReplayResponse(sources=map(_to_wire, found))

    async def _change(self, wanted: ReplayRequest) -> list[ReplayStatus]:
        over = threading.Event()
        async with self._lock:
            try:
                return await asyncio.to_thread(self._replays.change, wanted, over.is_set)
            finally:
                over.set()  # if the call is cancelled, this ends the thread


def _wanted(request: wire.ReplayRequest) -> ReplayRequest:
    """Convert the message of a request.

    Raises:
        ValueRangeError: There are too many sources, or a text is too long.

    """
    texts = (request.seek, request.until, request.change, request.event, *request.sources)
    if len(request.sources) > MAX_SOURCES or any(len(text) > MAX_TEXT for text in texts):
        raise ValueRangeError(f"at most {MAX_SOURCES} sources are allowed, and {MAX_TEXT} characters in each text")
    return ReplayRequest(
        request.paused if request.HasField("paused") else None,
        request.speed if request.HasField("speed") else None,
        request.seek,
        request.until,
        request.loop if request.HasField("loop") else None,
        request.change,
        request.event,
        request.jump,
        tuple(request.sources),
    )


def _to_wire(play: ReplayStatus) -> wire.Playing:
    return wire.Playing(**msgspec.structs.asdict(play))
