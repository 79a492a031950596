"""The JSON schemas for editors refuse what ``check`` refuses by its types, and nothing that it accepts."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from shmio.cli.instance.schema import schema_of
from shmio.cli.supervisor import SCHEMAS, main
from shmio.config.campaign import CampaignFile
from shmio.config.scene import examine_scene
from shmio.connectors.registry import BUILT_IN
from shmio.errors import ConfigError

ROOT = Path(__file__).parents[3]
STORED = ROOT / "docs/reference/schemas"
VALID = """
[instance]
name = "a50"

[[source]]
name = "cell"
connector = "s7"
layout = "db201.db"
host = "127.0.0.1"
port = 1102
period_ms = 20
writable = ["Outputs"]

[[emulator]]
name = "plc"
kind = "s7"
layout = "db201.db"
folder = "."
listen = "127.0.0.1:1102"

[[injection]]
name = "drift"
target = "cell/Robot_800/Axs1_Pos"
operation = "offset"
value = 1

[grpc]
listen = ["127.0.0.1:8089"]

[recorder]
directory = "dumps"

[[alert]]
process = "cell"
"""
BELT = """
[[source]]
name = "belt"
connector = "simulation"
model = "shmio.simulation.loopback:Loopback"
parameters = {}
folder = "."
"""
"""A source whose model takes time: ``check`` starts a process that imports it."""
INVALID = [
    ('name = "a50"', 'name = "a 50"'),
    ('name = "a50"', 'name = "a50"\nnam = "x"'),
    ('name = "a50"', 'name = "a50"\nclock = "virtual"'),
    ('name = "a50"', 'name = "a50"\naudit = "yes"'),
    ('name = "a50"', 'name = "a50"\naudit_files = 0'),
    ('name = "a50"', 'name = "a50"\nlog_dir = ""'),
    ('name = "a50"', 'name = "a50"\nlog_dir = "a\\tb"'),
    ('[instance]\nname = "a50"\n', ""),
    ('connector = "s7"', 'connector = "s8"'),
    ('connector = "s7"\n', ""),
    ('host = "127.0.0.1"\n', ""),
    ('host = "127.0.0.1"', "host = 127"),
    ('host = "127.0.0.1"', 'hots = "127.0.0.1"'),
    ("port = 1102", "port = 70000"),
    ("port = 1102", "port = 1102.5"),
    ("port = 1102", 'port = "1102"'),
    ("port = 1102", 'port = 1102\nurl = "x"'),
    ("port = 1102", 'port = 1102\nconnection = "PG"'),
    ("period_ms = 20", "period_ms = 0"),
    ("period_ms = 20", "period_ms = true"),
    ("period_ms = 20", "period_ms = [20]"),
    ("period_ms = 20", "period_ms = 20\nrealtime_priority = 100"),
    ('writable = ["Outputs"]', 'writable = "Outputs"'),
    ('writable = ["Outputs"]', 'writable = [""]'),
    ('writable = ["Outputs"]', 'writable = ["Outputs"]\noptions = {}'),
    ('model = "shmio.simulation.loopback:Loopback"\n', ""),
    ("parameters = {}", "parameters = []"),
    ('kind = "s7"', 'kind = "s8"'),
    ('listen = "127.0.0.1:1102"\n', ""),
    ("[[emulator]]", "[emulator]"),
    ('operation = "offset"', 'operation = "add"'),
    ("value = 1", "valeu = 1"),
    ("value = 1", "value = 1\nprobability = 0"),
    ("[grpc]", "[grcp]"),
    ("[grpc]", "[[grpc]]"),
    ('listen = ["127.0.0.1:8089"]', 'listen = "127.0.0.1:8089"'),
    ('listen = ["127.0.0.1:8089"]', 'listen = ["127.0.0.1:8089"]\n[[grpc.token]]\nname = "x"'),
    ('directory = "dumps"', "trigger = {}"),
    ('directory = "dumps"', 'directory = "dumps"\nregisters = "x"'),
    ('process = "cell"', 'process = "cell"\nstate = "dead"'),
    ('process = "cell"', 'process = "cell"\nstate = []'),
]
"""Texts of VALID or BELT, and what makes the configuration invalid in their place."""


def faults(schema: dict[str, Any], tables: dict[str, Any]) -> list[str]:
    return [f"{error.json_path}: {error.message}" for error in jsonschema.Draft7Validator(schema).iter_errors(tables)]


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    return schema_of("supervisor", BUILT_IN)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    shutil.copy(ROOT / "db201.db", tmp_path)
    return tmp_path / "supervisor.toml"


@pytest.mark.parametrize("kind", SCHEMAS)
def test_the_stored_schema_is_current(kind: str) -> None:
    made = json.loads(json.dumps(schema_of(kind, BUILT_IN)))
    jsonschema.Draft7Validator.check_schema(made)
    command = f"shmio-supervisor schema {kind} >docs/reference/schemas/{kind}.json"
    assert json.loads((STORED / f"{kind}.json").read_text()) == made, f"run {command}"


def test_the_command_prints_the_schema(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema", "campaign"]) == 0
    assert json.loads(capsys.readouterr().out) == schema_of("campaign", BUILT_IN)
    assert main(["schema"]) == 0
    assert set(BUILT_IN) <= set(
        json.loads(capsys.readouterr().out)["definitions"]["Source"]["properties"]["connector"]["enum"]
    )


@pytest.mark.parametrize("valid", [VALID, VALID + BELT])
def test_both_accept_a_valid_configuration(
    schema: dict[str, Any], file: Path, capsys: pytest.CaptureFixture[str], valid: str
) -> None:
    file.write_text(valid)
    assert faults(schema, tomllib.loads(valid)) == []
    assert main(["check", "-c", str(file)]) == 0, capsys.readouterr().err


@pytest.mark.parametrize(("text", "wrong"), INVALID)
def test_both_refuse_an_invalid_configuration(
    schema: dict[str, Any], file: Path, capsys: pytest.CaptureFixture[str], text: str, wrong: str
) -> None:
    valid = VALID if text in VALID else VALID + BELT
    assert text in valid
    changed = valid.replace(text, wrong, 1)
    file.write_text(changed)
    assert faults(schema, tomllib.loads(changed))
    assert main(["check", "-c", str(file)]) == 1
    assert "supervisor.toml" in capsys.readouterr().err


def test_keys_of_a_properties_file_are_not_needed_twice(schema: dict[str, Any]) -> None:
    without = VALID.replace('host = "127.0.0.1"\n', 'properties = "plc.ini"\n')
    assert faults(schema, tomllib.loads(without)) == []


@pytest.mark.parametrize(
    "name", [str(file.relative_to(ROOT)) for file in sorted(ROOT.glob("examples/**/supervisor.toml"))]
)
def test_examples_are_valid(schema: dict[str, Any], name: str) -> None:
    connector = ["$.source[0].connector: 'mtconnect' is not one of"] if "mtconnect" in name else []
    found = faults(schema, tomllib.loads((ROOT / name).read_text()))
    assert [one[: len(wanted)] for one, wanted in zip(found, connector, strict=True)] == connector


def test_the_other_files_are_valid() -> None:
    assert faults(schema_of("campaign", ()), tomllib.loads((ROOT / "examples/falsify/campaign.toml").read_text())) == []
    assert faults(schema_of("scene", ()), tomllib.loads((ROOT / "scene.toml").read_text())) == []
    for kind in ("supervisor.toml", "shmio/cli/a50/supervisor.toml"):
        assert faults(schema_of("supervisor", BUILT_IN), tomllib.loads((ROOT / kind).read_text())) == []


@pytest.mark.parametrize(
    "wrong",
    [
        'name = { from = 1, to = 2 }\ntarget = "a/b"\noperation = "freeze"',
        'name = "x"\ntarget = "a/b"\noperation = "delay"\ndelay_ms = { from = 1 }',
        'name = "x"\ntarget = "a/b"\noperation = "delay"\ndelay_ms = { from = 1, to = 2, steps = 1 }',
        'name = "x"\ntarget = "a/b"\noperation = "delay"\ndelay_ms = { choice = [1] }',
        'name = "x"\noperation = "delay"\ndelay_ms = 1',
    ],
)
def test_both_refuse_an_invalid_campaign(tmp_path: Path, wrong: str) -> None:
    text = f'[[injection]]\n{wrong}\n[[expect]]\nname = "e"\nalways = "a/b > 0"\n'
    assert faults(schema_of("campaign", ()), tomllib.loads(text))
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(ConfigError):
        CampaignFile(tmp_path / "c.toml")


@pytest.mark.parametrize(
    "wrong", ["[[body]]\nname = 1", "[floor]\nsize = 1", "[[body]]\n[[body.shape]]\nform = 'cone'"]
)
def test_both_refuse_an_invalid_scene(tmp_path: Path, wrong: str) -> None:
    assert faults(schema_of("scene", ()), tomllib.loads(wrong))
    (tmp_path / "s.toml").write_text(wrong)
    assert examine_scene(tmp_path / "s.toml")[1]
