"""The fabric in a configuration: its processes, and warnings about its rules."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.config import load
from shmio.errors import ConfigError
from shmio.layout.model import Layout, Register
from shmio.plan.fabric import odd_rules
from shmio.plan.prepare import prepare
from shmio.plan.processes import Plan

BLOCK = """DATA_BLOCK DB7 { S7_Optimized_Access := 'FALSE' } STRUCT
  Inputs : Array[0..9] of Byte; Level : Real; END_STRUCT; BEGIN END_DATA_BLOCK"""
SOURCE = '[instance]\nname = "joined"\n[[source]]\nname = "cell"\nconnector = "memory"\nlayout = "cell.db"\n'
FABRIC = '[fabric]\nserver = "embedded"\nlisten = "127.0.0.1:4333"\n'
CELL = 'cell = "plant1.line3.a50"\n'


def plan(folder: Path, fabric: str) -> Plan:
    (folder / "cell.db").write_text(BLOCK)
    (folder / "supervisor.toml").write_text(SOURCE + fabric)
    return prepare(folder / "supervisor.toml").plan


def test_the_server_starts_first_and_the_uplink_last(tmp_path: Path) -> None:
    found = plan(tmp_path, FABRIC + CELL)
    assert [job.name for job in sorted(found.jobs, key=lambda job: job.rank)] == ["nats", "cell", "fabric"]
    nats, uplink = found.jobs[1:]
    assert nats.listening == ["127.0.0.1:4333"]
    assert uplink.listening == []
    assert uplink.config["access"]["servers"] == ("nats://127.0.0.1:4333",)
    assert [job.name for job in plan(tmp_path, FABRIC).jobs] == ["cell", "nats"], "nothing is published"


def test_the_web_page_gets_the_access_only_with_a_fabric(tmp_path: Path) -> None:
    web = '[web]\nlisten = "127.0.0.1:4334"\n'
    (with_fabric,) = [job for job in plan(tmp_path, FABRIC + web).jobs if job.name == "web"]
    assert with_fabric.config["fabric"]["servers"] == ("nats://127.0.0.1:4333",)
    (without,) = [job for job in plan(tmp_path, web).jobs if job.name == "web"]
    assert without.config["fabric"] is None


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        ('match = "sell"\n', "fabric.rule[0].match: 'sell' matches no source"),
        ('match = "cell"\nregisters = ["cell/Lewel"]\n', "fabric.rule[0].registers: "),
        ('match = "cell"\nmax_rate_hz = 0.5\n', "fabric.rule[0].max_rate_hz: frames of cell come each 2 s"),
    ],
)
def test_odd_rules_are_reported(tmp_path: Path, rule: str, words: str) -> None:
    (warning,) = plan(tmp_path, f"{FABRIC}{CELL}[[fabric.rule]]\n{rule}").warnings
    assert words in warning


def test_a_source_that_is_too_large_is_named(tmp_path: Path) -> None:
    large = {"cell": Layout("DB7", 7, 600_000, True, (Register("level", "REAL", (), 0, None, 4, 1),))}
    file = tmp_path / "supervisor.toml"
    file.write_text(SOURCE + FABRIC + CELL)
    with pytest.raises(ConfigError, match="source cell has 600000 bytes"):
        list(odd_rules(load(file), large))
    file.write_text(f'{SOURCE}{FABRIC}{CELL}[[fabric.rule]]\nmatch = "*"\nsend = "nothing"\n')
    assert list(odd_rules(load(file), large)) == []


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ('cell = "a50"\n', r"fabric\.cell: 'a50' is not the name of a cell"),
        (f'{CELL}[fabric.tls]\ncertificate = "none.pem"\nkey = "none.pem"\n', r"fabric\.tls\.certificate: .*No such"),
        (f'{CELL}[[fabric.allow]]\nsender = "plant1"\nroles = ["write"]\n', r"fabric\.allow\[0\]\.sender: 'plant1'"),
        (f'{CELL}[[fabric.allow]]\nsender = "*.*.*"\nroles = ["control"]\n', r"roles\[0\]: unknown role 'control'"),
    ],
)
def test_faults_are_named(tmp_path: Path, keys: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        plan(tmp_path, FABRIC + keys)
