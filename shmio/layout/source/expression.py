"""Read the whole numbers of declarations: bounds of arrays, lengths of strings, indices.

Constants may take their place, and so may sums and products of constants, as in classic SCL.
"""

from __future__ import annotations

from shmio.layout.model import MAX_DIMENSIONS
from shmio.layout.source.lexer import Kind
from shmio.layout.source.syntax import Bound, Bounds, Constant, Sum
from shmio.layout.source.token_cursor import Cursor
from shmio.layout.types import DEFAULT_STRING, INTEGERS, string_limit

LOWEST, HIGHEST = -(1 << 31), (1 << 31) - 1  # a DINT, as Siemens demands of bounds
_TYPED = INTEGERS | {"B", "W", "DW", "L"}
_BASES = {"2": "01", "8": "01234567", "16": "0123456789ABCDEF"}


def bounds(at: Cursor) -> Bounds:
    """Read ``[low..high, …]``; ``[*]`` has no bounds."""
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
    """Read ``[length]`` after STRING or WSTRING, if there is one."""
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
    """Read a whole number within 32 bits, or an expression of constants."""
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
    if not LOWEST <= sign * first <= HIGHEST:
        raise at.fault(at.token, f"expected {what} within 32 bits, found {sign * first}")
    return sign * first


def integer(at: Cursor, what: str) -> int:
    """Read a literal whole number: no constant, no expression."""
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
        return Constant(at.advance().text, position)
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
