"""Injections as programs, segments and endpoints know them."""

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
        state: ``waiting``, ``active``, ``over``, or ``lifted`` before its time.
        seed: The run's only source of randomness; drawn by the source if the declaration has none.
        runs: How often it has become active.
        cycle: Cycle of the last activation.
        time_ns: The instance's clock at the last activation.
    """

    declaration: DeclarationT
    state: str
    seed: int
    runs: int = 0
    cycle: int = 0
    time_ns: int = 0


class Injection(msgspec.Struct, Generic[DeclarationT], frozen=True, omit_defaults=True):
    """A present injection; of each source the innermost comes first in lists.

    Attributes:
        number: Number of the injection, by which anybody may lift it.
        direction: ``out`` or ``in``.
        priority: Priority; the highest is outermost.
        keep: Whether it outlives the program that laid it.
        name: Name of the injection.
        writer: Command queue that it came from; 4294967295: the configuration.
        pid: Process that it came from; 0: the configuration.
        ranges: The covered bits as (offset, size, mask).
        running: State of a declared injection; None: a program gives the values.
        source: Name of the source; empty in the segment, where the block says it.
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
    """A declared injection that was laid; ``seed`` is its own, or a random one."""

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
        what: ``injected``, ``activated``, ``deactivated``, ``lifted``, or ``unknown``.
        clock_ns: Time of the instance's clock.
        utc_ns: UTC time.
        frame: Number of the last frame before the event.
        cycle: Cycle of the source's schedule.
        run: Which of its activations the event is about.
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
    """Result of lifting an injection; ``failure`` says why it was not lifted, else it is empty."""

    source: str
    number: int
    name: str
    failure: str = ""
