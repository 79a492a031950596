"""The wording of msgspec's errors, which ``explain`` parses and msgspec does not guarantee."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import pytest

from shmio.config.faults import but_found, explain
from shmio.config.model import NAME_PATTERN, NAME_RULE


class Item(msgspec.Struct):
    size: int


class Sample(msgspec.Struct, forbid_unknown_fields=True):
    name: Annotated[str, msgspec.Meta(pattern=NAME_PATTERN)] = "x"
    text: Annotated[str, msgspec.Meta(min_length=1)] = "x"
    several: Annotated[list[Item], msgspec.Meta(min_length=1)] | None = None
    clock: Literal["wall", "stepped"] = "wall"
    number: int | float | None = None


@pytest.mark.parametrize(
    ("value", "words", "wanted"),
    [
        (
            {"several": [{"size": 1}, {}]},
            "Object missing required field `size` - at `$.several[1]`",
            "several[1].size: this key is needed",
        ),
        (
            {"several": [{"size": "x"}]},
            "Expected `int`, got `str` - at `$.several[0].size`",
            "several[0].size: expected a whole number, found 'x'",
        ),
        (
            {"number": True},
            "Expected `int | float | null`, got `bool` - at `$.number`",
            "number: expected a whole number or a number, found true",
        ),
        (
            {"name": "-"},
            f"Expected `str` matching regex {NAME_PATTERN!r} - at `$.name`",
            f"name: expected a name: {NAME_RULE}, found '-'",
        ),
        ({"text": ""}, "Expected `str` of length >= 1 - at `$.text`", "text: must not be empty"),
        ({"several": []}, "Expected `array` of length >= 1 - at `$.several`", "several: must not be empty"),
        (
            {"clock": "Wall"},
            "Invalid enum value 'Wall' - at `$.clock`",
            "clock: unknown clock 'Wall'; did you mean 'wall'?",
        ),
        ([], "Expected `object`, got `array`", "expected a table, found []"),
    ],
)
def test_msgspec_words_its_errors_as_explain_expects(value: Any, words: str, wanted: str) -> None:
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert(value, Sample)
    assert str(caught.value) == words, (
        "this msgspec words its errors differently: adapt shmio/config/faults.py, then the cap in pyproject.toml"
    )
    assert explain(caught.value, "", Sample, value) == wanted


class Secretive(msgspec.Struct):
    password: int = 0
    password_file: str = ""
    account: list[str] = []
    command: list[str] = []
    servers: list[int] = []


@pytest.mark.parametrize(
    ("value", "wanted"),
    [
        ({"password": "swordfish"}, "password: expected a whole number, got text"),
        ({"password_file": ["swordfish"]}, "password_file: expected text, got a list in [ ]"),
        ({"account": "me:swordfish"}, "account: expected a list in [ ], got text"),
        ({"command": "curl -u me:swordfish"}, "command: expected a list in [ ], got text"),
        ({"servers": ["me:swordfish@h"]}, "servers[0]: expected a whole number, found '•••@h'"),
        ({"servers": [1, "nats://u:swordfish@h"]}, "servers[1]: expected a whole number, found 'nats://•••@h'"),
        ({"servers": [{"token": "swordfish"}]}, "servers[0]: expected a whole number, found {'token': '•••'}"),
        ({"servers": ["\x1b[2J" + "x" * 100]}, rf"servers[0]: expected a whole number, found '\x1b[2J{'x' * 51}…"),
    ],
)
def test_the_wrong_value_is_shown_escaped_bounded_and_without_secrets(value: Any, wanted: str) -> None:
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert(value, Secretive)
    assert explain(caught.value, "", Secretive, value) == wanted


@pytest.mark.parametrize("key", ["grpc.token", "grpc.token[0]", "grpc.token[0].sha256", "mqtt.account", "a.password"])
def test_a_value_in_the_place_of_a_table_with_secrets_is_not_shown(key: str) -> None:
    assert but_found(key, "swordfish") == ""
    assert but_found("grpc.token[0].name", 3) == ", found 3"
