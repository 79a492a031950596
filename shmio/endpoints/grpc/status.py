"""What an error means to a client."""

from __future__ import annotations

from typing import Any, Final, NoReturn

import grpc

from shmio.errors import CommandError, ConflictError, EndpointError, PathError, ShmioError, ValueRangeError

_STATUS: Final = {
    PathError: grpc.StatusCode.NOT_FOUND,
    ValueRangeError: grpc.StatusCode.INVALID_ARGUMENT,
    ConflictError: grpc.StatusCode.ALREADY_EXISTS,
    CommandError: grpc.StatusCode.FAILED_PRECONDITION,
    EndpointError: grpc.StatusCode.RESOURCE_EXHAUSTED,
}


async def refuse(context: grpc.aio.ServicerContext[Any, Any], error: ShmioError) -> NoReturn:
    """End a call with what its error means to the client."""
    await context.abort(_STATUS.get(type(error), grpc.StatusCode.INTERNAL), str(error))
    raise error  # abort never returns
