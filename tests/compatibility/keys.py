"""Which configurations of an earlier version a later one no longer accepts, by the types of their keys."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from shmio.config.model import Config
from shmio.connectors.registry import BUILT_IN, options_type

Schema = dict[str, Any]
LOWEST = ("minimum", "exclusiveMinimum", "minLength", "minItems")
HIGHEST = ("maximum", "exclusiveMaximum", "maxLength", "maxItems", "maxProperties")


def present() -> dict[str, Schema]:
    """Return the schema of ``supervisor.toml``, and of the keys of each connector."""
    kinds = {"supervisor.toml": Config} | {name: options_type(name) for name in sorted(BUILT_IN)}
    found = {name: msgspec.json.schema(kind) for name, kind in kinds.items()}
    decoded: dict[str, Schema] = msgspec.json.decode(msgspec.json.encode(found))  # tuples become lists
    return decoded


def refused(old: dict[str, Schema], new: dict[str, Schema]) -> list[str]:
    """Return the keys that are gone, needed now, or accept less, and those with another default."""
    found: list[str] = []
    for name, was in old.items():
        found += _Comparison(was, new[name]).of(was, new[name], name) if name in new else [f"{name} is gone"]
    return found


class _Comparison:
    """Compares two documents; references lead into each one's own definitions."""

    def __init__(self, old: Schema, new: Schema) -> None:
        self._old, self._new = old, new

    def of(self, was: Schema, is_: Schema, key: str) -> Iterator[str]:
        """Yield what ``is_`` refuses of what ``was`` accepted."""
        was, is_ = _resolved(was, self._old), _resolved(is_, self._new)
        if "anyOf" in was:
            for option in was["anyOf"]:
                yield from self.of(option, is_, key)
            return
        if "anyOf" in is_:
            options = [_resolved(option, self._new) for option in is_["anyOf"]]
            alike = [option for option in options if option.get("type") == was.get("type")]
            yield from min((list(self.of(was, option, key)) for option in alike or options), key=len)
            return
        if "type" in is_ and was.get("type") != is_["type"] and (was.get("type"), is_["type"]) != ("integer", "number"):
            yield f"{key}: expects {is_['type']}, not {was.get('type')}"
            return
        if "enum" in is_ and not set(was.get("enum", [None])) <= set(is_["enum"]):
            yield f"{key}: takes {is_['enum']}, not {was.get('enum')}"
        for limit in LOWEST:
            if limit in is_ and is_[limit] > was.get(limit, float("-inf")):
                yield f"{key}: {limit} is {is_[limit]}"
        for limit in HIGHEST:
            if limit in is_ and is_[limit] < was.get(limit, float("inf")):
                yield f"{key}: {limit} is {is_[limit]}"
        if "pattern" in is_ and is_["pattern"] != was.get("pattern"):
            yield f"{key}: has another pattern"
        for name in set(is_.get("required", ())) - set(was.get("required", ())):
            yield f"{key}.{name}: is needed now"
        if was.get("items") and is_.get("items"):  # false if "prefixItems" has them all
            yield from self.of(was["items"], is_["items"], f"{key}[]")
        for before, after in zip(was.get("prefixItems", ()), is_.get("prefixItems", ()), strict=False):
            yield from self.of(before, after, f"{key}[]")
        before, after = was.get("additionalProperties"), is_.get("additionalProperties")  # of tables with any names
        if isinstance(before, dict) and isinstance(after, dict):
            yield from self.of(before, after, f"{key}.*")
        for name, value in was.get("properties", {}).items():
            if name not in is_.get("properties", {}):
                yield f"{key}.{name}: is gone"
                continue
            yield from self.of(value, is_["properties"][name], f"{key}.{name}")
            before, after = (one.get("default") for one in (value, is_["properties"][name]))
            if not isinstance(before, dict) and before != after:
                yield f"{key}.{name}: the default was {before!r}, and is {after!r}"


def _resolved(schema: Schema, document: Schema) -> Schema:
    while "$ref" in schema:
        schema = document["$defs"][schema["$ref"].rpartition("/")[2]]
    return schema
