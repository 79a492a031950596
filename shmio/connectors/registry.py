"""Connectors by name: ours, and those that other packages offer as entry points (group ``shmio.connectors``)."""

from __future__ import annotations

import importlib
from importlib.metadata import entry_points
from typing import Any

import msgspec

from shmio.connectors.base import Connector
from shmio.errors import ConfigError

GROUP = "shmio.connectors"

BUILT_IN = {
    "s7": "shmio.connectors.s7.connector:S7Connector",
}


def names() -> list[str]:
    """All names that ``connector = "…"`` may have here."""
    return sorted({*BUILT_IN, *(point.name for point in entry_points(group=GROUP))})


def load(name: str) -> type[Connector]:
    """Import a connector by name; ConfigError when there is none, or it cannot be imported."""
    if name in BUILT_IN:
        module, _, attribute = BUILT_IN[name].partition(":")
        found: Any = getattr(importlib.import_module(module), attribute)
    else:
        points = [point for point in entry_points(group=GROUP) if point.name == name]
        if not points:
            raise ConfigError(f"no connector {name!r}; there are: {', '.join(names())}")
        try:
            found = points[0].load()
        except Exception as error:
            raise ConfigError(f"connector {name!r} ({points[0].value}) cannot be imported: {error}") from error
    if not (isinstance(found, type) and issubclass(found, Connector)):
        raise ConfigError(f"connector {name!r} is not a subclass of shmio.connectors.base.Connector")
    return found


def options_type(name: str) -> type[msgspec.Struct]:
    """The type of the connector's own keys."""
    return load(name).Options


def convert_options(name: str, options: dict[str, Any]) -> msgspec.Struct:
    """Check a source's own keys; text values, as properties files have them, are read as their types.

    ConfigError with the message alone: the caller knows where the keys stand.
    """
    try:
        return msgspec.convert(options, options_type(name), strict=False)
    except msgspec.ValidationError as error:
        message, _, at = str(error).partition(" - at `$.")
        raise ConfigError(f"{at.rstrip('`')}: {message}" if at else message) from None
