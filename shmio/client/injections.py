"""Injections as the list and the record of declared ones have them, and what is declared as a request. No I/O."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from shmio.errors import RemoteError
from shmio.messages import declaration_from_wire, declaration_to_wire
from shmio.wire import shmio_v1_pb2 as wire


def declare_request(declarations: Iterable[Mapping[str, Any]], *, keep: bool) -> Any:
    """For Declare; ValueRangeError: a key or a value that none can have."""
    tables = [declaration_to_wire(table, f"injection[{index}]") for index, table in enumerate(declarations)]
    return wire.DeclareRequest(declarations=tables, keep=keep)


@dataclass(frozen=True, slots=True)
class Running:
    """How a declared injection is. ``declaration``: as an ``[[injection]]`` table has it.

    ``state``: waiting, active, over or lifted; ``runs``: how often it has become active, the last time in ``cycle``, at
    ``time_ns`` of the instance's clock.
    """

    declaration: Mapping[str, Any]
    state: str
    seed: int
    runs: int
    cycle: int
    time_ns: int


@dataclass(frozen=True, slots=True)
class Injection:
    """An injection that stands. ``direction``: out or in; ``ranges``: (offset, size, mask) of what it covers.

    ``writer``: the command queue that it came by. ``pid``: 0, if by the configuration. ``running``: of declared ones.
    """

    source: str
    number: int
    direction: str
    priority: int
    keep: bool
    name: str
    pid: int
    ranges: tuple[tuple[int, int, int], ...]
    writer: int
    running: Running | None = None


@dataclass(frozen=True, slots=True)
class Declared:
    """A declared injection that was laid. ``seed``: its own, or the one that was drawn for it."""

    source: str
    number: int
    name: str
    seed: int


def declared(found: Any) -> tuple[Declared, ...]:
    """Of Declare's first answer. RemoteError: it is none."""
    if found is None or not found.HasField("declared"):
        raise RemoteError("the endpoint's first answer to Declare is none")
    return tuple(Declared(one.source, one.number, one.name, one.seed) for one in found.declared.injections)


@dataclass(frozen=True, slots=True)
class Happening:
    """What was done with a declared injection. ``what``: injected, activated, deactivated, lifted, or unknown.

    ``clock_ns``: when, on the instance's clock; ``utc_ns``: since 1970. ``frame``: the last one before it. ``run``:
    which of its activations. ``text``: why it was lifted.
    """

    source: str
    number: int
    what: str
    clock_ns: int
    utc_ns: int
    frame: int
    cycle: int
    run: int
    text: str


def happenings(found: Any) -> list[Happening]:
    """Of Declare's answers."""
    known = wire.Happening.Kind.values()
    return [
        Happening(
            one.source, one.number,
            wire.Happening.Kind.Name(one.kind).removeprefix("KIND_").lower() if one.kind in known else "unknown",
            one.clock_ns, one.utc_ns, one.frame, one.cycle, one.run, one.text,
        )
        for one in found.happenings
    ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Lifted:
    """An injection that was to be lifted. ``failure``: why it still stands; empty: it does not."""

    source: str
    number: int
    name: str
    failure: str


def lifted(found: Any) -> list[Lifted]:
    """Of an answer."""
    return [Lifted(one.source, one.number, one.name, one.failure) for one in found.lifted]


def injections(found: Any) -> list[Injection]:
    """Of a list's answer."""
    return [
        Injection(
            one.source, one.number, "in" if one.direction == wire.DIRECTION_IN else "out", one.priority, one.keep,
            one.name, one.pid, tuple((part.offset, part.size, part.mask) for part in one.ranges),
            one.writer, _running(one.running, one.name) if one.HasField("running") else None,
        )
        for one in found.injections
    ]  # fmt: skip


def _running(found: Any, name: str) -> Running:
    states = wire.Running.State
    state = states.Name(found.state).removeprefix("STATE_").lower() if found.state in states.values() else "unknown"
    declaration = declaration_from_wire(found.declaration, name)
    return Running(declaration, state, found.seed, found.runs, found.cycle, found.time_ns)
