"""Makes JSON schemas of the configuration files, for editors, from the types by which shmio reads the files."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any, Final

import msgspec

from shmio.config.campaign import Campaign
from shmio.config.model import Config, Section
from shmio.config.ranges import MAX_OPTIONS
from shmio.config.read import DERIVED
from shmio.config.scene import Scene

_DRAFT: Final = "http://json-schema.org/draft-07/schema#"
"""The version of JSON schema: the newest that the TOML plugins of all editors know."""
_NO_CONTROL: Final = "^[^\\u0000-\\u001f\\u007f]*$"
"""Matches each text in which :func:`shmio.config.read.text_faults` finds no fault."""
_DEFINITIONS: Final = "definitions"

Schema = dict[str, Any]


def config_schema(connectors: Mapping[str, type[msgspec.Struct]], kinds: Collection[str]) -> Schema:
    """Return the schema of ``supervisor.toml``.

    Args:
        connectors: The type of the connector's own keys, by the name of each connector.
        kinds: The names of all kinds of emulators.

    """
    schema = _document(Config, "supervisor.toml, the configuration of an instance")
    definitions = schema[_DEFINITIONS]
    definitions["Emulator"]["properties"]["kind"] = {"enum": sorted(kinds)}
    source = definitions["Source"]
    source["properties"]["connector"] = {"enum": sorted(connectors)}
    common = list(source["properties"])
    source["additionalProperties"] = True  # the connector says which
    source["allOf"] = [_source_of(name, kind, common, schema) for name, kind in sorted(connectors.items())]
    return schema


def _source_of(name: str, kind: type[msgspec.Struct], common: Collection[str], schema: Schema) -> Schema:
    """Return the condition for the keys of sources with one connector; add what it needs to the schema."""
    options, inner = _parts(kind)
    schema[_DEFINITIONS].update(inner)
    for key in options["properties"]:
        schema[_DEFINITIONS]["Source"]["properties"].setdefault(key, {})  # so that editors suggest it
    own: Schema = {
        "properties": {**dict.fromkeys(common, True), **options["properties"]},
        "additionalProperties": False,
    }
    if options["required"]:  # here, or in the file of properties
        own |= {"if": {"not": {"required": ["properties"]}}, "then": {"required": options["required"]}}
    return {"if": {"properties": {"connector": {"const": name}}, "required": ["connector"]}, "then": own}


def campaign_schema() -> Schema:
    """Return the schema of a campaign file, in which values of injections may be ranges."""
    schema = _document(Campaign, "a campaign: injections and expectations")
    number = {"type": "number"}
    schema[_DEFINITIONS]["Range"] = {
        "title": "Range",
        "description": "A value that shmio-campaign falsify searches.",
        "oneOf": [
            {
                "type": "object",
                "properties": {"from": number, "to": number, "step": number, "log": {"type": "boolean"}},
                "required": ["from", "to"],
                "additionalProperties": False,
            },
            {
                "type": "object",
                "properties": {"choice": {"type": "array", "minItems": 2, "maxItems": MAX_OPTIONS}},
                "required": ["choice"],
                "additionalProperties": False,
            },
        ],
    }
    keys = schema[_DEFINITIONS]["Declaration"]["properties"]
    for key, value in keys.items():
        if key != "name":
            keys[key] = {"anyOf": [*value.get("anyOf", [value]), {"$ref": f"#/{_DEFINITIONS}/Range"}]}
    return schema


def scene_schema() -> Schema:
    """Return the schema of the file that describes a cell in 3D."""
    return _document(Scene, "the scene of an instance, for the web page")


def _document(kind: type[Section], title: str) -> Schema:
    whole, definitions = _parts(kind)
    return {"$schema": _DRAFT, **whole, "title": title, _DEFINITIONS: definitions}


def _parts(kind: type[msgspec.Struct]) -> tuple[Schema, dict[str, Schema]]:
    """Return the schema of a type, and those of the types that it uses, by name."""
    made = msgspec.json.schema(kind)
    found: dict[str, Schema] = {name: _adapted(schema) for name, schema in made["$defs"].items()}
    for section, fields in DERIVED.items():
        for field in fields if issubclass(kind, Section) else ():
            found.get(section.__name__, {}).get("properties", {}).pop(field, None)
    for schema in found.values():
        del schema["title"]
    return found.pop(made["$ref"].rpartition("/")[2]), found


def _adapted(node: Any) -> Any:
    """Return a schema without what TOML does not have (null), in the words of draft 7."""
    if isinstance(node, list):
        return [_adapted(item) for item in node]
    if not isinstance(node, dict):
        return node
    changed = {key: _adapted(value) for key, value in node.items() if key not in ("default", "$defs")}
    if node.get("default") is not None and not isinstance(node["default"], dict):
        changed["default"] = node["default"]
    if "anyOf" in changed:
        options = [option for option in changed.pop("anyOf") if option != {"type": "null"}]
        changed |= options[0] if len(options) == 1 else {"anyOf": options}
    if "prefixItems" in changed:
        changed |= {"items": changed.pop("prefixItems"), "additionalItems": False}
    if isinstance(changed.get("$ref"), str):
        changed["$ref"] = changed["$ref"].replace("$defs", _DEFINITIONS)
    if isinstance(changed.get("pattern"), str):
        changed["pattern"] = changed["pattern"].replace(r"\Z", "$")
    elif changed.get("type") == "string":
        changed["pattern"] = _NO_CONTROL
    if isinstance(changed.get("description"), str):
        changed["description"] = re.sub(r"`+|:\w+:", "", changed["description"].partition("\n\n")[0])
    return changed
