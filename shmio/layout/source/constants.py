"""Constants of the sources, and the bounds and initial values that use them."""

from __future__ import annotations

import re
from collections.abc import Iterable

from shmio.errors import Diagnostic, ShmioError
from shmio.layout.source.expression import HIGHEST, LOWEST
from shmio.layout.source.syntax import Bound, Constant, ConstantDeclaration, Sum

MAX_DEFINITIONS = 32  # length of a chain of constants that are defined by constants
_HUGE = 1 << 64
# Text in single quotes is kept; then "NAME", #NAME, and a value that is nothing but a name.
_NAME = re.compile(r"""'(?:[^'$]|\$.)*'|"([^"]*)"|(?<![\w"])\#(\w+)|^\s*([^\W\d]\w*)\s*$""", re.DOTALL)
_MAX_VALUE = 4096  # characters; longer initial values are data, not names
_MAX_CONSTANT = 260  # characters of a constant's value: a STRING of full length


class BoundFault(ShmioError):  # noqa: N818  (the placer reports it; it never leaves the compiler)
    """A bound cannot be computed."""

    def __init__(self, diagnostic: Diagnostic) -> None:
        super().__init__(diagnostic.message)
        self.diagnostic = diagnostic


class Constants:
    """Constants visible in one place: the block's own, then those of all sources."""

    def __init__(self, declared: Iterable[ConstantDeclaration] = (), outer: Constants | None = None) -> None:
        self._declared = {declaration.name.lower(): declaration for declaration in declared}
        self._outer = outer
        self._numbers: dict[str, int] = {}  # cache: constants may refer to each other often

    def find(self, name: str) -> ConstantDeclaration | None:
        """Return the constant with this name, in any case, or None."""
        scope = self._scope(name.lower())
        return scope._declared[name.lower()] if scope else None

    def _scope(self, key: str) -> Constants | None:
        if key in self._declared:
            return self
        return self._outer._scope(key) if self._outer else None

    def number(self, bound: Bound) -> int:
        """Return the value of a bound.

        Raises:
            BoundFault: A constant is unknown or unsuitable, or the value exceeds 32 bits.
        """
        if isinstance(bound, int):
            return bound
        value = self._sum(bound, 0)
        if not LOWEST <= value <= HIGHEST:
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
        if depth >= MAX_DEFINITIONS:
            raise BoundFault(at.error(f"the constant {name!r} is defined by way of itself"))
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
        if declaration is None or depth >= MAX_DEFINITIONS:
            return match[0]
        if _NAME.fullmatch(declaration.value):  # the name of another constant
            return _NAME.sub(lambda inner: self._value(inner, depth + 1), declaration.value)
        return match[0] if len(declaration.value) > _MAX_CONSTANT else declaration.value
