"""The examples in docs/how-to/read-mqtt-topics.md are valid."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import msgspec

from shmio.connectors.mqtt.options import MqttOptions
from shmio.connectors.mqtt.store import Store
from tests.unit.connectors.source import layout_of

PAGE = Path(__file__).parents[4] / "docs/how-to/read-mqtt-topics.md"
COMMON = {"name", "connector", "layout", "period_ms"}


def test_the_examples() -> None:
    table, source, own = (tomllib.loads(text) for text in re.findall(r"```toml\n(.*?)```", PAGE.read_text(), re.DOTALL))
    layout = layout_of(table["registers"])
    for example in (source, own):
        given = {key: value for key, value in example["source"][0].items() if key not in COMMON}
        Store(layout, msgspec.convert(given, MqttOptions))


def test_every_key_is_described() -> None:
    section = PAGE.read_text().partition("## Keys")[2].partition("\n## ")[0]
    for field in msgspec.structs.fields(MqttOptions):
        assert f"`{field.name}`" in section, field.name
