"""Convert lists of injections, declarations and their events between Python and the wire. No I/O."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from shmio.errors import RemoteError
from shmio.messages import declaration_from_wire, declaration_to_wire
from shmio.model.injection import Declared, Happening, Injection, Lifted, Running
from shmio.wire import shmio_v1_pb2 as wire


def declare_request(declarations: Iterable[Mapping[str, Any] | msgspec.Struct], *, keep: bool) -> Any:
    """Return the request for Declare; ValueRangeError for an invalid key or value."""
    given = [one if isinstance(one, Mapping) else msgspec.to_builtins(one) for one in declarations]
    tables = [declaration_to_wire(table, f"injection[{index}]") for index, table in enumerate(given)]
    return wire.DeclareRequest(declarations=tables, keep=keep)


def declared(found: Any) -> tuple[Declared, ...]:
    """Convert the first answer to Declare; RemoteError if it is invalid."""
    if found is None or not found.HasField("declared"):
        raise RemoteError("the endpoint's first answer to Declare is invalid")
    return tuple(Declared(one.source, one.number, one.name, one.seed) for one in found.declared.injections)


def happenings(found: Any) -> list[Happening]:
    """Convert the events in an answer to Declare."""
    known = wire.Happening.Kind.values()
    return [
        Happening(
            one.source, one.number,
            wire.Happening.Kind.Name(one.kind).removeprefix("KIND_").lower() if one.kind in known else "unknown",
            one.clock_ns, one.utc_ns, one.frame, one.cycle, one.run, one.text,
        )
        for one in found.happenings
    ]  # fmt: skip


def lifted(found: Any) -> list[Lifted]:
    """Convert the answer to LiftAll."""
    return [Lifted(one.source, one.number, one.name, one.failure) for one in found.lifted]


def injections(found: Any) -> list[Injection[Mapping[str, Any]]]:
    """Convert the answer to ListInjections."""
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
        )
        for one in found.injections
    ]


def _running(found: Any, name: str) -> Running[Mapping[str, Any]]:
    states = wire.Running.State
    state = states.Name(found.state).removeprefix("STATE_").lower() if found.state in states.values() else "unknown"
    declaration = declaration_from_wire(found.declaration, name)
    return Running(declaration, state, found.seed, found.runs, found.cycle, found.time_ns)
