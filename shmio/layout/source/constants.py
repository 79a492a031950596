"""Whole numbers and constants of a source.

Bounds of arrays and lengths of strings are whole numbers, constants, or sums and products of both,
as in classic SCL. The parser reads them with the functions of this module. When a declaration is
placed, ``Constants`` evaluates them, and replaces names of constants in initial values.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from shmio.errors import Diagnostic, ShmioError
from shmio.layout.model import DEFAULT_STRING, INTEGERS, MAX_DIMENSIONS, string_limit
from shmio.layout.source.lexer import Cursor, Kind
from shmio.layout.source.syntax import Bound, Bounds, Constant, ConstantDeclaration, Sum

_LOWEST, _HIGHEST = -(1 << 31), (1 << 31) - 1  # range of a DINT, which Siemens requires of bounds
_TYPED = INTEGERS | {"B", "W", "DW", "L"}
_BASES = {"2": "01", "8": "01234567", "16": "0123456789ABCDEF"}


def bounds(at: Cursor) -> Bounds:
    """Read the bounds of an array, ``[low..high, …]``; for ``[*]``, return none."""
    at.expect("[", "'[' and the bounds of the array")
    dims: list[tuple[Bound, Bound]] = []
    flexible = False
    while True:
        start = at.token
        if at.accept("*"):
            flexible = True
        else:
            low = bound(at, "the lower bound")
            at.expect("..", "'..' between the bounds")
            high = bound(at, "the upper bound")
            if isinstance(low, int) and isinstance(high, int) and low > high:
                raise at.fault(start, f"expected a lower bound not above the upper, found {low}..{high}")
            dims.append((low, high))
        if not at.accept(","):
            break
        if len(dims) == MAX_DIMENSIONS:
            raise at.fault(start, f"an array has at most {MAX_DIMENSIONS} dimensions")
    at.expect("]", "']' after the bounds")
    return () if flexible else tuple(dims)


def string_length(at: Cursor, base: str) -> Bound:
    """Read ``[length]`` after STRING or WSTRING; return the default length if it is missing."""
    if not (at.token.is_punct("[") or at.token.is_punct("(")):
        return DEFAULT_STRING
    closing = "]" if at.advance().text == "[" else ")"
    token = at.token
    length = bound(at, "the string's length")
    if isinstance(length, int) and not 1 <= length <= string_limit(base):
        raise at.fault(token, f"expected a {base} length of 1 to {string_limit(base)}, found {token}")
    at.expect(closing, f"'{closing}' after the string's length")
    return length


def bound(at: Cursor, what: str) -> Bound:
    """Read a whole number within 32 bits, or an expression of constants; ``what`` names it in messages."""
    position = at.position
    terms: list[tuple[int, tuple[int | Constant, ...]]] = []
    sign = 1
    while True:
        while at.token.is_punct("-") or at.token.is_punct("+"):
            sign = -sign if at.advance().text == "-" else sign
        factors = [_factor(at, what)]
        while at.accept("*"):
            factors.append(_factor(at, what))
        terms.append((sign, tuple(factors)))
        if not (at.token.is_punct("-") or at.token.is_punct("+")):
            break
        sign = -1 if at.advance().text == "-" else 1
    (sign, (first, *rest)), *more = terms
    if rest or more or isinstance(first, Constant):
        return Sum(tuple(terms), position)
    if not _LOWEST <= sign * first <= _HIGHEST:
        raise at.fault(at.token, f"expected {what} within 32 bits, found {sign * first}")
    return sign * first


def integer(at: Cursor, what: str) -> int:
    """Read a literal whole number, not a constant or an expression; ``what`` names it in messages."""
    token = at.token
    value = bound(at, what)
    if not isinstance(value, int):
        raise at.fault(token, f"expected {what} as a number, found {token}")
    return value


def _factor(at: Cursor, what: str) -> int | Constant:
    position, token = at.position, at.token
    if token.kind is Kind.WORD and token.text.upper() in _TYPED:
        at.advance()
        if at.accept("#"):  # INT#5
            return _number(at, what)
        return Constant(token.text, position)
    at.accept("#")  # marks a name as local
    if at.token.kind in (Kind.WORD, Kind.QUOTED):
        name = at.advance().text
        if name == "_" and at.accept(".") and at.token.kind in (Kind.WORD, Kind.QUOTED):  # SIMATIC SD
            name = at.advance().text
        return Constant(name, position)
    return _number(at, what)


def _number(at: Cursor, what: str) -> int:
    token = at.token
    digits, base = token.text.replace("_", ""), 10
    if token.kind is not Kind.NUMBER or not digits.isdecimal():
        raise at.expected(f"{what}, a whole number")
    at.advance()
    if digits in _BASES and at.accept("#"):  # 16#FF
        base, allowed = int(digits), _BASES[digits]
        token = at.token
        digits = token.text.replace("_", "").upper()
        if token.kind not in (Kind.NUMBER, Kind.WORD) or not digits or not set(digits) <= set(allowed):
            raise at.expected(f"{what}, a whole number")
        at.advance()
    if len(digits) > 34 or (value := int(digits, base)) > 1 << 32:
        raise at.fault(token, f"expected {what} within 32 bits, found {token}")
    return value


_MAX_DEFINITIONS = 32  # maximum length of a chain of constants that refer to constants
_HUGE = 1 << 64
# Alternatives: text in single quotes, which is kept; "NAME"; #NAME; a value that is only a name.
_NAME = re.compile(r"""'(?:[^'$]|\$.)*'|"([^"]*)"|(?<![\w"])\#(\w+)|^\s*([^\W\d]\w*)\s*$""", re.DOTALL)
_MAX_VALUE = 4096  # characters; a longer initial value contains no names
_MAX_CONSTANT = 260  # characters of a constant's value: a STRING of full length


class BoundFault(ShmioError):  # noqa: N818  (the placer reports it; it never leaves the compiler)
    """The value of a bound cannot be computed."""

    def __init__(self, diagnostic: Diagnostic) -> None:
        super().__init__(diagnostic.message)
        self.diagnostic = diagnostic


class Constants:
    """Constants visible to a declaration: the block's own, then those of all sources."""

    def __init__(self, declared: Iterable[ConstantDeclaration] = (), outer: Constants | None = None) -> None:
        self._declared = {declaration.name.lower(): declaration for declaration in declared}
        self._outer = outer
        self._numbers: dict[str, int] = {}  # cache: many constants may refer to one

    def find(self, name: str) -> ConstantDeclaration | None:
        """Return the constant with this name, in upper or lower case; None if there is none."""
        scope = self._scope(name.lower())
        return scope._declared[name.lower()] if scope else None

    def _scope(self, key: str) -> Constants | None:
        if key in self._declared:
            return self
        return self._outer._scope(key) if self._outer else None

    def number(self, bound: Bound) -> int:
        """Return the value of a bound.

        Raises:
            BoundFault: A constant is unknown or not a whole number, or the value exceeds 32 bits.
        """
        if isinstance(bound, int):
            return bound
        value = self._sum(bound, 0)
        if not _LOWEST <= value <= _HIGHEST:
            raise BoundFault(bound.position.error(f"expected a whole number within 32 bits, found {value}"))
        return value

    def _sum(self, expression: Sum, depth: int) -> int:
        total = 0
        for sign, factors in expression.terms:
            product = sign
            for factor in factors:
                product *= factor if isinstance(factor, int) else self._constant(factor, depth)
                if abs(product) > _HUGE:
                    raise BoundFault(expression.position.error("expected a whole number within 32 bits"))
            total += product
        return total

    def _constant(self, constant: Constant, depth: int) -> int:
        name, at = constant.name, constant.position
        scope = self._scope(name.lower())
        if scope is None:
            what = f"the constant {name!r} is not in the sources; write its value here, or add a source with: "
            raise BoundFault(at.error(f'{what}VAR CONSTANT "{name}" : Int := …; END_VAR'))
        if (known := scope._numbers.get(name.lower())) is not None:
            return known
        number = scope._declared[name.lower()].number
        if number is None:
            raise BoundFault(at.error(f"expected a whole number, but the constant {name!r} is not one"))
        if depth >= _MAX_DEFINITIONS:
            raise BoundFault(at.error(f"the definition of the constant {name!r} uses itself"))
        value = number if isinstance(number, int) else scope._sum(number, depth + 1)
        scope._numbers[name.lower()] = value
        return value

    def substitute(self, text: str | None) -> str | None:
        """Return an initial value with the names of known constants replaced by their values."""
        if text is None or len(text) > _MAX_VALUE:
            return text
        result = _NAME.sub(lambda match: self._value(match, 0), text)
        return result if len(result) <= _MAX_VALUE else text

    def _value(self, match: re.Match[str], depth: int) -> str:
        name = match[1] or match[2] or match[3]
        declaration = self.find(name) if name else None
        if declaration is None or depth >= _MAX_DEFINITIONS:
            return match[0]
        if _NAME.fullmatch(declaration.value):  # the name of another constant
            return _NAME.sub(lambda inner: self._value(inner, depth + 1), declaration.value)
        return match[0] if len(declaration.value) > _MAX_CONSTANT else declaration.value
