"""Addresses, paths in JSON, and the keys of a source."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from shmio.connectors.mqtt.address import Address, Metric, Place, parse
from shmio.connectors.mqtt.connector import MqttConnector
from shmio.connectors.mqtt.json_path import Choice, assign
from shmio.connectors.mqtt.options import MqttOptions
from shmio.errors import ConfigError
from tests.unit.connectors.source import layout_of


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("plant/robot/pos", Address(Place("plant/robot/pos", None), None)),
        ("  plant/my robot/pos ", Address(Place("plant/my robot/pos", None), None)),
        ("a $", Address(Place("a", ()), None)),
        ("a b $.c d.e[3].f", Address(Place("a b", ("c d", "e", 3, "f")), None)),
        ("a $['x.y'][\"it's\"]", Address(Place("a", ("x.y", "it's")), None)),
        (
            "a $.values[id=Line 1.Axis.Pos].v",
            Address(Place("a", ("values", Choice("id", "Line 1.Axis.Pos"), "v")), None),
        ),
        ("a $[id='x]y'].v", Address(Place("a", (Choice("id", "x]y"), "v")), None)),
        ("$SYS/broker/uptime", Address(Place("$SYS/broker/uptime", None), None)),
        ("costs $5", Address(Place("costs $5", None), None)),
        ("a -> a/set", Address(Place("a", None), Place("a/set", None))),
        ("a $.b -> c $.d[0]", Address(Place("a", ("b",)), Place("c", ("d", 0)))),
        ("sparkplug G 1/N metric Axis/Pos 1", Address(Metric("G 1", "N", "", "Axis/Pos 1"), None)),
        ("sparkplug G/N/D metric a metric b", Address(Metric("G", "N", "D", "a metric b"), None)),
    ],
)
def test_addresses(text: str, address: Address) -> None:
    assert parse(text) == address


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "missing"), ("a/+/b", "one topic"), ("#", "one topic"), ("a $.", "from character 2"),
        ("a $.b[x]", "from character 4"), ("a $.b..c", "from character 4"),
        ("a $[id=x]", "append a member"), ("a $[id=].v", "from character 2"), ("a $[id==x].v", "from character 2"),
         ("a $" + ".b" * 17, "16 steps"),
        ("a\0b", "control"), ("a" * 1001, "1000"), ("$share/g/a", "shared"), ("spBv1.0/G/DDATA/N/D", "sparkplug GROUP"),
        ("sparkplug G/N", "metric NAME"), ("sparkplug G metric a", "GROUP"), ("sparkplug G/N/D/E metric a", "GROUP/"),
        ("sparkplug G/+ metric a", "without +"), ("sparkplug G//D metric a", "GROUP"), ("a -> ", "missing"),
        ("a -> b/#", "one topic"), (" -> b", "missing"), ("\ud800", "or invalid characters"),
    ],
)  # fmt: skip
def test_wrong_addresses(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words.replace("+", r"\+")):
        parse(text)


def test_values_are_set_in_json() -> None:
    assert assign(None, ("a", 0, "b"), 1) == {"a": [{"b": 1}]}
    assert assign({"a": [{"b": 1, "c": 2}], "d": 3}, ("a", 0, "b"), 5) == {"a": [{"b": 5, "c": 2}], "d": 3}
    assert assign({"a": 1}, (), 5) == 5
    assert assign(None, (Choice("id", "x"), "v"), 1) == [{"id": "x", "v": 1}]
    assert assign([{"id": "y", "v": 1}, {"id": "x"}], (Choice("id", "x"), "v"), 2) == [
        {"id": "y", "v": 1}, {"id": "x", "v": 2},
    ]  # fmt: skip
    for wrong in (("a", 1), ("a", "b")):
        with pytest.raises(ValueError, match=r"element|object"):
            assign({"a": [] if wrong[1] == 1 else 5}, wrong, 1)


def make(tags: dict[str, Any], **options: Any) -> None:
    given = {"url": "mqtt://127.0.0.1:1883", "max_age_ms": 0} | options
    MqttConnector(msgspec.convert(given, MqttOptions), layout_of(tags)).close()


@pytest.mark.parametrize(
    ("tags", "options", "words"),
    [
        ({"a": ("INT", "a/+")}, {}, "layout: a: 'a/\\+'"),
        ({"a": ("ARRAY[1..2] OF INT", "a")}, {}, r"an array is read from JSON; write a \$"),
        ({"a": ("DATE", "a")}, {}, "a DATE cannot be read"),
        (
            {"a": {"type": "INT", "address": "a $.b", "writable": True}},
            {},
            "append the topic on which to publish writes",
        ),
        ({"a": ("INT", "a")}, {"max_age_ms": None}, "max_age_ms: a would stay good forever"),
        ({"a": ("INT", "a")}, {"max_age_ms": {"b/**": 5}}, "max_age_ms: a would stay good forever"),
        ({"a": ("INT", "a")}, {"max_age_ms": {"a//b": 5}}, "max_age_ms: .*pattern"),
        ({"a": ("INT", "a")}, {"will": "b/#"}, "will: .*one topic"),
        ({"a": ("INT", "a")}, {"will": [{"topic": "b", "match": "x/**"}]}, r"will: no register matches"),
        ({"a": ("INT", "a")}, {"time": "at"}, "time: 'at' is not a path"),
        ({"a": ("INT", "a")}, {"templates": {"b": "{}"}}, "templates: no register is written to 'b'"),
        (
            {"a": {"type": "INT", "address": "a -> b $.x", "writable": True}},
            {"templates": {"b": "{"}},
            "templates: b: ",
        ),
        ({"a": ("INT", "a")}, {"username": "u", "password_file": "/nowhere"}, "password_file: /nowhere"),
        ({"a": ("INT", "a")}, {"url": "mqtts://127.0.0.1", "ca": "/nowhere"}, "ca: /nowhere"),
    ],
)
def test_layouts_and_keys_that_do_not_fit(tags: dict[str, Any], options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make(tags, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"url": "http://host"}, "expected mqtt://"),
        ({"url": "mqtt://user:pw@127.0.0.1"}, "without a user"),
        ({"url": "mqtt://127.0.0.1/path"}, "expected mqtt://"),
        ({"url": "mqtt://10.1.2.3"}, "plain text over the network"),
        ({"url": "mqtt://127.0.0.1", "ca": "x"}, "has no effect"),
        ({"url": "mqtts://10.1.2.3", "certificate": "x"}, "both certificate and key"),
        ({"url": "mqtt://127.0.0.1", "password_file": "x"}, "username: this key is needed"),
        ({"url": "mqtt://127.0.0.1", "qos": 2}, "qos"),
        ({"url": "mqtt://127.0.0.1", "texts": ["on", "ON"]}, "texts: .*differ"),
    ],
)
def test_wrong_keys(options: dict[str, Any], words: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=words):
        msgspec.convert(options, MqttOptions)


def test_sparkplug_and_wills_need_no_age() -> None:
    make(
        {"a": ("INT", "sparkplug G/N metric a"), "b": ("INT", "b")},
        max_age_ms=None,
        will=[{"topic": "t", "match": "b"}],
    )
    make({"a": ("INT", "a")}, url="mqtt://10.1.2.3", insecure=True)
    make({"a": ("INT", "a")}, url="mqtts://[::1]")
