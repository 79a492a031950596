"""Maps errors to gRPC statuses, for all services."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NoReturn

import grpc

from shmio.errors import (
    CommandError,
    ConfigError,
    ConflictError,
    EndpointError,
    PathError,
    SegmentError,
    ShmioError,
    TimeError,
    ValueRangeError,
)

Context = grpc.aio.ServicerContext[Any, Any]

_STATUS: Final[Mapping[type[ShmioError], grpc.StatusCode]] = {
    PathError: grpc.StatusCode.NOT_FOUND,
    ValueRangeError: grpc.StatusCode.INVALID_ARGUMENT,
    ConfigError: grpc.StatusCode.INVALID_ARGUMENT,
    CommandError: grpc.StatusCode.FAILED_PRECONDITION,
    ConflictError: grpc.StatusCode.ALREADY_EXISTS,
    EndpointError: grpc.StatusCode.RESOURCE_EXHAUSTED,
    TimeError: grpc.StatusCode.FAILED_PRECONDITION,
    SegmentError: grpc.StatusCode.UNAVAILABLE,
}


async def refuse(context: Context, error: ShmioError) -> NoReturn:
    """End a call with the status and message of an error."""
    codes = (_STATUS[kind] for kind in type(error).__mro__ if kind in _STATUS)
    await context.abort(next(codes, grpc.StatusCode.INTERNAL), str(error))
    raise error  # abort never returns
