"""Injections, in the form that programs, segments and endpoints share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import msgspec

DeclarationT = TypeVar("DeclarationT")


class Running(msgspec.Struct, Generic[DeclarationT], frozen=True):
    """State of a declared injection.

    Attributes:
        declaration: The declaration: in a segment a ``Declaration``, for programs a mapping with
            the keys of an ``[[injection]]`` table.
        state: ``waiting``, ``active``, ``over``, or ``lifted`` before its end.
        seed: The run's only source of randomness. The source draws it if the declaration has none.
        runs: Number of activations.
        cycle: Cycle of the last activation.
        time_ns: The instance's clock at the last activation, in ns.
    """

    declaration: DeclarationT
    state: str
    seed: int
    runs: int = 0
    cycle: int = 0
    time_ns: int = 0


class Injection(msgspec.Struct, Generic[DeclarationT], frozen=True, omit_defaults=True):
    """A present injection. In lists, the innermost of each source comes first.

    Attributes:
        number: Number of the injection, with which any program may lift it.
        direction: ``out`` or ``in``.
        priority: Priority; the highest is outermost.
        keep: True if it stays when the program that laid it ends.
        name: Name of the injection.
        writer: Number of the command queue that it came from; 4294967295: from the configuration.
        pid: Process that laid it; 0: from the configuration.
        ranges: The covered bits as (offset, size, mask).
        running: State of a declared injection; None: a program gives the values.
        source: Name of the source; empty in the segment, where the block has the name.
    """

    number: int = msgspec.field(name="id")
    direction: str
    priority: int
    keep: bool
    name: str
    writer: int
    pid: int
    ranges: tuple[tuple[int, int, int], ...]
    running: Running[DeclarationT] | None = None
    source: str = ""


@dataclass(frozen=True, slots=True)
class Declared:
    """A declared injection that was laid; its ``seed`` is the declared one or a random one."""

    source: str
    number: int
    name: str
    seed: int


@dataclass(frozen=True, slots=True)
class Happening:
    """An event of a declared injection.

    Attributes:
        source: Name of the source.
        number: Number of the injection.
        what: Kind of event: ``injected``, ``activated``, ``deactivated``, ``lifted``, or
            ``unknown``.
        clock_ns: The instance's clock, in ns.
        utc_ns: UTC time, in ns.
        frame: Number of the last frame before the event.
        cycle: Cycle of the source's schedule.
        run: Number of the activation that the event is about.
        text: With ``lifted``: the reason.
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


@dataclass(frozen=True, slots=True)
class Lifted:
    """Result of lifting an injection.

    If it was not lifted, ``failure`` is the reason, else empty.
    """

    source: str
    number: int
    name: str
    failure: str = ""
