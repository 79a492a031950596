"""``shmio-supervisor schema``: prints the JSON schema of a configuration file, for editors."""

from __future__ import annotations

import argparse
from collections.abc import Iterable

from shmio.cli.common import dumps
from shmio.config.schema import Schema, campaign_schema, config_schema, scene_schema
from shmio.connectors.registry import names, options_type
from shmio.emulators.kinds import KINDS


def schema(arguments: argparse.Namespace) -> int:
    """Print the schema. For ``supervisor.toml``, it includes the keys of all installed connectors."""
    print(dumps(schema_of(arguments.file, names()), indent=2))
    return 0


def schema_of(file: str, connectors: Iterable[str]) -> Schema:
    """Return the schema of a kind of configuration file.

    Args:
        file: The kind: supervisor, campaign or scene.
        connectors: Names of the connectors whose keys the schema includes.
    """
    if file == "campaign":
        return campaign_schema()
    if file == "scene":
        return scene_schema()
    return config_schema({name: options_type(name) for name in connectors}, KINDS)
