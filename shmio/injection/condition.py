"""Compiles and evaluates conditions over registers, without Python's ``eval``; ``language.py`` parses them."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, cast

from shmio.injection.language import Constant, Number, Operation, Reference, Tree, nodes, parse_condition

_Two = Callable[[Number, Number], Number]
_OPERATORS: Final[dict[str, _Two]] = {
    "or": lambda left, right: bool(left) or bool(right),
    "and": lambda left, right: bool(left) and bool(right),
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "mod": operator.mod,
}
_FUNCTIONS: Final[dict[str, Callable[[Number], Number]]] = {"not": operator.not_, "neg": operator.neg, "abs": abs}
_EDGES: Final[dict[str, Callable[[Number, Number], bool]]] = {
    "rising": lambda before, now: not before and bool(now),
    "falling": lambda before, now: bool(before) and not now,
    "changed": lambda before, now: before != now,
}

_Stack = list[Number]
_Seen = dict[int, Number]
"""The last argument of each edge function, by the index of the edge function in the expression."""
_Step = Callable[[_Stack, Sequence[Number], _Seen], None]


@dataclass
class Memory:
    """The last arguments of an expression's edge functions (rising, falling, changed).

    The memory is empty at first. An evaluation with an unknown value or a division by zero empties it.
    """

    seen: _Seen = field(default_factory=dict)


class Expression(NamedTuple):
    """A parsed condition, as a program for a stack machine.

    Each evaluation computes every operand, even if ``and`` or ``or`` does not need the operand. So the
    edge functions miss no change.
    """

    steps: tuple[_Step, ...]
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
        stack: _Stack = []
        try:
            if None not in values:
                known = cast("Sequence[Number]", values)
                for step in self.steps:
                    step(stack, known, memory.seen)
                return bool(stack[-1])
        except ArithmeticError:
            pass
        memory.seen.clear()
        return None


def parse(text: str) -> Expression:
    """Parse a condition, and return it as an expression that can be evaluated.

    Raises:
        ConfigError: The text is invalid. The message gives the position of the wrong character.

    """
    steps: list[_Step] = []
    references: dict[str, int] = {}
    for node in nodes(parse_condition(text)):
        steps.append(_step(node, len(steps), references))
    return Expression(tuple(steps), tuple(references))


def _step(node: Tree, place: int, references: dict[str, int]) -> _Step:
    """Return the step for a node, whose operands are on the stack; ``place`` is the index of the step."""
    match node:
        case Constant(value):
            return _push(value)
        case Reference(path):
            return _load(references.setdefault(path, len(references)))
        case Operation(name, (_,)) if name in _EDGES:
            return _edge(_EDGES[name], place)
        case Operation(name, (_,)):
            return _one(_FUNCTIONS[name])
        case _:
            return _two(_OPERATORS[node.name])


# -- steps of the stack machine --------------------------------------------------------------------------------------


def _push(number: Number) -> _Step:
    return lambda stack, _values, _seen: stack.append(number)


def _load(place: int) -> _Step:
    return lambda stack, values, _seen: stack.append(values[place])


def _one(function: Callable[[Number], Number]) -> _Step:
    def step(stack: _Stack, _values: Sequence[Number], _seen: _Seen) -> None:
        stack[-1] = function(stack[-1])

    return step


def _two(function: Callable[[Number, Number], Number]) -> _Step:
    def step(stack: _Stack, _values: Sequence[Number], _seen: _Seen) -> None:
        right = stack.pop()
        stack[-1] = function(stack[-1], right)

    return step


def _edge(function: Callable[[Number, Number], bool], place: int) -> _Step:
    def step(stack: _Stack, _values: Sequence[Number], seen: _Seen) -> None:
        now, before = stack[-1], seen.get(place)
        stack[-1] = before is not None and function(before, now)
        seen[place] = now

    return step
