"""How observations become registers: addresses, conditions, types, quality."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from typing import Final, NamedTuple

from shmio.connectors.register_image import RegisterImage
from shmio.errors import ConfigError
from shmio.layout.model import INTEGERS, NUMBERS, Register
from shmio.layout.values.codec import Value
from shmio.model.statuses import (
    BAD_CONFIGURATION_ERROR,
    BAD_NO_DATA,
    BAD_NODE_ID_UNKNOWN,
    BAD_NOT_SUPPORTED,
    BAD_OUT_OF_RANGE,
    BAD_TYPE_MISMATCH,
    GOOD,
    UNCERTAIN,
    UNREADABLE_TIME,
)
from shmio_mtconnect.documents import DataItem, Observation

log = logging.getLogger("shmio.source")

LEVELS: Final = {"Normal": 0, "Warning": 1, "Fault": 2}
MAX_ACTIVE: Final = 1000
"""Most conditions of one data item that are kept as active at once."""
MAX_NUMBER: Final = 80
"""Longest text, in characters, that the connector first tries to read as a plain number."""
_NUMBER = re.compile(r"[+-]?([0-9]{1,40}\.?[0-9]{0,40}|\.[0-9]{1,40})([eE][+-]?[0-9]{1,3})?", re.ASCII)
_BOOLS: Final = {
    "TRUE": True,
    "ON": True,
    "1": True,
    "YES": True,
    "FALSE": False,
    "OFF": False,
    "0": False,
    "NO": False,
}


class Address(NamedTuple):
    """The address of a register: ``dataItemId`` or ``device/component/…/item``, and optionally ``=TEXT``."""

    parts: tuple[str, ...]
    text: str | None
    """If the address has a text, the register is true while the value is this text."""


def parse(register: Register) -> Address:
    """Return a register's address. Raise ConfigError, with the register and the remedy, if it is invalid."""
    name, equals, text = register.address.partition("=")
    parts = tuple(part.strip() for part in name.strip().split("/"))
    if not all(parts):
        raise ConfigError(
            f"layout: {register.path}: address {register.address[:64]!r}: expected a dataItemId or "
            "device/component/…/item"
        )
    if equals and (register.type != "BOOL" or register.dims):
        raise ConfigError(f"layout: {register.path}: an address with = needs the type BOOL")
    if register.type != "BOOL" and register.type not in NUMBERS and not register.type.startswith(("STRING", "WSTRING")):
        raise ConfigError(f"layout: {register.path}: {register.type} is not supported; use BOOL, a number or a string")
    return Address(parts, text.strip() if equals else None)


def find(address: Address, items: Sequence[DataItem]) -> tuple[DataItem | None, int, str]:
    """Find the data item of an address. If there is not exactly one, return a status code and the reason.

    A path names the device, the item, and as many components between them as needed, in their order.
    """
    if len(address.parts) == 1:
        found = [item for item in items if item.id == address.parts[0]]
    else:
        found = [item for item in items if _fits(address.parts, item.names)]
    if len(found) == 1:
        if found[0].representation in ("DATA_SET", "TABLE"):
            return None, BAD_NOT_SUPPORTED, "data sets and tables are not supported"
        return found[0], 0, ""
    name = "/".join(address.parts)[:80]
    if found:
        paths = ", ".join(f"{item.path} ({item.id})" for item in found[:3])
        return None, BAD_CONFIGURATION_ERROR, f"{name} may be {paths}; name more components, or the dataItemId"
    return None, BAD_NODE_ID_UNKNOWN, f"the agent has no data item {name}"


def _fits(parts: tuple[str, ...], names: tuple[frozenset[str], ...]) -> bool:
    if len(names) < len(parts) or parts[0] not in names[0] or parts[-1] not in names[-1]:
        return False
    between = iter(names[1:-1])
    return all(any(part in one for one in between) for part in parts[1:-1])


class Conditions:
    """The active conditions of one data item, by their native code."""

    def __init__(self) -> None:
        self._active: dict[str, tuple[int, str]] = {}

    def add(self, observation: Observation) -> tuple[int, str] | None:
        """Add an observation. Return the worst active level and its text, or None if the agent knows no state."""
        level = LEVELS.get(observation.element)
        if level is None:  # Unavailable
            self._active.clear()
            return None
        code = observation.native_code
        if level == 0 and not code:
            self._active.clear()
        elif level == 0:
            self._active.pop(code, None)
        elif code in self._active or len(self._active) < MAX_ACTIVE:
            text = f"{observation.element} [{code}]" if code else observation.element
            self._active[code] = (level, f"{text} {observation.text}".rstrip())
        return max(self._active.values(), default=(0, "Normal"), key=lambda one: one[0])


class Target:
    """A register of a data item, which converts observations to the register's values."""

    def __init__(self, index: int, register: Register, address: Address, item: DataItem) -> None:
        self._index, self._register, self._address = index, register, address
        self.item = item
        self._is_condition = item.category == "CONDITION"
        self._is_plain = register.type in ("REAL", "LREAL") and not register.dims and register.scale is None
        """True if a finite number is the register's value as it is."""
        self._conditions = Conditions()
        self._last = -1
        self._doubted = False

    def put(self, image: RegisterImage, observation: Observation, *, whole: bool) -> None:
        """Store an observation, unless it is older than the last.

        ``whole``: the observation belongs to the whole state, which has all active conditions, each with its own
        sequence number.
        """
        if observation.sequence < self._last or (observation.sequence == self._last and not whole):
            return
        self._last = observation.sequence
        text: str = observation.text
        if self._is_condition:
            worst = self._conditions.add(observation)
            if worst is None:
                image.fail(self._index, BAD_NO_DATA, observation.source_ns)
                return
            text = worst[1] if self._register.type.startswith(("STRING", "WSTRING")) else str(worst[0])
            if self._address.text is not None:
                text = worst[1].partition(" ")[0]
            elif self._register.type == "BOOL":
                text = "1" if worst[0] else "0"
        elif text == "UNAVAILABLE":
            image.fail(self._index, BAD_NO_DATA, observation.source_ns)
            return
        try:
            value = self._value(text)
        except ValueError:
            image.fail(self._index, BAD_TYPE_MISMATCH, observation.source_ns)
        except OverflowError:
            image.fail(self._index, BAD_OUT_OF_RANGE, observation.source_ns)
        else:
            doubt = observation.doubt
            code = UNREADABLE_TIME if not observation.source_ns else UNCERTAIN if doubt else GOOD
            image.put(self._index, value, observation.source_ns, code)
            if doubt and not self._doubted:
                log.warning("%s: %s, so its value is uncertain", self._register.path, doubt)
            self._doubted = bool(doubt)

    def _value(self, text: str) -> Value:
        """Return the register's value.

        Raise ValueError if the text is not a value, OverflowError if it has another number of elements.
        """
        if self._is_plain and (number := _finite(text)) is not None:
            return number
        register = self._register
        if self._address.text is not None:
            return text == self._address.text
        if not register.dims:
            return self._scalar(text)
        words = text.split()
        if self.item.representation == "TIME_SERIES":
            words = words[-register.count :]  # the newest
        if len(words) != register.count:
            raise OverflowError
        return [self._scalar(word) for word in words]

    def _scalar(self, text: str) -> bool | int | float | str:
        register = self._register
        if register.type == "BOOL":
            if text.upper() not in _BOOLS:
                raise ValueError
            return _BOOLS[text.upper()]
        if register.type not in NUMBERS:
            return text
        if not _NUMBER.fullmatch(text):
            raise ValueError
        if register.scale is None and register.type in INTEGERS and text.lstrip("+-").isdecimal():
            return int(text)
        value = float(text)
        if register.scale is not None:
            value = value * register.scale[0] + register.scale[1]
        if not math.isfinite(value):
            raise OverflowError
        if register.type not in INTEGERS:
            return value
        if register.scale is None and not value.is_integer():
            raise ValueError
        return round(value)


def _finite(text: str) -> float | None:
    """Return the number in a text; None if it may be something else."""
    if len(text) > MAX_NUMBER or not text.isascii() or "_" in text:  # Python's own digits and separators
        return None
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
