"""The language of conditions and formulas: its grammar, and a parser that turns a text into a tree.

Here are two conditions and a formula, and the grammar:

::

    cell/Inputs/12 > 500 and not cell/Outputs/13.%X0
    rising("cell/Robot 800/Axs1_Pos" >= 90) or abs(cell/R3.L2) > 1.5e-3
    always(rise(cell/Start) implies eventually[0, 2] cell/Lamp)

    expression = disjunction ["implies" expression]
    disjunction = conjunction {"or" conjunction}
    conjunction = until {"and" until}
    until = negation ["until" [bounds] negation]
    negation = {"not" | ("always" | "eventually" | "historically" | "once") [bounds]} comparison
    comparison = sum [("==" | "=" | "!=" | "<>" | "<" | "<=" | ">" | ">=") sum]
    sum = product {("+" | "-") product}
    product = factor {("*" | "/" | "mod") factor}
    factor = "-" factor | number | "true" | "false" | "good" | "uncertain" | "bad" | register
           | "(" expression ")" | function "(" expression ")"
    function = "abs" | "rising" | "falling" | "changed"
             | "rise" | "fall" | "rate" | "quality" | "age" | "raw"
    bounds = "[" number "," number "]"

Only formulas have ``implies``, ``until`` and the other temporal operators, the functions from
``rise`` to ``raw``, and the words ``good``, ``uncertain`` and ``bad``. In a condition, all these
words are names of registers.

A register is a path. Put it in quotes if it has characters other than letters, digits and
``_ . / % :``. A path may contain ``/``, so put blanks around the ``/`` of a division. Numbers are
written as in S7: ``16#FF``, ``2#1010``, ``1.5e3``. Bounds are times in s.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from functools import lru_cache
from typing import Final

from shmio.errors import ConfigError

Number = bool | int | float

MAX_LENGTH: Final = 1000
MAX_NODES: Final = 200
MAX_DEPTH: Final = 24
MAX_DIGITS: Final = 40
MAX_BOUND_S: Final = 1_000_000

_TOKEN: Final = re.compile(
    r"""\s*(?:(?P<number>(?:16\#[0-9A-Fa-f_]+|2\#[01_]+|[0-9][0-9_]*(?:\.[0-9]+)?(?:[eE][+-]?[0-9]{1,3})?)(?![\w.\#]))
    |(?P<word>[^\W\d][\w./%:]*)
    |(?P<quoted>"[^"]*"|'[^']*')
    |(?P<sign><=|>=|==|!=|<>|[-+*/()<>=\[\],]))""",
    re.VERBOSE,
)
_EXACT_BITS: Final = 128
"""A whole number of at most this many bits is exact, even if it is written like 9.3e18."""
_NO_NUMBER: Final = re.compile(r"(?P<number>[0-9][0-9_.]*)(?P<unit>[\w.#]*)")
_UNITS_S: Final = {"s": 1.0, "ms": 0.001, "us": 1e-6, "min": 60.0, "m": 60.0, "h": 3600.0}
COMPARISONS: Final = ("==", "=", "!=", "<>", "<", "<=", ">", ">=")
_FUNCTIONS: Final = frozenset({"abs", "rising", "falling", "changed"})
_OF_FORMULAS: Final = frozenset({"rise", "fall", "rate", "quality", "age", "raw"})
_WINDOWS: Final = frozenset({"always", "eventually", "historically", "once"})
TEMPORAL: Final = _WINDOWS | {"until"}
"""The temporal operators. Those in ``_WINDOWS`` have one operand; ``until`` has two."""
_QUALITIES: Final = {"bad": 0, "uncertain": 1, "good": 2}
_KEYWORDS: Final = frozenset({"and", "or", "not", "mod", "true", "false"}) | _FUNCTIONS
_FORMULA_KEYWORDS: Final = _KEYWORDS | _OF_FORMULAS | TEMPORAL | {"implies", *_QUALITIES}


@dataclass(frozen=True, slots=True)
class Constant:
    """A number in a condition or formula."""

    value: Number


@dataclass(frozen=True, slots=True)
class Reference:
    """A register, by its path as written."""

    path: str
    at: int = field(default=1, compare=False)
    """Position of the path's first character in the text of the condition or formula, counted from 1."""


@dataclass(frozen=True, slots=True)
class Operation:
    """An operator or a function with its operands.

    ``name`` is the operator or function as written, in lower case, with these exceptions: ``neg``
    stands for a minus sign before an operand, and ``==`` and ``!=`` also stand for ``=`` and ``<>``.
    """

    name: str
    operands: tuple[Tree, ...]
    bounds_ns: tuple[int, int] | None = None
    """Bounds of a temporal operator, in ns; None if it has none."""
    at: int = field(default=1, compare=False)


Tree = Constant | Reference | Operation


def nodes(tree: Tree) -> Iterator[Tree]:
    """Iterate over all nodes of a tree from left to right, with operands before their operator."""
    if isinstance(tree, Operation):
        for operand in tree.operands:
            yield from nodes(operand)
    yield tree


def parse_condition(text: str) -> Tree:
    """Parse the text of a condition.

    Raises:
        ConfigError: The text is invalid. The message gives the position of the wrong character.

    """
    return _Parser(text, "condition", _KEYWORDS).whole()


@lru_cache(maxsize=1024)  # the runs of a search have the same texts
def parse_formula(text: str) -> Tree:
    """Parse the text of a formula.

    Raises:
        ConfigError: The text is invalid. The message gives the position of the wrong character.

    """
    return _Parser(text, "formula", _FORMULA_KEYWORDS).whole()


def _without_unit(wrong: re.Match[str]) -> str:
    """Return what to write instead of a word that begins with a digit, such as ``500ms``."""
    factor = _UNITS_S.get(wrong["unit"])
    with suppress(ValueError):
        if factor is not None:
            return f"; times are in s, without a unit: write {float(wrong['number']) * factor:.12g}"
    return "; put a path that begins with a digit in quotes"


class _Parser:
    """A recursive-descent parser with a method for each rule of the grammar."""

    def __init__(self, text: str, what: str, keywords: Collection[str]) -> None:
        if len(text) > MAX_LENGTH:
            raise ConfigError(f"a {what} may have at most {MAX_LENGTH} characters, but this one has {len(text)}")
        self._text = text
        self._what = what
        self._keywords = keywords
        self._at = 0
        self._depth = 0
        self._count = 0
        self._advance()

    def whole(self) -> Tree:
        tree = self._implication()
        if self._kind:
            raise self._expected(f"'and', 'or' or the end of the {self._what}")
        return tree

    def _advance(self) -> None:
        """Read the next token: set its kind and its text.

        At the end of the text, the kind is empty. The text of a keyword is in lower case.
        """
        self._start = self._at
        rest = self._text[self._at :]
        if not rest.strip():
            self._kind, self._word, self._start = "", "", len(self._text)
            return
        match = _TOKEN.match(self._text, self._at)
        self._start += len(rest) - len(rest.lstrip())
        if match is None:
            if wrong := _NO_NUMBER.match(self._text, self._start):
                raise ConfigError(f"at character {self._start + 1}: {wrong[0]!r} is not a number{_without_unit(wrong)}")
            self._word = self._text[self._start]
            raise self._expected("a register, a number or an operator")
        self._kind, self._at = str(match.lastgroup), match.end()
        self._word = match[self._kind]
        if self._kind == "word" and self._word.lower() in self._keywords:
            self._kind, self._word = "keyword", self._word.lower()

    def _expected(self, what: str) -> ConfigError:
        found = repr(self._word) if self._word else "the end"
        return ConfigError(f"at character {self._start + 1}: expected {what}, found {found}")

    def _is(self, *words: str) -> bool:
        return self._kind in ("keyword", "sign") and self._word in words

    def _counted(self, tree: Tree) -> Tree:
        self._count += 1
        if self._count > MAX_NODES:
            raise ConfigError(f"the {self._what} has more than {MAX_NODES} parts; shorten it")
        return tree

    def _operation(self, name: str, *operands: Tree, bounds: tuple[int, int] | None = None, at: int = 0) -> Tree:
        return self._counted(Operation(name, operands, bounds, at + 1))

    def _chain(self, operand: Callable[[], Tree], *operators: str) -> Tree:
        """Parse operands with left-associative operators between them."""
        left = operand()
        while self._is(*operators):
            name, at = self._word, self._start
            self._advance()
            left = self._operation(name, left, operand(), at=at)
        return left

    def _implication(self) -> Tree:
        left = self._either()
        if not self._is("implies"):
            return left
        at = self._start
        self._advance()
        return self._operation("implies", left, self._nested(self._implication), at=at)

    def _either(self) -> Tree:
        return self._chain(self._both, "or")

    def _both(self) -> Tree:
        return self._chain(self._until, "and")

    def _until(self) -> Tree:
        left = self._negation()
        if not self._is("until"):
            return left
        at = self._start
        self._advance()
        bounds = self._bounds()
        return self._operation("until", left, self._negation(), bounds=bounds, at=at)

    def _negation(self) -> Tree:
        if not self._is("not", *_WINDOWS):
            return self._comparison()
        name, at, bounds = self._word, self._start, None
        self._advance()
        if name != "not":
            bounds = self._bounds()
        return self._operation(name, self._nested(self._negation), bounds=bounds, at=at)

    def _bounds(self) -> tuple[int, int] | None:
        if not self._is("["):
            return None
        self._advance()
        at = self._start
        low = self._bound(",")
        high = self._bound("]")
        if low > high:
            raise ConfigError(f"at character {at + 1}: the first bound is above the second one")
        return low, high

    def _bound(self, end: str) -> int:
        if self._kind != "number":
            raise self._expected("a time in s")
        seconds = self._number()
        if seconds > MAX_BOUND_S:
            raise ConfigError(f"at character {self._start + 1}: a bound is at most {MAX_BOUND_S} s")
        self._advance()
        if not self._is(end):
            unit = "; a bound is a time in s, without a unit" if self._word in _UNITS_S else ""
            raise ConfigError(f"{self._expected(repr(end))}{unit}")
        self._advance()
        return round(seconds * 1_000_000_000)

    def _comparison(self) -> Tree:
        left = self._sum()
        if not self._is(*COMPARISONS):
            return left
        name, at = {"=": "==", "<>": "!="}.get(self._word, self._word), self._start
        self._advance()
        return self._operation(name, left, self._sum(), at=at)

    def _sum(self) -> Tree:
        return self._chain(self._product, "+", "-")

    def _product(self) -> Tree:
        return self._chain(self._factor, "*", "/", "mod")

    def _nested(self, read: Callable[[], Tree]) -> Tree:
        if self._depth == MAX_DEPTH:
            raise ConfigError(f"at character {self._start + 1}: more than {MAX_DEPTH} nested levels")
        self._depth += 1
        tree = read()
        self._depth -= 1
        return tree

    def _factor(self) -> Tree:
        word, at = self._word, self._start
        if self._is("-"):
            self._advance()
            return self._operation("neg", self._nested(self._factor), at=at)
        if self._is("("):
            return self._parentheses()
        if self._is("true", "false"):
            self._advance()
            return self._counted(Constant(word == "true"))
        if self._is(*_QUALITIES):
            self._advance()
            return self._counted(Constant(_QUALITIES[word]))
        if self._is(*_FUNCTIONS, *_OF_FORMULAS):
            self._advance()
            if not self._is("("):
                raise self._expected(f"'(' after {word!r}")
            return self._operation(word, self._parentheses(), at=at)
        if self._kind == "number":
            number = self._number()
            self._advance()
            return self._counted(Constant(number))
        if self._kind in ("word", "quoted"):
            path, plain = (word[1:-1], False) if self._kind == "quoted" else (word, True)
            self._advance()
            if plain and word.endswith("/"):
                raise ConfigError(f"at character {at + len(word)}: put a blank before the '/' of a division")
            if plain and word.lower() in _FORMULA_KEYWORDS and self._is("[", "("):
                raise ConfigError(f"at character {at + 1}: a {self._what} has no {word!r}; only expectations have it")
            return self._counted(Reference(path, at + 1))
        raise self._expected("a register or a number")

    def _parentheses(self) -> Tree:
        self._advance()
        tree = self._nested(self._implication)
        if not self._is(")"):
            raise self._expected("')'")
        self._advance()
        return tree

    def _number(self) -> Number:
        digits = self._word.replace("_", "")
        if len(digits) > MAX_DIGITS:
            raise ConfigError(f"at character {self._start + 1}: a number has at most {MAX_DIGITS} digits")
        base, sharp, rest = digits.partition("#")
        if sharp:
            if not rest:
                raise self._expected("digits after the '#'")
            return int(rest, int(base))
        if not set(digits) & set(".eE"):
            return int(digits)
        exact = Fraction(digits)
        whole = exact.denominator == 1 and exact.numerator.bit_length() <= _EXACT_BITS
        return exact.numerator if whole and exact >= 1 << 53 else float(digits)
