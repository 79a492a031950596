"""Checks injections that any file declares, as far as possible without a layout."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, TypeVar

import msgspec

from shmio.config.model import Declaration, Expectation
from shmio.errors import ConfigError
from shmio.wording import already_named

MAX_DECLARATIONS: Final = 256
"""Maximum number of declarations in one file."""
_Table = TypeVar("_Table", Declaration, Expectation)
MAX_DIMENSIONS: Final = 6  # of an array; the same as in layout/model.py, which cannot be imported here


class Keys(msgspec.Struct, frozen=True):
    """The keys that an operation takes, besides the keys that every injection has.

    Attributes:
        needed: Required keys.
        choice: Alternative sets of keys: exactly one of these sets must be given, completely.
        free: Optional keys.

    """

    needed: tuple[str, ...] = ()
    choice: tuple[tuple[str, ...], ...] = ()
    free: tuple[str, ...] = ()

    @property
    def known(self) -> set[str]:
        """All keys that the operation takes, required or optional."""
        return {*self.needed, *self.free, *(key for keys in self.choice for key in keys)}


KEYS: Final[Mapping[str, Keys]] = {
    "set": Keys(("value",), free=("probability",)),
    "offset": Keys(("value",), free=("probability",)),
    "scale": Keys(("value",), free=("probability",)),
    "clamp": Keys(free=("min", "max", "probability")),
    "noise": Keys(("amplitude",), free=("distribution", "probability")),
    "random": Keys(choice=(("values",), ("min", "max")), free=("probability",)),
    "freeze": Keys(),
    "delay": Keys(choice=(("delay_ms",), ("delay_cycles",))),
    "drop": Keys(free=("probability",)),
    "flip": Keys(free=("bits", "probability")),
}
_OPERANDS: Final = tuple(dict.fromkeys(key for keys in KEYS.values() for key in sorted(keys.known)))


def with_seed(declaration: Declaration, seed: int) -> Declaration:
    """Return the declaration with this seed, or unchanged if it has a seed of its own."""
    return msgspec.structs.replace(declaration, seed=seed) if declaration.seed is None else declaration


def shifted(declaration: Declaration, by_s: float) -> Declaration:
    """Return the declaration with its start and end ``by_s`` seconds later."""
    end_s = None if declaration.end_s is None else declaration.end_s + by_s
    return msgspec.structs.replace(declaration, start_s=(declaration.start_s or 0) + by_s, end_s=end_s)


def check_declarations(declarations: Sequence[Declaration]) -> None:
    """Check declarations, as far as possible without a layout.

    Raises:
        ConfigError: A declaration is faulty; the message describes the first fault, and begins
            with the faulty key.

    """
    for fault in declaration_faults(declarations):
        raise ConfigError(fault)


def declaration_faults(declarations: Sequence[Declaration]) -> Iterator[str]:
    """Yield a message for each fault that can be found without a layout; each begins with the faulty key."""
    return faults_of_tables("injection", "injections", declarations, MAX_DECLARATIONS, contradictions)


def faults_of_tables(
    key: str, what: str, tables: Sequence[_Table], most: int, contradictions_of: Callable[[_Table], Iterable[str]]
) -> Iterator[str]:
    """Yield a message for each fault in tables of one kind, such as ``[[injection]]``.

    Each message begins with the faulty key.

    Args:
        key: The key of the tables, such as ``injection``.
        what: The noun for the tables in the plural, such as ``injections``.
        tables: The tables. No two may have the same name.
        most: Maximum number of tables.
        contradictions_of: Returns a message for each contradiction within a table; each begins
            with the key within the table.

    """
    if len(tables) > most:
        yield f"{key}: there are {len(tables)} {what}, but at most {most} are allowed"
        return
    seen: dict[str, int] = {}
    for index, table in enumerate(tables):
        first = seen.setdefault(table.name, index)
        if first != index:
            yield f"{key}[{index}].name: {already_named(table.name, f'{key}[{first}]')}"
        for contradiction in contradictions_of(table):
            yield f"{key}[{index}].{contradiction}"


def contradictions(declaration: Declaration) -> Iterator[str]:
    """Yield a message for each contradiction within a declaration; each begins with the faulty key."""
    operation = declaration.operation
    keys = KEYS[operation]
    given = {key for key in _OPERANDS if getattr(declaration, key) is not None}
    for key in sorted(given - keys.known):
        takers = ", ".join(name for name, other in KEYS.items() if key in other.known)
        yield f"{key}: operation {operation!r} has no such key; the key is for {takers}"
    for key in keys.needed:
        if key not in given:
            yield f"{key}: this key is needed for operation {operation!r}"
    begun = [choice for choice in keys.choice if given & set(choice)]
    if keys.choice and (len(begun) != 1 or not given.issuperset(begun[0])):
        ways = ", or ".join(" and ".join(choice) for choice in keys.choice)
        yield f"{keys.choice[0][0]}: operation {operation!r} needs {ways}"
    if operation == "clamp" and not given & {"min", "max"}:
        yield "min: operation 'clamp' needs min, max, or both"
    for key in sorted(given):
        if fault := _fault(getattr(declaration, key)):
            yield f"{key}: {fault}"
    if declaration.min is not None and declaration.max is not None and declaration.min > declaration.max:
        yield f"min: {declaration.min:g} is above max, {declaration.max:g}"
    if declaration.end_s is not None and declaration.end_s <= (declaration.start_s or 0):
        yield f"end_s: {declaration.end_s:g} is not after start_s, {declaration.start_s or 0:g}"
    if declaration.times is not None and declaration.when is None:
        yield "times: this key is only for an injection with a condition, in `when`"


def _fault(value: Any, depth: int = 0) -> str:
    """Return why a value cannot be written to a register or compared with one; "" if it can."""
    if isinstance(value, list):
        if depth > MAX_DIMENSIONS:
            return f"lists are nested more than {MAX_DIMENSIONS} deep"
        return next((fault for item in value if (fault := _fault(item, depth + 1))), "")
    if isinstance(value, bool | str):
        return ""
    if isinstance(value, float) and not math.isfinite(value):
        return f'{value} is not a number; for a REAL write it as text, "NaN" or "Infinity"'
    if isinstance(value, int) and not -(2**63) <= value < 2**64:
        return "the number has more than 64 bits"
    return "" if isinstance(value, int | float) else "expected numbers, text, true or false, or lists of them"
