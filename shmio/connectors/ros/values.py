"""Converts values of message fields to values of registers, and back."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Any, Final

from shmio.connectors.ros.addresses import FieldError
from shmio.connectors.ros.messages import FLOATS, INTEGERS, from_json
from shmio.errors import ValueRangeError
from shmio.layout import model
from shmio.layout.model import Register
from shmio.layout.values.codec import Scalar, Value, flatten, nest, unfold
from shmio.model.statuses import BAD_INDEX_RANGE_NO_DATA, BAD_TYPE_MISMATCH

_REALS: Final = frozenset({"REAL", "LREAL"})
_TEXTS: Final = frozenset({"STRING", "WSTRING"})
_NATIVE: Final[Mapping[str, type]] = dict.fromkeys(model.INTEGERS, int) | dict.fromkeys(_REALS, float)
_FLOAT32_MAX: Final = 3.4028234663852886e38


class ValueConverter:
    """Converts between the values of a field and those of its register."""

    def __init__(self, register: Register, kind: str | None) -> None:
        """Create the converter for a register and ``kind``, the type of its field; None if this is unknown.

        Raises:
            ValueError: No value of the field can fit the register.

        """
        base = register.element.base
        if base not in (*_REALS, *_TEXTS, *model.INTEGERS, "BOOL"):
            raise ValueError(f"a {base} cannot be read from ROS; use BOOL, whole numbers, REAL, LREAL or STRING[n]")
        self._register, self._base, self._scale = register, base, register.scale
        self.native = None if register.scale or register.dims else _NATIVE.get(base)
        """The type whose values need no conversion; None if there is none."""
        self.kind = kind
        if kind is None:
            return
        element = kind.removesuffix("[]")
        if kind.endswith("[]") != bool(register.dims):
            raise ValueError(f"the field is a {kind}, which does not fit {_named(register)}")
        number = element in FLOATS or element in INTEGERS
        fits = (
            (base in _REALS and number)
            or (base in model.INTEGERS and (element in INTEGERS or (element in FLOATS and self._scale is not None)))
            or (base in _TEXTS and element == "string")
            or (base == "BOOL" and element == "bool")
        )
        if not fits:
            hint = "; give it a scale, or use LREAL" if base in model.INTEGERS and element in FLOATS else ""
            raise ValueError(f"the field is a {kind}, which does not fit {_named(register)}{hint}")

    def value(self, found: Any) -> Value:
        """Return the register's value for a value of the field.

        Raises:
            FieldError: The field's value has another type or another length.
            ValueRangeError: The register cannot hold the value.

        """
        if type(found) is self.native:
            return found  # type: ignore[return-value]  # mypy does not see that it is a number
        register = self._register
        if not register.dims:
            return self._element(found)
        if self.kind is None and self._base in model.INTEGERS:
            found = from_json(found, "uint8[]")
        if not isinstance(found, list):
            raise FieldError(BAD_TYPE_MISMATCH, f"found {type(found).__name__}, expected a sequence")
        try:
            elements = unfold(found, register.shape)
        except ValueRangeError as error:
            raise FieldError(BAD_INDEX_RANGE_NO_DATA, str(error)) from None
        return nest([self._element(one) for one in elements], register.shape)

    def _element(self, found: Any) -> Scalar:
        base = self._base
        if base == "BOOL":
            if isinstance(found, bool):
                return found
        elif base in _TEXTS:
            if isinstance(found, str):
                return found
        elif base in _REALS:
            if found is None:  # JSON has no NaN; a bridge sends null
                return math.nan
            if isinstance(found, int | float) and not isinstance(found, bool):
                return float(found) if self._scale is None else found * self._scale[0] + self._scale[1]
        elif isinstance(found, int) and not isinstance(found, bool) and self._scale is None:
            return found
        elif isinstance(found, int | float) and not isinstance(found, bool) and self._scale is not None:
            number = found * self._scale[0] + self._scale[1]
            if not math.isfinite(number):
                raise ValueRangeError(f"{number} is not a whole number")
            return round(number)
        raise FieldError(
            BAD_TYPE_MISMATCH, f"found {type(found).__name__}, which does not fit {_named(self._register)}"
        )

    def field(self, value: Value) -> Any:
        """Return the field's value for a value of the register.

        Raises:
            ValueError: The value does not fit the field.

        """
        register = self._register
        if not register.dims:
            return self._back(value)
        return [self._back(one) for one in flatten(value, register.shape, register.path)]

    def _back(self, value: Any) -> Any:
        kind = (self.kind or "").removesuffix("[]")
        if value is None:
            raise ValueError("the value is not valid")
        if kind in ("bool", "string"):
            return value
        number = value if self._scale is None else (value - self._scale[1]) / self._scale[0]
        if kind == "float64":
            return float(number)
        if kind == "float32":
            if math.isfinite(number) and abs(number) > _FLOAT32_MAX:
                raise ValueError(f"{number} does not fit a float32")
            return struct.unpack("<f", struct.pack("<f", number))[0]
        least, most = INTEGERS[kind]
        if not math.isfinite(number) or not least <= round(number) <= most:
            raise ValueError(f"{number} does not fit the field's {kind}")
        return round(number)


def _named(register: Register) -> str:
    return f"ARRAY of {register.type}" if register.dims else f"a {register.type}"
