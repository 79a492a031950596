"""Configurations of earlier versions are accepted, and mean the same."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from shmio.config.read import load
from tests.compatibility.keys import present, refused

CHANGED = {
    "0.1.0": ["supervisor.toml.mqtt.sparkplug.datatypes: the default was False, and is True"],
}
"""What a later version refuses or changed on purpose, by the version; docs/how-to/upgrade.md says what to do."""


def test_every_key_accepts_what_it_accepted(baseline: Path) -> None:
    was = json.loads((baseline / "keys.json").read_text())
    assert refused(was, present()) == CHANGED.get(baseline.name, [])


def test_stored_configurations_have_no_faults(baseline: Path) -> None:
    files = sorted(baseline.glob("*.toml"))
    assert {"demo.toml", "examples-loopback.toml"} <= {file.name for file in files}
    for file in files:
        if "mtconnect" not in file.name:  # the connector of another package
            load(file)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"period_ms": None}, "supervisor.toml.source[].period_ms: is gone"),
        ({"period_ms": {"default": 10.0}}, "supervisor.toml.source[].period_ms: the default was 20.0, and is 10.0"),
        ({"period_ms": {"minimum": 1}}, "supervisor.toml.source[].period_ms: minimum is 1"),
        ({"period_ms": {"maximum": 1000}}, "supervisor.toml.source[].period_ms: maximum is 1000"),
        ({"period_ms": {"type": "integer"}}, "supervisor.toml.source[].period_ms: expects integer, not number"),
        ({"period_ms": {"enum": [20.0]}}, "supervisor.toml.source[].period_ms: takes [20.0], not None"),
        (
            {"texts": {"additionalProperties": {"type": "integer"}}},
            "supervisor.toml.source[].texts.*: expects integer, not string",
        ),
    ],
)
def test_each_kind_of_change_is_found(change: dict[str, Any], found: str) -> None:
    changed = copy.deepcopy(present())
    keys = changed["supervisor.toml"]["$defs"]["Source"]["properties"]
    for name, value in change.items():
        if value is None:
            del keys[name]
        else:
            keys[name] |= value
    assert refused(present(), changed) == [found]
