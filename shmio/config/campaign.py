"""Reads campaign files, which have injections, parameters of models, and expectations of signals."""

from __future__ import annotations

import json
import random
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, field

from shmio.config.declaration import declaration_faults
from shmio.config.expectation import expectation_faults
from shmio.config.faults import Faults
from shmio.config.model import Declaration, Expectation, Section, Text
from shmio.config.ranges import Choice, Dimension, Point, Space, key_of
from shmio.config.read import Structure, check_text, convert, parse, read_text
from shmio.errors import ConfigError
from shmio.wording import near

SAMPLES: Final = 20
"""Number of random points at which a campaign with ranges is checked, besides the lowest, middle and highest."""
_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")
_REMEDIES: Final = {
    "injection": "write an [[injection]] table",
    "expect": "write an [[expect]] table, or create the injections alone with shmio inject --file",
}


_TABLES: Final[Mapping[str, type[Section]]] = {"injection": Declaration, "expect": Expectation}


class Campaign(Section, omit_defaults=True):
    """The contents of a campaign file.

    Attributes:
        config: The ``supervisor.toml`` of the instance, relative to the campaign file.
        start: Name of a snapshot from which the run starts; None: it starts without a snapshot.
        duration_s: Duration of the run on the instance's clock, in s.
        step_ms: Length of a step of virtual time, in ms.
        parameters: Parameters of models, by source and name. Only laboratories can set them.
        injection: The injections.
        expect: The expectations.

    """

    config: Text | None = None
    start: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$")] | None = None
    duration_s: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    step_ms: Annotated[float, Meta(ge=0.001, le=3_600_000)] | None = None
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    injection: list[Declaration] = field(default_factory=list)
    expect: list[Expectation] = field(default_factory=list)


class CampaignFile:
    """A campaign file that may have ranges. It has a campaign for each point in the space of its ranges."""

    def __init__(self, file: Path) -> None:
        """Read a file with expectations.

        Raises:
            ConfigError: The file is invalid, or has no expectation; the message has a line for each
                fault, which names the file, its line, the key and the remedy.

        """
        self.file = file
        self._text = read_text(file)
        self.tables = parse(file, self._text)
        faults = self.faults()
        with faults.catching():
            self.space = Space(self.tables)
        faults.raise_any()
        self._check(faults)
        faults.raise_any()

    def faults(self) -> Faults:
        """Return an empty collection for faults of this file."""
        return Faults(self.file, self.tables, self._text)

    def refuse(self, messages: Iterable[str]) -> None:
        """Raise ConfigError if there are messages about this file, each of which begins with its key."""
        faults = self.faults()
        for message in messages:
            faults.add(message)
        faults.raise_any()

    def at(self, point: Point) -> Campaign:
        """Return the campaign at a point.

        Args:
            point: A value for each range, by the name of the range.

        Raises:
            ConfigError: A name is unknown, a range has no value or not this one, or the values contradict
                each other. The message names the file, the key and the remedy.

        """
        faults = self.faults()
        with faults.catching():
            self.space.check(point)
        for one in self.space.dimensions:
            if one.name not in point:
                faults.add(
                    f"{key_of(one.place)}: this is a range; search it with shmio-campaign falsify, or "
                    f"choose a value with shmio-campaign run --set {one.name}=VALUE"
                )
        faults.raise_any()
        try:
            return _parse(self.space.at(point), "expect")
        except ConfigError as error:
            raise ConfigError(faults.located(str(error))) from None

    @property
    def expect(self) -> list[Expectation]:
        """The expectations, which never have ranges."""
        return _parse({"expect": self.tables["expect"]}, "expect").expect

    def _check(self, faults: Faults) -> None:
        """Check each end of each range alone, and the whole at some points: a fault is what no point avoids."""
        space, first = self.space, self.space.shares(0)
        found = _sound(space.at(first), "expect", faults)
        for fault in () if space.dimensions else _contradictions(found):
            faults.add(fault)
        if faults:
            return
        for one in space.dimensions:
            for value in one.options if isinstance(one, Choice) else (one.low, one.high):
                if one.place[0] == "injection":
                    with faults.catching():
                        convert({"injection": space.at({**first, one.name: value})["injection"]}, Campaign)
        if faults or not space.dimensions:
            return
        draw = random.Random(0)  # noqa: S311  not for a secret
        points = [space.shares(0.5), first, space.shares(1)]
        points += [{one.name: one.at(draw.random()) for one in space.dimensions} for _ in range(SAMPLES)]
        problem: ConfigError | None = None
        for point in points:
            try:
                _parse(space.at(point), "expect")
            except ConfigError as error:
                problem = problem or error
            else:
                return
        if problem is not None:
            faults.add(str(problem))


def read_settings(settings: Sequence[str]) -> dict[str, Any]:
    """Return the point that settings such as ``late.start_s=3`` describe.

    Raises:
        ConfigError: A text has no ``=``, or its value is not TOML.

    """
    point: dict[str, Any] = {}
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ConfigError(f"--set {text}: expected NAME=VALUE, such as late.start_s=3")
        try:
            tables = tomllib.loads(f"value = {value}")
        except (ValueError, RecursionError):
            tables = {}
        if set(tables) != {"value"}:
            raise ConfigError(f"--set {text}: {value!r} is not a TOML value; write text in double quotes")
        point[name] = tables["value"]
    return point


def read_campaign(file: Path) -> list[Declaration]:
    """Read the ``[[injection]]`` sections of a campaign file.

    Raises:
        ConfigError: The file is invalid; the message names the file, the key and the remedy.

    """
    text = read_text(file)
    tables = parse(file, text)
    faults = Faults(file, tables, text)
    with faults.catching():
        space = Space(tables)
        for one in space.dimensions:
            faults.add(_range_refused(one))
        found = _sound(space.at(space.shares(0)), "injection", faults)
        for fault in (*(() if space.dimensions else _contradictions(found)), *_parameters_refused(found)):
            faults.add(fault)
    faults.raise_any()
    return found.injection


def parse_campaign(tables: dict[str, Any]) -> list[Declaration]:
    """Return the injections declared in a campaign's tables, such as ``{"injection": [{"name": …}]}``.

    Raises:
        ConfigError: A table is invalid; the message begins with its key.

    """
    found = _parse(tables, "injection")
    for fault in _parameters_refused(found):
        raise ConfigError(fault)
    return found.injection


def _parameters_refused(campaign: Campaign) -> Iterator[str]:
    """Yield a fault if a campaign has parameters."""
    if campaign.parameters:
        yield "parameters: a running instance cannot change the parameters of its models; use shmio-campaign run --lab"


def campaign_of(tables: dict[str, Any]) -> Campaign:
    """Return the campaign that tables without ranges describe.

    Raises:
        ConfigError: A table is invalid; the message begins with its key.

    """
    return _parse(tables, "expect")


def campaign_text(campaign: Mapping[str, Any], comment: Sequence[str] = ()) -> str:
    """Return the tables of a campaign as TOML.

    Args:
        campaign: The tables, as :func:`msgspec.to_builtins` returns them.
        comment: Lines for a comment at the top.

    """
    parts = ["".join(f"# {line}\n" if line else "#\n" for line in comment)]
    parts.append("".join(_line(key, value) for key, value in campaign.items() if not isinstance(value, list | dict)))
    parts += [
        f"[parameters.{_key(source)}]\n" + "".join(_line(key, value) for key, value in table.items())
        for source, table in campaign.get("parameters", {}).items()
    ]
    for name in ("injection", "expect"):
        parts += [
            f"[[{name}]]\n" + "".join(_line(key, value) for key, value in table.items())
            for table in campaign.get(name, [])
        ]
    return "\n".join(part for part in parts if part)


def _line(key: str, value: Any) -> str:
    """Return a key with its value.

    Numbers, lists and texts without control characters look as in JSON.
    """
    return f"{_key(key)} = {json.dumps(value, ensure_ascii=False)}\n"


def _key(text: str) -> str:
    return text if _BARE.fullmatch(text) else json.dumps(text, ensure_ascii=False)


def tables_of(campaign: Campaign) -> dict[str, Any]:
    """Return a campaign as the tables of its file."""
    tables: dict[str, Any] = msgspec.to_builtins(campaign)
    return tables


def _check_brackets(tables: Mapping[str, Any]) -> None:
    for key in ("injection", "expect"):
        if isinstance(tables.get(key), dict):
            raise ConfigError(f"{key}: write [[{key}]] with double brackets, because there can be several")


def _sound(tables: dict[str, Any], needed: str, faults: Faults) -> Campaign:
    """Return the campaign of a file without its faulty keys and tables, and add their faults."""
    sound, faults.places = Structure(faults, Campaign, _TABLES, _TABLES).sections(tables)
    if needed not in tables and not any(near(key, [needed]) for key in tables):  # a misspelled key is a fault already
        faults.add(_missing(needed))
    return convert(sound, Campaign)


def _parse(tables: dict[str, Any], needed: str) -> Campaign:
    """Return the campaign that tables describe.

    Raises:
        ConfigError: A table is invalid; the message describes the first fault, and begins with its key.

    """
    _check_brackets(tables)
    check_text(tables, "")
    for one in Space(tables).dimensions:
        raise ConfigError(_range_refused(one))
    campaign = convert(tables, Campaign)
    if needed not in tables:
        raise ConfigError(_missing(needed))
    for fault in _contradictions(campaign):
        raise ConfigError(fault)
    return campaign


def _range_refused(one: Dimension) -> str:
    return f"{key_of(one.place)}: this is a range, which only shmio-campaign falsify searches; write a value"


def _missing(key: str) -> str:
    return f"{key}: this key is needed; {_REMEDIES[key]}"


def _contradictions(campaign: Campaign) -> Iterator[str]:
    """Yield the faults of valid keys that do not go together."""
    yield from declaration_faults(campaign.injection)
    yield from expectation_faults(campaign.expect)
