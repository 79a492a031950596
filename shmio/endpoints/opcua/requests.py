"""Decodes requests, and encodes their responses, piece by piece, so that large ones do not delay other clients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import cache
from typing import Any, Final, NamedTuple

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.ua import ua_binary
from asyncua.ua.ua_binary import Primitives, nodeid_to_binary, struct_to_binary
from asyncua.ua.uatypes import type_from_list, type_is_list

from shmio.endpoints.shares import Share

MAX_NODES: Final = 10_000
"""Maximum number of nodes, items or paths in a request. The server's OperationLimits contain this number."""
MAX_WRITES: Final = 1_000
MAX_CALLS: Final = 10
MAX_OWN_ITEMS: Final = 50_000
"""Maximum number of a session's items."""
MAX_OWN_SUBSCRIPTIONS: Final = 200

_NO_DIAGNOSTICS: Final = Primitives.Int32.pack(-1)


class Service(NamedTuple):
    """A service whose requests and responses are arrays.

    Attributes:
        serve: The method of the session that serves it. It gets the decoded parameters, and returns the
            encoded elements of the response.
        parameters: The type of the parameters.
        response: The identifier of the response.
        most: Maximum number of elements in a request.
        arrays: The number of arrays in a response: none, the results, or these and diagnostic information.
    """

    serve: str
    parameters: type
    response: int
    most: int
    arrays: int = 2


def _service(name: str, serve: str, most: int, arrays: int = 2) -> tuple[int, Service]:
    identifiers = ua.ObjectIds
    parameters: Any = getattr(ua, f"{name}Parameters")
    response: int = getattr(identifiers, f"{name}Response_Encoding_DefaultBinary")
    request: int = getattr(identifiers, f"{name}Request_Encoding_DefaultBinary")
    return request, Service(serve, parameters, response, most, arrays)


SERVICES: Final[dict[int, Service]] = dict((
    _service("Read", "serve_read", MAX_NODES),
    _service("Write", "serve_write", MAX_WRITES),
    _service("Browse", "serve_browse", MAX_NODES),
    _service("BrowseNext", "serve_browse_next", MAX_NODES),
    _service("TranslateBrowsePathsToNodeIds", "serve_paths", MAX_NODES),
    _service("RegisterNodes", "serve_register", MAX_NODES, arrays=1),
    _service("UnregisterNodes", "serve_unregister", MAX_NODES, arrays=0),
    _service("Call", "serve_call", MAX_CALLS),
    _service("CreateMonitoredItems", "serve_create_items", MAX_NODES),
    _service("ModifyMonitoredItems", "serve_modify_items", MAX_NODES),
    _service("SetMonitoringMode", "serve_monitoring_mode", MAX_OWN_ITEMS),
    _service("DeleteMonitoredItems", "serve_delete_items", MAX_OWN_ITEMS),
    _service("SetPublishingMode", "serve_publishing_mode", MAX_OWN_SUBSCRIPTIONS),
    _service("DeleteSubscriptions", "serve_delete_subscriptions", MAX_OWN_SUBSCRIPTIONS),
    _service("TransferSubscriptions", "serve_transfer", MAX_OWN_SUBSCRIPTIONS),
))  # fmt: skip
"""The services with arrays, by the identifier of their requests."""


@cache
def _decoders(kind: type) -> tuple[tuple[str, bool, Callable[[Any], Any]], ...]:
    """For each member of a structure: its name, whether it is an array, and the decoder of it or its elements."""
    hints = ua_binary.get_safe_type_hints(kind, {"ua": ua})
    found = []
    for field in fields(kind):
        hint = hints[field.name]
        array = type_is_list(hint)
        element = type_from_list(hint) if array else hint
        found.append((field.name, array, ua_binary._create_type_deserializer(element, kind)))
    return tuple(found)


async def decode(kind: type, body: Any, most: int, share: Share) -> Any:
    """Decode the parameters of a request.

    Args:
        kind: Their type.
        body: The encoded parameters.
        most: Maximum number of elements of each array.
        share: The client's share of the time.

    Raises:
        ServiceError: An array has too many elements.
    """
    members: dict[str, Any] = {}
    for name, array, read in _decoders(kind):
        if not array:
            members[name] = read(body)
            continue
        count = Primitives.Int32.unpack(body)
        if count > most:
            raise ServiceError(ua.StatusCodes.BadTooManyOperations)
        members[name] = elements = []
        for _ in range(count):
            elements.append(read(body))
            await share.turn()
    return kind(**members)


def encode(service: Service, header: Any, results: Sequence[bytes]) -> bytes:
    """Return a response with these encoded elements."""
    parts = [nodeid_to_binary(ua.FourByteNodeId(service.response)), struct_to_binary(header)]
    if service.arrays:
        parts += (Primitives.Int32.pack(len(results)), *results)
    if service.arrays > 1:
        parts.append(_NO_DIAGNOSTICS)
    return b"".join(parts)
