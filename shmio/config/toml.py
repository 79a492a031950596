"""Writes values as TOML."""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping


def toml(value: object) -> str:
    """Return a value as TOML in one line."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # JSON's other escapes are TOML's
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml(key)} = {toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    return repr(value)  # numbers, inf and nan included


def toml_file(tables: Mapping[str, object]) -> str:
    """Return the text of a TOML file, with a line for each key at the top."""
    return "".join(f"{toml(key)} = {toml(value)}\n" for key, value in tables.items())
