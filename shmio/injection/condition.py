"""Compiles and evaluates conditions over registers, without Python's ``eval``; ``language.py`` parses them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final, NamedTuple

from shmio.injection import _numbers
from shmio.injection.language import Constant, Number, Operation, Reference, Tree, nodes, parse_condition

_SAVED_BITS: Final = 64
_PUSH: Final = 0
_LOAD: Final = 1
_CODES: Final = {
    name: code
    for code, name in enumerate(
        (
            *("not", "neg", "abs", "rising", "falling", "changed"),
            *("or", "and", "<", "<=", "==", "!=", ">", ">=", "+", "-", "*", "/", "mod"),
        ),
        start=2,
    )
}
"""The code of each operator and function, as in ``_numbers.c``."""


@dataclass
class Memory:
    """The last arguments of an expression's edge functions (rising, falling, changed).

    The memory is empty at first. An evaluation with an unknown value or a division by zero empties it.
    """

    seen: dict[int, Number] = field(default_factory=dict)
    """The last argument of each edge function, by the index of the edge function in the expression.

    An argument that is calculated from large integers may also be a fraction.
    """

    def to_save(self) -> dict[int, Number]:
        """Return the arguments that a snapshot can hold; the others begin anew."""
        return {
            place: value
            for place, value in self.seen.items()
            if isinstance(value, float) or (isinstance(value, int) and value.bit_length() < _SAVED_BITS)
        }


class Expression(NamedTuple):
    """A parsed condition, as a program for the stack machine in ``_numbers.c``.

    Each evaluation computes every operand, even if ``and`` or ``or`` does not need the operand. So the
    edge functions miss no change.
    """

    codes: bytes
    """The code of each step."""
    operands: tuple[Number, ...]
    """The number that a step puts on the stack, the index of the reference that it loads, or its own index."""
    references: tuple[str, ...]
    """The paths of the registers that the expression reads, as written in its text."""

    def holds(self, values: Sequence[Number | None], memory: Memory) -> bool:
        """Return whether the expression is true; False if that is unknown.

        Args:
            values: The value of each register in ``references``; None if the value is unknown.
            memory: The last arguments of the edge functions, which this updates.

        """
        return self.evaluate(values, memory) is True

    def evaluate(self, values: Sequence[Number | None], memory: Memory) -> bool | None:
        """Return whether the expression is true; None if that is unknown.

        It is unknown if a value is unknown, or if the expression divides by zero.

        Args:
            values: The value of each register in ``references``; None if the value is unknown.
            memory: The last arguments of the edge functions, which this updates.

        """
        return _numbers.evaluate(self.codes, self.operands, values, memory.seen)


@lru_cache(maxsize=1024)  # the runs of a search have the same texts
def parse(text: str) -> Expression:
    """Parse a condition, and return it as an expression that can be evaluated.

    Raises:
        ConfigError: The text is invalid. The message gives the position of the wrong character.

    """
    references: dict[str, int] = {}
    steps = [_step(node, place, references) for place, node in enumerate(nodes(parse_condition(text)))]
    return Expression(bytes(code for code, _ in steps), tuple(operand for _, operand in steps), tuple(references))


def _step(node: Tree, place: int, references: dict[str, int]) -> tuple[int, Number]:
    """Return the code and the operand of the step for a node; ``place`` is the index of the step."""
    match node:
        case Constant(value):
            return _PUSH, value
        case Reference(path):
            return _LOAD, references.setdefault(path, len(references))
        case Operation(name):
            return _CODES[name], place
