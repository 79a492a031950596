"""What the parts of the client with asyncio share."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, NoReturn

import grpc


async def receive(call: Any, fail: Callable[[Any], NoReturn]) -> Any:
    """The next message of a stream, waited for. StopAsyncIteration: it is over, or was closed meanwhile.

    ``fail``: raises what an error of gRPC means.
    """
    try:
        found = await call.read()
    except grpc.RpcError as error:
        fail(error)
    except asyncio.CancelledError:
        if (task := asyncio.current_task()) is not None and task.cancelling():
            raise
        raise StopAsyncIteration from None  # it was the call that was cancelled: by close
    if found is grpc.aio.EOF:
        raise StopAsyncIteration
    return found
