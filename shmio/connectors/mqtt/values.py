"""Converts texts and JSON values to values of registers, and back."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any, Final

from shmio.connectors import json_text
from shmio.connectors.mqtt.faults import ValueFaultError
from shmio.errors import ValueRangeError
from shmio.layout import model
from shmio.layout.model import Register
from shmio.layout.values.codec import Scalar, Value, flatten, nest, unfold
from shmio.model.statuses import (
    BAD_DECODING_ERROR,
    BAD_INDEX_RANGE_NO_DATA,
    BAD_NO_DATA,
    BAD_OUT_OF_RANGE,
    BAD_TYPE_MISMATCH,
)
from shmio.wording import printable

_REALS: Final = frozenset({"REAL", "LREAL"})
_TEXTS: Final = frozenset({"STRING", "WSTRING"})
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]{1,400}(?:\.[0-9]{0,400})?|\.[0-9]{1,400})(?:[eE][+-]?[0-9]{1,4})?")
_WHOLE: Final = re.compile(r"[+-]?[0-9]{1,20}")
_NO_NUMBER: Final = {"nan": math.nan, "inf": math.inf, "infinity": math.inf, "-inf": -math.inf, "-infinity": -math.inf}
_BOOLS: Final = {"true": True, "false": False, "1": True, "0": False, "on": True, "off": False}
_EXACT: Final = 1 << 53
"""Every whole number up to this one can be represented exactly by a float."""
MAX_PLAIN: Final = 40
"""Size in bytes of the longest payload that the converter first tries to read as a plain number."""
SHOWN: Final = 40
"""Maximum number of characters of a wrong value that a message to the user shows."""


class ValueConverter:
    """Converts between values in messages and the values of one register."""

    def __init__(self, register: Register, texts: Sequence[str] = ("false", "true")) -> None:
        """Create the converter for a register.

        Args:
            register: The register.
            texts: Texts for false and true of a BOOL register. They are published, and are
                understood besides the usual texts.

        Raises:
            ValueError: MQTT messages cannot carry values of the register's type.

        """
        base = register.element.base
        if base not in (*_REALS, *_TEXTS, *model.INTEGERS, "BOOL"):
            raise ValueError(f"a {base} cannot be read from MQTT; use BOOL, whole numbers, REAL, LREAL or STRING[n]")
        self._register, self._base, self._scale, self._texts = register, base, register.scale, texts
        self._is_plain = base in _REALS and self._scale is None and not register.dims
        """True if a finite number is the register's value as it is."""
        self._bools = _BOOLS | {texts[0].casefold(): False, texts[1].casefold(): True}

    # -- reading -------------------------------------------------------------------------------------------------------

    def from_text(self, payload: bytes) -> Value:
        """Return the value of the register for a payload that is plain text.

        Raises:
            ValueFaultError: The payload is not a value of the register's type.
            ValueRangeError: The register cannot hold the value.

        """
        if self._is_plain and len(payload) <= MAX_PLAIN and b"_" not in payload:  # Python's own separator
            try:
                if math.isfinite(number := float(payload)):
                    return number
            except ValueError:  # the code below says why, or knows the text
                pass
        if not payload:
            raise ValueFaultError(BAD_NO_DATA, "the payload is empty")
        try:
            return self._element(payload.decode())
        except UnicodeDecodeError:
            raise ValueFaultError(BAD_DECODING_ERROR, "the payload is not text in UTF-8") from None

    def from_json(self, found: Any) -> Value:
        """Return the value of the register for a JSON value.

        Raises:
            ValueFaultError, ValueRangeError: As for :meth:`from_text`.

        """
        register = self._register
        if not register.dims:
            return self._element(found)
        if found is None:
            raise ValueFaultError(BAD_NO_DATA, "the value is null")
        if not isinstance(found, list):
            raise ValueFaultError(BAD_TYPE_MISMATCH, f"found {_show(found)}, expected an array")
        try:
            elements = unfold(found, register.shape)
        except ValueRangeError as error:
            raise ValueFaultError(BAD_INDEX_RANGE_NO_DATA, str(error)) from None
        return nest([self._element(one) for one in elements], register.shape)

    def _element(self, found: Any) -> Scalar:
        if found is None:
            raise ValueFaultError(BAD_NO_DATA, "the value is null")
        base = self._base
        if base in _TEXTS:
            if isinstance(found, str):
                return found
        elif base == "BOOL":
            if isinstance(found, bool):
                return found
            truth = self._bools.get(str(found).strip().casefold()) if isinstance(found, int | str) else None
            if truth is not None:
                return truth
        else:
            return self._number(found)
        raise ValueFaultError(BAD_TYPE_MISMATCH, f"found {_show(found)}, which is not a valid {self._register.type}")

    def _number(self, found: Any) -> int | float:
        """Return the value of a numeric register."""
        if isinstance(found, str):
            found = _parse_number(found.strip())
        if isinstance(found, bool) or not isinstance(found, int | float):
            raise ValueFaultError(BAD_TYPE_MISMATCH, f"found {_show(found)}, which is not a number")
        try:
            if self._base in _REALS:
                return float(found) if self._scale is None else float(found * self._scale[0] + self._scale[1])
            if self._scale is not None:
                return round(found * self._scale[0] + self._scale[1])
        except (OverflowError, ValueError):  # an infinity, or a whole number beyond all floats
            raise ValueFaultError(BAD_OUT_OF_RANGE, f"{_show(found)} does not fit a {self._register.type}") from None
        if isinstance(found, float):
            if not found.is_integer() or abs(found) > _EXACT:
                raise ValueFaultError(BAD_TYPE_MISMATCH, f"found {_show(found)}, which is not a whole number")
            return int(found)
        return found

    # -- writing -------------------------------------------------------------------------------------------------------

    def to_text(self, value: Value) -> bytes:
        """Return the payload, as text, for a value of the register.

        Raises:
            ValueError: The value cannot be published.

        """
        plain = self._plain(value)
        if isinstance(plain, bool):
            return self._texts[plain].encode()
        if isinstance(plain, float) and not math.isfinite(plain):
            return b"NaN" if math.isnan(plain) else b"Infinity" if plain > 0 else b"-Infinity"
        return str(plain).encode()

    def to_json(self, value: Value) -> Any:
        """Return the JSON value for a value of the register.

        Raises:
            ValueError: JSON cannot express the value.

        """
        found = self.to_value(value)
        for one in flatten(found, self._register.shape, self._register.path):
            if isinstance(one, float) and not math.isfinite(one):
                raise ValueError("JSON has neither NaN nor infinity; write a finite number")
        return found

    def to_value(self, value: Value) -> Any:
        """Return the value to send to the device: without the register's scale, and an array as nested lists.

        Raises:
            ValueError: The value is not valid.

        """
        register = self._register
        if not register.dims:
            return self._plain(value)
        return nest([self._plain(one) for one in flatten(value, register.shape, register.path)], register.shape)

    def _plain(self, value: Any) -> bool | int | float | str:
        """Return a value for the device, without the register's scale."""
        if value is None:
            raise ValueError("the value is not valid")
        if self._scale is None or isinstance(value, str | bool):
            plain: bool | int | float | str = value
            return plain
        number: float = (value - self._scale[1]) / self._scale[0]
        return int(number) if self._base in model.INTEGERS and number.is_integer() else number


def decode_json(payload: bytes) -> Any:
    """Return the document in a payload, which may also contain NaN and Infinity.

    Raises:
        ValueFaultError: The payload is not JSON.

    """
    if not payload:
        raise ValueFaultError(BAD_NO_DATA, "the payload is empty")
    try:
        return json_text.read(payload)
    except RecursionError:
        raise ValueFaultError(BAD_DECODING_ERROR, "the JSON is nested too deeply") from None
    except ValueError as error:
        raise ValueFaultError(BAD_DECODING_ERROR, f"the payload is not JSON: {printable(str(error))[:100]}") from None


def is_number(text: bytes) -> bool:
    """Return whether a payload is the text of a number."""
    return _NUMBER.fullmatch(text.decode("latin1")) is not None


def _parse_number(text: str) -> int | float:
    if _WHOLE.fullmatch(text):
        return int(text)
    if _NUMBER.fullmatch(text):
        number = float(text)
        if math.isinf(number):
            raise ValueFaultError(BAD_OUT_OF_RANGE, f"{_show(text)} does not fit any register")
        return number
    found = _NO_NUMBER.get(text.casefold())
    if found is None:
        raise ValueFaultError(BAD_DECODING_ERROR, f"{_show(text)} is not a number")
    return found


def _show(found: Any) -> str:
    """Return a wrong value as text for a message, on one line and shortened."""
    if isinstance(found, dict):
        return "an object"
    if isinstance(found, list):
        return "an array"
    if isinstance(found, int) and abs(found) >> 128:
        return "a very large number"
    if isinstance(found, str):
        return printable(repr(found[:SHOWN])) + ("…" if len(found) > SHOWN else "")
    return str(found)
