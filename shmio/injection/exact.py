"""Exact arithmetic for the numbers that a double would round: integers of more than 50 bits, and what they become.

Conditions (``_numbers.c``) and formulas (``judging/operators.py``) use it, so that a comparison with a
LINT, ULINT or LWORD is right for every value. Results are integers, or fractions where need be.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from fractions import Fraction
from math import copysign
from typing import Any, Final

import numpy as np
import numpy.typing as npt

Exact = int | float | Fraction
"""A number; a float only if it is infinite or NaN, or comes from a register."""

LARGE: Final = 1 << 50
"""Magnitude from which an integer is calculated with exactly, also if the other operand is a float.

As in ``_numbers.c``.
"""
WHOLE: Final = 1 << 53
"""Magnitude up to which a double represents each integer."""
MAX_BITS: Final = 1 << 14
"""Maximum number of bits of a fraction's numerator or denominator."""
_MOST: Final = float(np.finfo(np.float64).max)
_TINY: Final = 5e-324
_OPERATIONS: Final[tuple[Callable[[Any, Any], Any], ...]] = (
    operator.add, operator.sub, operator.mul, operator.truediv, operator.mod,
)  # fmt: skip
ADD, SUBTRACT, MULTIPLY, DIVIDE, MODULO = range(len(_OPERATIONS))
"""The operations, in the order of ``_numbers.c``."""


def calculate(operation: int, left: Exact, right: Exact) -> Exact:
    """Return the exact result of an operation on two numbers.

    Raises:
        ArithmeticError: The operation divides by zero, or the result is too long.

    """
    function = _OPERATIONS[operation]
    try:
        first, second = _rational(left), _rational(right)
    except (OverflowError, ValueError):  # infinite or NaN
        found: Exact = function(float(left), float(right))
        return found
    if operation == DIVIDE:
        first = Fraction(first)
    result: int | Fraction = function(first, second)
    if isinstance(result, Fraction):
        if result.denominator == 1:
            return result.numerator
        if max(result.numerator.bit_length(), result.denominator.bit_length()) > MAX_BITS:
            raise OverflowError("the fraction is too long")
    return result


def _rational(number: Exact) -> int | Fraction:
    return Fraction(number) if isinstance(number, float) else number


# -- arrays ------------------------------------------------------------------------------------------------------------

Numbers = npt.NDArray[Any]
"""An array of float64; or of objects (:data:`Exact`), if it has integers beyond :data:`LARGE`."""


def integers(values: npt.NDArray[np.float64], rests: npt.NDArray[np.float64]) -> Numbers:
    """Return integers that are sums of two floats: ``values`` itself if no integer is beyond :data:`LARGE`."""
    beyond = np.abs(values) >= LARGE
    if not beyond.any():
        return values
    found = values.astype(object)
    pairs = zip(values[beyond].tolist(), rests[beyond].tolist(), strict=True)
    found[beyond] = [int(value) + int(rest) for value, rest in pairs]
    return found


def split(integers_: npt.NDArray[np.int64] | npt.NDArray[np.uint64]) -> tuple[npt.NDArray[np.float64], ...]:
    """Return 64-bit integers as floats, and what these floats lack; the sum of both is exact."""
    high = (integers_ >> 32).astype(np.float64) * 2.0**32
    low = (integers_ & 0xFFFFFFFF).astype(np.float64)
    values = high + low
    return values, low - (values - high)


def is_exact(number: object) -> bool:
    """Return whether an operand is exact: an array of objects, a large integer, or a fraction."""
    if isinstance(number, np.ndarray):
        return bool(number.dtype == object)
    return abs(number) >= LARGE if isinstance(number, int) else isinstance(number, Fraction)


def _or_nan(operation: int) -> np.ufunc:
    function = _OPERATIONS[operation]

    def compute(left: Exact, right: Exact) -> Exact:
        try:
            if type(left) is int and type(right) is int and operation != DIVIDE:  # for speed
                return function(left, right)  # type: ignore[no-any-return]
            return calculate(operation, left, right)
        except ArithmeticError:
            return float("nan")

    return np.frompyfunc(compute, 2, 1)


EXACTLY: Final = tuple(_or_nan(operation) for operation in range(len(_OPERATIONS)))
"""The operations for arrays; where there is no result, it is NaN."""


def floats(numbers: Numbers) -> npt.NDArray[np.float64]:
    """Return numbers rounded to floats. The sign stays: a number other than 0 does not become 0."""
    if numbers.dtype != object:
        return numbers
    return np.array([_rounded(number) for number in numbers.tolist()], np.float64)


def _rounded(number: Exact) -> float:
    try:
        found = float(number)
    except OverflowError:
        return _MOST if number > 0 else -_MOST
    return found if found or not number else copysign(_TINY, number)


def bounds(numbers: Numbers) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the nearest floats that are not above, and not below, each number."""
    near = floats(numbers)
    if numbers.dtype != object:
        return near, near
    pairs = list(zip(near.tolist(), numbers.tolist(), strict=True))
    above = np.array([rounded > number for rounded, number in pairs], bool)
    below = np.array([rounded < number for rounded, number in pairs], bool)
    return np.where(above, np.nextafter(near, -np.inf), near), np.where(below, np.nextafter(near, np.inf), near)
