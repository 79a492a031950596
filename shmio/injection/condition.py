"""Parses and evaluates conditions over registers, without Python's ``eval``.

Two examples and the grammar:

::

    cell/Inputs/12 > 500 and not cell/Outputs/13.%X0
    rising("cell/Robot 800/Axs1_Pos" >= 90) or abs(cell/R3.L2) > 1.5e-3

    expression = conjunction {"or" conjunction}
    conjunction = negation {"and" negation}
    negation = {"not"} comparison
    comparison = sum [("==" | "=" | "!=" | "<>" | "<" | "<=" | ">" | ">=") sum]
    sum = product {("+" | "-") product}
    product = factor {("*" | "/" | "mod") factor}
    factor = "-" factor | number | "true" | "false" | register | "(" expression ")"
           | ("abs" | "rising" | "falling" | "changed") "(" expression ")"

A register is a path. Put it in quotes if it has characters other than letters, digits and
``_ . / % :``. A path may contain ``/``, so put blanks around the ``/`` of a division. Numbers are
written as in S7: ``16#FF``, ``2#1010``, ``1.5e3``.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from shmio.errors import ConfigError

Number = bool | int | float

MAX_LENGTH: Final = 1000
MAX_NODES: Final = 200
MAX_DEPTH: Final = 24
MAX_DIGITS: Final = 40

_TOKEN: Final = re.compile(
    r"""\s*(?:(?P<number>(?:16\#[0-9A-Fa-f_]+|2\#[01_]+|[0-9][0-9_]*(?:\.[0-9]+)?(?:[eE][+-]?[0-9]{1,3})?)(?![\w.\#]))
    |(?P<word>[^\W\d][\w./%:]*)
    |(?P<quoted>"[^"]*"|'[^']*')
    |(?P<sign><=|>=|==|!=|<>|[-+*/()<>=]))""",
    re.VERBOSE,
)
_KEYWORDS: Final = frozenset({"and", "or", "not", "mod", "true", "false", "abs", "rising", "falling", "changed"})
_Operators = dict[str, Callable[[Number, Number], Number]]
_DISJUNCTION: Final[_Operators] = {"or": lambda left, right: bool(left) or bool(right)}
_CONJUNCTION: Final[_Operators] = {"and": lambda left, right: bool(left) and bool(right)}
_COMPARISONS: Final[_Operators] = {
    "==": operator.eq,
    "=": operator.eq,
    "!=": operator.ne,
    "<>": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_SUMS: Final[_Operators] = {"+": operator.add, "-": operator.sub}
_PRODUCTS: Final[_Operators] = {
    "*": operator.mul,
    "/": operator.truediv,
    "mod": operator.mod,
}
_EDGES: Final[dict[str, Callable[[Number, Number], bool]]] = {
    "rising": lambda before, now: not before and bool(now),
    "falling": lambda before, now: bool(before) and not now,
    "changed": lambda before, now: before != now,
}

_Stack = list[Number]
_Seen = dict[int, Number]
"""The last argument of each edge function, by the index of the function in the expression."""
_Step = Callable[[_Stack, Sequence[Number], _Seen], None]


@dataclass
class Memory:
    """The last arguments of an expression's edge functions (rising, falling, changed).

    The memory is empty at first. An unknown value or a division by zero empties it again.
    """

    seen: _Seen = field(default_factory=dict)


class Expression(NamedTuple):
    """A parsed condition, as a program for a stack machine.

    Each evaluation computes every operand, even if ``and`` or ``or`` does not need it. So the edge
    functions miss no change.
    """

    steps: tuple[_Step, ...]
    references: tuple[str, ...]
    """The registers that the expression reads, as written."""

    def holds(self, values: Sequence[Number | None], memory: Memory) -> bool:
        """Return whether the expression is known to be true.

        Args:
            values: The value of each reference; None if it is unknown.
            memory: The last arguments of the edge functions. They are updated.

        """
        return self.evaluate(values, memory) is True

    def evaluate(self, values: Sequence[Number | None], memory: Memory) -> bool | None:
        """Return whether the expression is true.

        The result is None if a value is unknown, or if the expression divides by zero.

        Args:
            values: The value of each reference; None if it is unknown.
            memory: The last arguments of the edge functions. They are updated.

        """
        known = [value for value in values if value is not None]
        stack: _Stack = []
        try:
            if len(known) == len(values):
                for step in self.steps:
                    step(stack, known, memory.seen)
                return bool(stack[-1])
        except ArithmeticError:
            pass
        memory.seen.clear()
        return None


def parse(text: str) -> Expression:
    """Parse a condition.

    Raises:
        ConfigError: The text is invalid. The message gives the position of the wrong character.

    """
    if len(text) > MAX_LENGTH:
        raise ConfigError(f"a condition may have at most {MAX_LENGTH} characters, but this one has {len(text)}")
    return _Parser(text).whole()


class _Parser:
    """A recursive-descent parser with a method for each rule of the grammar."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._depth = 0
        self._steps: list[_Step] = []
        self._references: dict[str, int] = {}
        self._advance()

    def whole(self) -> Expression:
        self._either()
        if self._kind:
            raise self._expected("'and', 'or' or the end of the condition")
        return Expression(tuple(self._steps), tuple(self._references))

    def _advance(self) -> None:
        """Read the next token: set its kind and its text.

        At the end of the condition, the kind is empty. The text of a keyword is in lower case.
        """
        self._start = self._at
        rest = self._text[self._at :]
        if not rest.strip():
            self._kind, self._word, self._start = "", "", len(self._text)
            return
        match = _TOKEN.match(self._text, self._at)
        self._start += len(rest) - len(rest.lstrip())
        if match is None:
            self._word = self._text[self._start]
            raise self._expected("a register, a number or an operator")
        self._kind, self._at = str(match.lastgroup), match.end()
        self._word = match[self._kind]
        if self._kind == "word" and self._word.lower() in _KEYWORDS:
            self._kind, self._word = "keyword", self._word.lower()

    def _expected(self, what: str) -> ConfigError:
        found = repr(self._word) if self._word else "the end"
        return ConfigError(f"at character {self._start + 1}: expected {what}, found {found}")

    def _is(self, *words: str) -> bool:
        return self._kind in ("keyword", "sign") and self._word in words

    def _emit(self, step: _Step) -> None:
        if len(self._steps) == MAX_NODES:
            raise ConfigError(f"the condition has more than {MAX_NODES} parts: shorten it")
        self._steps.append(step)

    def _chain(self, operand: Callable[[], None], operators: _Operators) -> None:
        """Parse operands with left-associative operators between them."""
        operand()
        while self._is(*operators):
            function = operators[self._word]
            self._advance()
            operand()
            self._emit(_two(function))

    def _either(self) -> None:
        self._chain(self._both, _DISJUNCTION)

    def _both(self) -> None:
        self._chain(self._negation, _CONJUNCTION)

    def _negation(self) -> None:
        if not self._is("not"):
            self._comparison()
            return
        self._advance()
        self._nested(self._negation)
        self._emit(_one(operator.not_))

    def _comparison(self) -> None:
        self._sum()
        if self._is(*_COMPARISONS):
            compare = _COMPARISONS[self._word]
            self._advance()
            self._sum()
            self._emit(_two(compare))

    def _sum(self) -> None:
        self._chain(self._product, _SUMS)

    def _product(self) -> None:
        self._chain(self._factor, _PRODUCTS)

    def _nested(self, read: Callable[[], None]) -> None:
        if self._depth == MAX_DEPTH:
            raise ConfigError(f"at character {self._start + 1}: more than {MAX_DEPTH} nested levels")
        self._depth += 1
        read()
        self._depth -= 1

    def _factor(self) -> None:
        if self._is("-"):
            self._advance()
            self._nested(self._factor)
            self._emit(_one(operator.neg))
        elif self._is("("):
            self._parentheses()
        elif self._is("true", "false"):
            self._emit(_push(self._word == "true"))
            self._advance()
        elif self._is("abs", *_EDGES):
            function = self._word
            self._advance()
            if not self._is("("):
                raise self._expected(f"'(' after {function!r}")
            self._parentheses()
            self._emit(_one(abs) if function == "abs" else _edge(_EDGES[function], len(self._steps)))
        elif self._kind == "number":
            self._emit(_push(self._number()))
            self._advance()
        elif self._kind in ("word", "quoted"):
            path = self._word[1:-1] if self._kind == "quoted" else self._word
            self._emit(_load(self._references.setdefault(path, len(self._references))))
            self._advance()
        else:
            raise self._expected("a register or a number")

    def _parentheses(self) -> None:
        self._advance()
        self._nested(self._either)
        if not self._is(")"):
            raise self._expected("')'")
        self._advance()

    def _number(self) -> Number:
        digits = self._word.replace("_", "")
        if len(digits) > MAX_DIGITS:
            raise ConfigError(f"at character {self._start + 1}: a number has at most {MAX_DIGITS} digits")
        base, sharp, rest = digits.partition("#")
        if sharp:
            if not rest:
                raise self._expected("digits after the '#'")
            return int(rest, int(base))
        return float(digits) if set(digits) & set(".eE") else int(digits)


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
