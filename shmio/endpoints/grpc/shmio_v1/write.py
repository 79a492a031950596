"""The call Write, and helpers for all calls that receive values: by path, or by the slots of a table."""

from __future__ import annotations

from typing import Any, Final

import grpc

from shmio.endpoints.grpc.commands import command_client
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.server.limits import time_sliced
from shmio.endpoints.grpc.shmio_v1.tables import Selection
from shmio.endpoints.grpc.topics import Topics
from shmio.errors import CommandError, ShmioError, ValueRangeError
from shmio.layout.model import Register, index_at
from shmio.layout.topic import shorten
from shmio.layout.values.text import from_text, wire_type
from shmio.messages import value_from_wire
from shmio.model.values import Column
from shmio.segment import EventKind
from shmio.wire import shmio_v1_pb2 as wire

MAX_VALUES: Final = 4096
"""Maximum number of values in one command."""
MAX_TIMEOUT_MS: Final = 86_400_000

FIELDS: Final = {column: wire.Values.DESCRIPTOR.fields_by_number[column].name for column in Column}
_OUTCOMES: Final = {
    EventKind.WRITTEN: wire.Outcome.KIND_WRITTEN,
    EventKind.TAKEN: wire.Outcome.KIND_TAKEN,
    EventKind.REJECTED: wire.Outcome.KIND_REJECTED,
    EventKind.REFUSED: wire.Outcome.KIND_REFUSED,
    EventKind.EXPIRED: wire.Outcome.KIND_EXPIRED,
    EventKind.SHADOWED: wire.Outcome.KIND_SHADOWED,
    EventKind.ACCEPTED: wire.Outcome.KIND_ACCEPTED,
}


class WriteCalls:
    """Serves the call Write."""

    def __init__(self, topics: Topics) -> None:
        self._topics = topics

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handler of the call, by name."""
        request, response = wire.WriteRequest.FromString, wire.WriteResponse.SerializeToString
        return {"Write": grpc.unary_unary_rpc_method_handler(self.write, request, response)}

    async def write(self, request: wire.WriteRequest, context: Context) -> wire.WriteResponse:
        """Write registers of one source, all or none. Return the outcome of each.

        If the call ends with an error status, nothing was sent.

        Statuses:
            NOT_FOUND: There is no such register.
            INVALID_ARGUMENT: A value does not fit, there are too many values, or the values are for
                several sources.
            FAILED_PRECONDITION: A register is not writable, or the source does not answer.
        """
        try:
            if request.timeout_ms > MAX_TIMEOUT_MS:
                raise ValueRangeError(f"timeout_ms: at most {MAX_TIMEOUT_MS} (a day) is allowed")
            source, values = await decode_assignments(request.values, self._topics)
            timeout_s = request.timeout_ms / 1000 or None
            commands = self._topics.feed(source).commands
            ends = await command_client.write(commands, values, timeout_s, until_accepted=request.until_accepted)
            return wire.WriteResponse(outcomes=[outcome(*end) for end in ends])
        except ShmioError as error:
            await refuse(context, error)


def outcome(kind: EventKind, reason: str) -> wire.Outcome:
    """Convert an outcome to a message."""
    return wire.Outcome(kind=_OUTCOMES.get(kind, wire.Outcome.KIND_UNKNOWN), reason=reason)


async def decode_assignments(assignments: Any, topics: Topics) -> tuple[str, dict[str, object]]:
    """Decode the values of a write request. While a large request is decoded, other tasks run.

    Returns:
        The source of the values, and the values by register path.

    Raises:
        PathError: There is no such register.
        ValueRangeError: A value does not fit, there are no values or too many, or the values are
            for several sources.
        CommandError: A path ends in ``/out``.

    """
    if len(assignments) > MAX_VALUES:  # checked before any value is read
        raise ValueRangeError(
            f"{len(assignments)} values are given, but at most {MAX_VALUES} are allowed; write whole arrays or "
            "fewer values"
        )
    values: dict[str, object] = {}
    sources: dict[str, None] = {}
    async for assignment in time_sliced(assignments):
        topic = topics.topic(assignment.path)
        register = topics.register(topic)
        if topic.direction == "out":
            raise CommandError(f"{shorten(assignment.path)}: an output of a source cannot be written; leave out /out")
        if register.path in values:
            raise ValueRangeError(f"{shorten(assignment.path)}: this path is given twice")
        values[register.path] = plain(assignment.value, register)
        sources[topic.source] = None
    if not values:
        raise ValueRangeError("no value is given")
    if len(sources) > 1:
        raise ValueRangeError(f"one call writes to one source, but these values are for {', '.join(sorted(sources))}")
    return next(iter(sources)), values


def plain(value: wire.Value, register: Register) -> object:
    """Convert a value from a message to Python.

    Raises:
        ValueRangeError: The value is missing, or a text does not fit the register.

    """
    if value.WhichOneof("kind") == "text" and (register.dims or wire_type(register) != "string"):
        return from_text(value.text, register)
    return value_from_wire(value, register.path)


def packed(values: wire.Values, selection: Selection) -> dict[str, object]:
    """Convert values by slot to values by path.

    Raises:
        ValueRangeError: The values do not fit the table.

    """
    found: dict[str, object] = {}
    for column, name in FIELDS.items():
        if not values.HasField(name):
            continue
        part = getattr(values, name)
        slots = part.slots or range(selection.columns.sizes[column])
        if len(slots) != len(part.values):
            raise ValueRangeError(f"{name}: {len(part.values)} values are given for {len(slots)} slots")
        if len(found) + len(slots) > MAX_VALUES:
            raise ValueRangeError(f"more than {MAX_VALUES} values are given; send fewer at once")
        for slot, value in zip(slots, part.values, strict=True):
            found[_path(selection, column, slot)] = value
    return found


def _path(selection: Selection, column: Column, slot: int) -> str:
    """Return the path of the register or element at a slot.

    Raises:
        ValueRangeError: There is no such slot.

    """
    place = selection.columns.place(column, slot)
    if place is None:
        raise ValueRangeError(f"{column.name.lower()}s: the table has no slot {slot}")
    register = selection.registers[place]
    if not register.dims:
        return register.path
    flat = slot - selection.columns.places[place][1]
    return "/".join((register.path, *map(str, index_at(register.dims, flat))))
