"""Declared injections in files: valid keys, and errors that name the full key."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.config import Declaration, load
from shmio.config.campaign import CampaignFile, read_campaign
from shmio.config.declaration import KEYS, contradictions
from shmio.errors import ConfigError

GOOD = """
[[injection]]
name = "drift"
target = "cell/a"
operation = "offset"
value = 1.5
start_s = 1
end_s = 2.5
"""


def campaign(folder: Path, text: str) -> list[Declaration]:
    file = folder / "c.toml"
    file.write_text(text)
    return read_campaign(file)


def test_a_campaign_is_read(tmp_path: Path) -> None:
    (drift,) = campaign(tmp_path, GOOD)
    assert (drift.name, drift.target, drift.value, drift.start_s, drift.end_s) == ("drift", "cell/a", 1.5, 1, 2.5)


def test_configuration_may_declare_injections(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text('[instance]\nname = "x"\n' + GOOD)
    assert [declared.name for declared in load(tmp_path / "s.toml").injection] == ["drift"]
    (tmp_path / "s.toml").write_text('[instance]\nname = "x"\n' + GOOD + "speed = 1\n")
    with pytest.raises(ConfigError, match=r'injection\[0\]\.speed: unknown key; .*\(injection "drift"\)'):
        load(tmp_path / "s.toml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"drift"', '"a drift"', "injection[0].name: expected a name"),
        ("value = 1.5", "", "injection[0].value: this key is needed for operation 'offset'"),
        ("value = 1.5", "value = nan", "injection[0].value: nan is not a number"),
        ("value", "amplitude = 1\nvalue", "injection[0].amplitude: operation 'offset' has no such key"),
        ('"offset"', '"ofset"', "injection[0].operation: unknown operation 'ofset'; did you mean 'offset'?"),
        ("end_s = 2.5", "end_s = 1", "injection[0].end_s: 1 is not after start_s, 1"),
        ("end_s = 2.5", "times = 2", "injection[0].times: this key is only for an injection with a condition"),
        ("end_s = 2.5", "probability = 0", "injection[0].probability: expected"),
        ("end_s = 2.5", "seed = -1", "injection[0].seed: expected"),
        ("end_s = 2.5", "priority = 1.5", "injection[0].priority: expected a whole number"),
        ("[[injection]]", "[injection]", "injection: write [[injection]] with double brackets"),
        ("[[injection]]", "[[injections]]", "injections: unknown key; did you mean 'injection'?"),
        ("value = 1.5", f"value = {2**65}", "injection[0].value: the number has more than 64 bits"),
        ("value = 1.5", "value = [[1, 2024-01-01]]", "injection[0].value: expected numbers, text"),
    ],
)  # fmt: skip
def test_errors_name_the_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        campaign(tmp_path, GOOD.replace(old, new))
    assert re.match(rf"{re.escape(str(tmp_path / 'c.toml'))}:[2-8]: {re.escape(message)}", str(refused.value))
    assert "\n" not in str(refused.value)


FAULTY = """duration = 3
step_ms = "fast"

[[injection]]
name = "drift"
target = "cell/a"
operation = "ofset"
speed = 1

[[injection]]
name = "drift"
target = "cell/a"
operation = "offset"

[[expect]]
name = "low"
stays = "cell/a"
"""


@pytest.mark.parametrize("read", [read_campaign, CampaignFile])
def test_all_faults_are_shown_with_their_lines(tmp_path: Path, read: Callable[[Path], object]) -> None:
    file = tmp_path / "c.toml"
    file.write_text(FAULTY)
    with pytest.raises(ConfigError) as refused:
        read(file)
    found = [line.removeprefix(f"{file}:") for line in str(refused.value).splitlines()]
    assert [line.partition("; ")[0] for line in found] == [
        "1: duration: unknown key",
        "2: step_ms: expected a number, found 'fast'",
        "7: injection[0].operation: unknown operation 'ofset'",
        "8: injection[0].speed: unknown key",
        "10: injection[1].value: this key is needed for operation 'offset' (injection \"drift\")",
        '15: expect[0].for_s: this key is needed with stays (expect "low")',
    ]


def test_duplicate_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"injection\[1\]\.name: 'drift' is already the name of injection\[0\]"):
        campaign(tmp_path, GOOD + GOOD)


@pytest.mark.parametrize(
    ("operation", "keys", "message"),
    [
        ("random", {}, "values: operation 'random' needs values, or min and max"),
        ("random", {"min": 1}, "values: operation 'random' needs values, or min and max"),
        ("random", {"values": [1], "max": 1}, "values: operation 'random' needs values, or min and max"),
        ("random", {"min": 2, "max": 1}, "min: 2 is above max, 1"),
        ("delay", {}, "delay_ms: operation 'delay' needs delay_ms, or delay_cycles"),
        ("delay", {"delay_ms": 1, "delay_cycles": 1}, "delay_ms: operation 'delay' needs delay_ms, or delay_cycles"),
        ("clamp", {}, "min: operation 'clamp' needs min, max, or both"),
        ("freeze", {"probability": 0.5}, "probability: operation 'freeze' has no such key"),
        ("set", {"value": [[[[[[[[1]]]]]]]]}, "value: lists are nested more than 6 deep"),
    ],
)
def test_operands_must_fit_the_operation(operation: str, keys: dict[str, object], message: str) -> None:
    declared = msgspec.convert({"name": "x", "target": "a", "operation": operation, **keys}, Declaration)
    assert next(contradictions(declared)).startswith(message)


values = st.one_of(st.integers(), st.floats(), st.booleans(), st.text(max_size=5), st.lists(st.integers(), max_size=3))
KEY_NAMES = sorted(
    {key for keys in KEYS.values() for key in keys.known} | {"start_s", "end_s", "when", "for_s", "times"}
)


@given(st.sampled_from(sorted(KEYS)), st.dictionaries(st.sampled_from(KEY_NAMES), values, max_size=5))
def test_accepted_declaration_survives_json(operation: str, keys: dict[str, object]) -> None:
    try:
        declared = msgspec.convert({"name": "x", "target": "a", "operation": operation, **keys}, Declaration)
    except msgspec.ValidationError:
        return
    if not list(contradictions(declared)):
        assert msgspec.json.decode(msgspec.json.encode(declared), type=Declaration) == declared
