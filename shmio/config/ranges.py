"""The parameter space of a campaign, whose dimensions are the ranges and choices of the campaign's file."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from shmio.errors import ConfigError
from shmio.wording import brief, did_you_mean, near, unknown

MAX_DIMENSIONS: Final = 64
"""Maximum number of ranges in one campaign."""
MAX_OPTIONS: Final = 256
"""Maximum number of values in one choice."""
SYNTAX: Final = "write { from = 0, to = 5 }, if need be with step or log = true, or { choice = [1, 2] }"
_KEYS: Final = ("from", "to", "step", "log", "choice")
_WHOLE: Final = frozenset({"times", "priority", "delay_cycles", "seed", "bits"})
"""Keys of an injection that take only whole numbers."""
_LOW: Final = frozenset(
    {"start_s", "end_s", "for_s", "times", "delay_ms", "delay_cycles", "amplitude", "probability", "seed"}
)
"""Keys of an injection for which the lowest value is the simplest."""

Point = Mapping[str, Any]
"""A value for each dimension of a space, by the dimension's name."""


@dataclass(frozen=True)
class Range:
    """Numbers between two limits.

    Attributes:
        name: Name for users, such as ``late.start_s`` or ``parameters.lift.top_m``.
        place: Keys and indices from the campaign's tables to the value.
        low: The lowest value.
        high: The highest value, which is above ``low``.
        step: Only ``low``, ``low + step``, … are in the range; None: all numbers are.
        log: Whether the search uses a logarithmic scale.
        whole: Whether values are whole numbers.

    """

    name: str
    place: tuple[str | int, ...]
    low: float
    high: float
    step: float | None = None
    log: bool = False
    whole: bool = False

    @property
    def count(self) -> int | None:
        """The number of values; None if the range is continuous."""
        return None if self.step is None else math.floor((self.high - self.low) / self.step + 1e-9) + 1

    def at(self, share: float) -> float:
        """Return the value at a fraction ``share`` of the range: the lowest at 0, the highest at 1."""
        if self.count is not None:
            return self._stepped(min(int(share * self.count), self.count - 1))
        if self.log:
            value = math.exp(math.log(self.low) + share * (math.log(self.high) - math.log(self.low)))
        else:
            value = self.low + share * (self.high - self.low)
        value = min(max(value, self.low), self.high)
        return round(value) if self.whole else float(value)

    def has(self, value: Any) -> bool:
        """Return whether a value lies between the limits; it need not be one of the steps."""
        return isinstance(value, int | float) and not isinstance(value, bool) and self.low <= value <= self.high

    @property
    def text(self) -> str:
        """The limits for a message."""
        return f"{self.low:.15g} to {self.high:.15g}"

    def nearest(self, value: float) -> float:
        """Return the value in the range that is nearest to a number."""
        value = min(max(value, self.low), self.high)
        if self.step is None or self.count is None:
            return round(value) if self.whole else float(value)
        return self._stepped(min(round((value - self.low) / self.step), self.count - 1))

    def _stepped(self, index: int) -> float:
        value = self.low + index * (self.step or 0)
        return int(value) if self.whole else float(f"{value:.12g}")

    @property
    def simplest(self) -> float:
        """The value to prefer in a failing case: the lowest time, duration, amplitude or probability.

        For other keys, it is the middle of the range.
        """
        return self.low if self.place[0] == "injection" and self.place[-1] in _LOW else self.at(0.5)


@dataclass(frozen=True)
class Choice:
    """A parameter that has one of several given values, of any type.

    Attributes:
        name: Name for users.
        place: Keys and indices from the campaign's tables to the value.
        options: The values. The first value is the usual value.

    """

    name: str
    place: tuple[str | int, ...]
    options: Sequence[Any]

    @property
    def count(self) -> int:
        """The number of values."""
        return len(self.options)

    def at(self, share: float) -> Any:
        """Return the value at a fraction ``share`` of the list: the first at 0, the last at 1."""
        return self.options[min(int(share * len(self.options)), len(self.options) - 1)]

    def has(self, value: Any) -> bool:
        """Return whether a value is one of the options."""
        return any(one == value and isinstance(one, bool) == isinstance(value, bool) for one in self.options)

    @property
    def text(self) -> str:
        """The options for a message."""
        return ", ".join(map(brief, self.options))

    @property
    def simplest(self) -> Any:
        """The value to prefer in a failing case: the first value."""
        return self.options[0]


Dimension = Range | Choice


class Space:
    """The dimensions of a campaign's tables. For each point, it returns tables with that point's values."""

    def __init__(self, tables: Mapping[str, Any]) -> None:
        """Find the ranges and choices in the tables of a campaign file.

        Raises:
            ConfigError: A range is invalid, or stands where none can be. The message begins with
                its key.

        """
        self._tables = tables
        self.dimensions: tuple[Dimension, ...] = tuple(_dimensions(tables))
        if len(self.dimensions) > MAX_DIMENSIONS:
            raise ConfigError(
                f"{key_of(self.dimensions[MAX_DIMENSIONS].place)}: "
                f"there are {len(self.dimensions)} ranges, but at most {MAX_DIMENSIONS} are allowed"
            )
        seen: set[str] = set()
        for one in self.dimensions:
            if one.name in seen:
                raise ConfigError(f"{key_of(one.place)}: another range already has the name {one.name!r}")
            seen.add(one.name)

    def at(self, point: Point) -> dict[str, Any]:
        """Return a copy of the tables, in which each dimension that ``point`` names has the value from ``point``."""
        tables = copy.deepcopy(dict(self._tables))
        for one in self.dimensions:
            if one.name in point:
                table: Any = tables
                for key in one.place[:-1]:
                    table = table[key]
                table[one.place[-1]] = point[one.name]
        return tables

    def shares(self, share: float) -> dict[str, Any]:
        """Return the point at the same fraction ``share``, from 0 to 1, of each dimension."""
        return {one.name: one.at(share) for one in self.dimensions}

    def check(self, point: Point) -> None:
        """Check that each name is the name of a dimension, which has the value.

        Raises:
            ConfigError: A name is unknown, or its dimension does not have the value.

        """
        known = {one.name: one for one in self.dimensions}
        for name, value in point.items():
            if name not in known:
                raise ConfigError(unknown("range", name, known))
            one = known[name]
            if not one.has(value):
                raise ConfigError(f"{key_of(one.place)}: {brief(value)} is not in the range {name}, {one.text}")


def key_of(place: Sequence[str | int]) -> str:
    """Return the key for messages, such as ``injection[0].value``, from the keys and indices that lead to a value."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".")


def _dimensions(tables: Mapping[str, Any]) -> Iterator[Dimension]:
    for key in ("duration_s", "step_ms", "config"):
        if isinstance(tables.get(key), dict):
            raise ConfigError(f"{key}: only injections and parameters can have a range")
    for index, table in enumerate(_list(tables.get("expect"))):
        for key, value in table.items() if isinstance(table, dict) else ():
            if isinstance(value, dict):
                raise ConfigError(f"expect[{index}].{key}: an expectation has no ranges, because it must stay the same")
    for index, table in enumerate(_list(tables.get("injection"))):
        for key, value in table.items() if isinstance(table, dict) else ():
            if key == "name" and isinstance(value, dict):
                raise ConfigError(f"injection[{index}].name: a name has no range")
            name = table.get("name")
            yield from _within(value, f"{name if isinstance(name, str) else index}.{key}", ("injection", index, key))
    parameters = tables.get("parameters")
    for source, table in parameters.items() if isinstance(parameters, dict) else ():
        for key, value in table.items() if isinstance(table, dict) else ():
            yield from _within(value, f"parameters.{source}.{key}", ("parameters", source, key))


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _within(value: Any, name: str, place: tuple[str | int, ...]) -> Iterator[Dimension]:
    if isinstance(value, dict):
        try:
            yield _dimension(value, name, place)
        except ConfigError as error:
            raise ConfigError(f"{key_of(place)}{error}") from None
    for index, item in enumerate(_list(value)):
        yield from _within(item, f"{name}[{index}]", (*place, index))


def _dimension(table: Mapping[str, Any], name: str, place: tuple[str | int, ...]) -> Dimension:
    """Read a range.

    Raises:
        ConfigError: The range is invalid. The message begins with what follows the range's key.

    """
    for key in table:
        if key not in _KEYS:
            remedy = did_you_mean(near(key, _KEYS)) or SYNTAX
            raise ConfigError(f".{key}: unknown key; {remedy}")
    if "choice" in table:
        return _choice(table, name, place)
    low, high = (_number(table, key) for key in ("from", "to"))
    if not low < high:
        raise ConfigError(f".to: {high:.15g} is not above from, {low:.15g}; write a single value without a range")
    log = table.get("log", False)
    if not isinstance(log, bool):
        raise ConfigError(f".log: expected true or false, found {brief(log)}")
    whole_key = place[2] in _WHOLE and place[0] == "injection"
    step = _number(table, "step") if "step" in table else 1 if whole_key and not log else None
    if step is not None and log:
        raise ConfigError(".log: a range cannot have both step and log = true; leave out one of them")
    if log and low <= 0:
        raise ConfigError(f".from: {low:.15g} is not above 0, so it has no logarithm; leave out log, or begin above 0")
    if step is not None and not 0 < step <= high - low:
        raise ConfigError(f".step: {step:.15g} is not above 0 and at most {high - low:.15g}, the length of the range")
    whole = whole_key or (step is not None and all(isinstance(one, int) for one in (low, high, step)))
    if whole and not all(float(one).is_integer() for one in (low, high, step or 1)):
        wrong = next(one for one in (low, high, step or 1) if not float(one).is_integer())
        raise ConfigError(f".from: {place[2]} takes only whole numbers, but the range has {wrong:.15g}")
    if step is not None and (high - low) / step > 1e9:
        raise ConfigError(".step: the range has more than 1e9 values; leave out step")
    return Range(name, place, low, high, step, log, whole)


def _choice(table: Mapping[str, Any], name: str, place: tuple[str | int, ...]) -> Choice:
    options = table["choice"]
    if len(table) > 1:
        raise ConfigError(f".{next(key for key in table if key != 'choice')}: choice takes no other key")
    if not isinstance(options, list) or not 2 <= len(options) <= MAX_OPTIONS:
        raise ConfigError(f".choice: expected a list of 2 to {MAX_OPTIONS} values, found {brief(options)}")
    for index, one in enumerate(options):
        if isinstance(one, dict):
            raise ConfigError(f".choice[{index}]: a choice cannot contain a range; write a value")
        if any(one == other and type(one) is type(other) for other in options[:index]):
            raise ConfigError(f".choice[{index}]: {one!r} is given twice; remove one of them")
    return Choice(name, place, tuple(options))


def _number(table: Mapping[str, Any], key: str) -> float:
    if key not in table:
        raise ConfigError(f".{key}: this key is needed; {SYNTAX}")
    value = table[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or abs(value) > 1e300:
        raise ConfigError(f".{key}: expected a number, found {brief(value)}")
    number: float = value
    return number
