"""Messages between an endpoint and a client that injects values or declares injections.

This module does no I/O.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

import msgspec
import numpy as np

from shmio.client import calls
from shmio.client.table import DTYPES, FIELDS, Array, InjectRequest, Table
from shmio.client.update import Piece, Tables, Update
from shmio.errors import RemoteError, ValueRangeError
from shmio.messages import declaration_from_wire, declaration_to_wire
from shmio.model.injection import Declared, Injection, InjectionEvent, Lifted, Running
from shmio.model.values import Column, Outcome
from shmio.wire import shmio_v1_pb2 as wire

_MAX_WAITING: Final = 4096
"""Maximum number of unread messages with originals, which are the values that an injection covers."""

Given = Array | list[Any]
Arrays = Mapping[Column, Given | tuple[Given, Given]]
"""Values by column: for the whole column, or (slots, values) for a part of it."""
Raw = Iterable[Piece | tuple[int, bytes] | tuple[int, bytes, int]]
"""Each item is (offset, bytes) or (offset, bytes, mask): see :class:`Piece`."""
Ranges = Iterable[tuple[int, int] | tuple[int, int, int]]
"""Each item is (offset, size) for bytes of a frame, or (offset, size, mask) for bits of these bytes."""


def inject_request(
    patterns: Iterable[str],
    *,
    ranges: Ranges,
    source: str,
    priority: int,
    keep: bool,
    name: str,
    for_s: float | None,
    originals: bool,
) -> bytes:
    """Return the first request of the call Inject, with the arguments of ``Client.inject``.

    Raises:
        ValueRangeError: An argument is invalid.
    """
    if for_s is not None and not 0 < for_s <= 86_400:
        raise ValueRangeError(f"for_s: {for_s} is not a number of seconds above 0 and at most 86400")
    lifetime_ms = 0 if for_s is None else max(1, round(1000 * for_s))
    request = InjectRequest()
    request.lay.patterns.extend(patterns)
    request.lay.priority, request.lay.keep, request.lay.name = priority, keep, name
    request.lay.lifetime_ms, request.lay.quiet = lifetime_ms, not originals
    request.lay.source = source.removesuffix("/in").removesuffix("/out")
    request.lay.direction = wire.DIRECTION_IN if source.endswith("/in") else wire.DIRECTION_OUT
    for offset, size, *mask in ranges:
        request.lay.ranges.add(offset=offset, size=size, mask=mask[0] if mask else 0)
    return bytes(request.SerializeToString())


class ShadowState:
    """State of an injection of this client: its table of registers, and its unread originals."""

    def __init__(self, found: Any) -> None:
        """Read the endpoint's first answer. Raise RemoteError if it is None or invalid."""
        if found is None or not found.HasField("laid"):
            raise RemoteError("the endpoint's first answer to Inject is invalid")
        self.number: int = found.laid.number
        self._tables = Tables()
        self.table = Table(found.laid.table)
        self._tables.known[self.table.number] = self.table
        self._sequence = 0
        self._waiting: deque[Any] = deque()

    def request(
        self, values: Mapping[str, object], arrays: Arrays | None, raw: Raw, *, answered: bool
    ) -> tuple[int, bytes]:
        """Return the sequence number and the bytes of a message that gives values.

        With ``answered``, the message asks the endpoint for an answer. Without it, the sequence
        number is 0.

        Raises:
            ValueRangeError: A value is wrong.
        """
        request = InjectRequest()
        shadow = request.shadow
        if answered:
            self._sequence += 1
            shadow.sequence = self._sequence
        for column, given in (arrays or {}).items():
            self._fill(getattr(shadow.values, FIELDS[column]), column, given)
        for offset, content, *mask in raw:
            shadow.pieces.add(offset=offset, data=content, mask=mask[0] if mask else 0)
        data = bytes(request.SerializeToString())
        if values:
            more = wire.InjectRequest(shadow=wire.Shadow(assignments=calls.assignments(values)))
            data += more.SerializeToString()  # protobuf merges the two parts into one message
        return shadow.sequence, data

    def _fill(self, part: Any, column: Column, given: Given | tuple[Given, Given]) -> None:
        slots, values = given if isinstance(given, tuple) else (None, given)
        expected = len(self.table.arrays.get(column, ())) if slots is None else len(slots)
        if len(values) != expected:
            raise ValueRangeError(f"{FIELDS[column]}: {len(values)} values were given for {expected} elements")
        if slots is not None:
            part.slots = np.asarray(slots, "<u4").tobytes()
        if column is Column.TEXT:
            part.values.extend(map(str, values))
        else:
            part.values = np.asarray(values, DTYPES[column]).tobytes()

    def keep(self, found: Any) -> None:
        """Store a message with originals until they are read. Raise RemoteError if too many are unread."""
        if found.originals:
            if len(self._waiting) >= _MAX_WAITING:
                raise RemoteError(
                    f"{_MAX_WAITING} messages with originals are unread; iterate over them, or do not request originals"
                )
            self._waiting.append(found.originals)

    @property
    def waits(self) -> bool:
        """True if there are unread originals."""
        return bool(self._waiting)

    def originals(self) -> Iterator[Update]:
        """Yield the originals of the oldest unread message."""
        for update in self._waiting.popleft():
            if update.table != self.table.number:
                raise RemoteError(f"the endpoint sent an original of table {update.table}, but not the table")
            yield Update(self.table, update)


def ends(values: Mapping[str, object], outcome: Any, *, more: bool) -> list[Outcome]:
    """Return the same outcome for every value.

    With ``more``, a last outcome with an empty path stands for all arrays and raw bytes.
    """
    paths = [*values, *([""] if more else [])]
    return calls.outcomes(paths, [outcome])


# -- declared injections -------------------------------------------------------------------------------------


def declare_request(declarations: Iterable[Mapping[str, Any] | msgspec.Struct], *, keep: bool) -> Any:
    """Return the request of the call Declare. Raise ValueRangeError if a key or value is invalid."""
    given = [one if isinstance(one, Mapping) else msgspec.to_builtins(one) for one in declarations]
    tables = [declaration_to_wire(table, f"injection[{index}]") for index, table in enumerate(given)]
    return wire.DeclareRequest(declarations=tables, keep=keep)


def declared(found: Any) -> tuple[Declared, ...]:
    """Return the injections in the first answer of the call Declare. Raise RemoteError if it is invalid."""
    if found is None or not found.HasField("declared"):
        raise RemoteError("the endpoint's first answer to Declare is invalid")
    return tuple(Declared(one.source, one.number, one.name, one.seed) for one in found.declared.injections)


def events(found: Any) -> list[InjectionEvent]:
    """Return the events in an answer of the call Declare."""
    known = wire.Happening.Kind.values()
    return [
        InjectionEvent(
            one.source, one.number,
            wire.Happening.Kind.Name(one.kind).removeprefix("KIND_").lower() if one.kind in known else "unknown",
            one.clock_ns, one.utc_ns, one.frame, one.cycle, one.run, one.text,
        )
        for one in found.happenings
    ]  # fmt: skip


def lifted(found: Any) -> list[Lifted]:
    """Return the lifted injections in the answer of the call LiftAll."""
    return [Lifted(one.source, one.number, one.name, one.failure) for one in found.lifted]


def injections(found: Any) -> list[Injection[Mapping[str, Any]]]:
    """Return the injections in the answer of the call ListInjections."""
    return [
        Injection(
            number=one.number,
            direction="in" if one.direction == wire.DIRECTION_IN else "out",
            priority=one.priority,
            keep=one.keep,
            name=one.name,
            writer=one.writer,
            pid=one.pid,
            ranges=tuple((part.offset, part.size, part.mask) for part in one.ranges),
            running=_running(one.running, one.name) if one.HasField("running") else None,
            source=one.source,
            cell=one.cell,
        )
        for one in found.injections
    ]


def _running(found: Any, name: str) -> Running[Mapping[str, Any]]:
    states = wire.Running.State
    state = states.Name(found.state).removeprefix("STATE_").lower() if found.state in states.values() else "unknown"
    declaration = declaration_from_wire(found.declaration, name)
    return Running(declaration, state, found.seed, found.runs, found.cycle, found.time_ns)
