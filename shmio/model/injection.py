"""Types of injections that programs, segments and endpoints share."""

from __future__ import annotations

from typing import Generic, TypeVar

import msgspec

from shmio.model.values import ROLES

DeclarationT = TypeVar("DeclarationT")


class Running(msgspec.Struct, Generic[DeclarationT], frozen=True):
    """State of a declared injection.

    Attributes:
        declaration: The declaration: in a segment a ``Declaration``, for programs a mapping with
            the keys of an ``[[injection]]`` table.
        state: ``waiting``, ``active``, ``over``, or ``lifted`` before its end.
        seed: Seed of all random numbers of the injection: the seed of the declaration, or else a
            random seed that the source chose.
        runs: Number of activations so far.
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
    """An existing injection. In lists, the innermost injection of each source comes first.

    Attributes:
        number: Number of the injection. Any program may lift the injection by its number.
        direction: ``out``: the injection covers what consumers see; ``in``: what the device gets.
        priority: An injection with a higher priority covers those with a lower one.
        keep: True if the injection stays when the program that created it ends.
        name: Name of the injection.
        writer: Number of the command queue through which the injection was created; 4294967295: the
            configuration declares the injection.
        pid: Process that created the injection; 0: the configuration declares the injection, or only
            ``cell`` knows the process.
        ranges: The covered bits, as (offset in bytes, size in bytes, mask).
        running: State of a declared injection; None: a program gives the values.
        source: Name of the source; empty in the segment, where the injection's block has the name.
        cell: Only in mirrors: the cell in which ``pid`` runs; empty if it runs in this instance.
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
    cell: str = ""

    @property
    def endpoint(self) -> str:
        """The process of the instance that the injection came through, such as ``grpc``; empty: there is none."""
        return ROLES.get(self.writer, "")


class Declared(msgspec.Struct, frozen=True):
    """A declared injection of a campaign. ``seed`` is random if the declaration has no seed."""

    source: str
    number: int
    name: str
    seed: int


class InjectionEvent(msgspec.Struct, frozen=True):
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


class Lifted(msgspec.Struct, frozen=True):
    """Result of lifting an injection.

    ``failure`` is the reason why the injection was not lifted; empty if it was lifted.
    """

    source: str
    number: int
    name: str
    failure: str = ""
