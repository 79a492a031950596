"""What messages mean, without a broker: shapes, times, selected objects, and Sparkplug's aliases and qualities."""

from __future__ import annotations

import json
import math
import time
from typing import Any

import msgspec
import pytest

from shmio.connectors.mqtt.commands import plan
from shmio.connectors.mqtt.metric import encode
from shmio.connectors.mqtt.options import MqttOptions
from shmio.connectors.mqtt.store import Store
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import encode as to_writes
from shmio.model.statuses import (
    BAD,
    BAD_CONFIGURATION_ERROR,
    BAD_INDEX_RANGE_NO_DATA,
    BAD_OUT_OF_RANGE,
    BAD_TYPE_MISMATCH,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    UNCERTAIN,
    UNREADABLE_TIME,
    RegisterStatus,
    StatusArea,
    describe,
    unknown_quality,
)
from shmio.wire import sparkplug_b_pb2 as wire
from tests.unit.connectors.source import layout_of

SECOND = 1_709_208_000


class Broker:
    """A store, and the messages that it gets."""

    def __init__(self, tags: dict[str, Any], **options: Any) -> None:
        given = {"url": "mqtt://127.0.0.1", "max_age_ms": 0} | options
        self.store = Store(layout_of(tags), msgspec.convert(given, MqttOptions))
        self.seq = 0

    def publish(self, topic: str, document: Any) -> None:
        self.store.take(topic, json.dumps(document).encode(), retained=False)

    def sparkplug(self, kind: str, *metrics: wire.Metric, **given: Any) -> None:
        topic = f"spBv1.0/G/{kind}"
        self.seq = 0 if kind.startswith("NBIRTH") else self.seq
        payload = wire.Payload(timestamp=given.get("timestamp", 1000), seq=self.seq, metrics=metrics)
        self.store.take(topic, payload.SerializeToString(), retained=False)
        self.seq += 1

    def status(self, path: str) -> RegisterStatus:
        layout = self.store.layout
        return StatusArea(layout).get(self.store.image(0), layout.by_path[path])

    def value(self, path: str) -> Value:
        layout = self.store.layout
        return codec(layout.registers[layout.by_path[path]], layout.byte_order).decode(self.store.image(0))


def test_an_array_of_another_shape_is_bad() -> None:
    broker = Broker({"a": ("ARRAY[0..1, 0..2] OF INT", "t $"), "b": ("ARRAY[0..1, 0..1, 0..1] OF INT", "u $")})
    right = [[1, 2, 3], [4, 5, 6]]
    for given, code in (
        (right, GOOD), ([1, 2, 3, 4, 5, 6], GOOD), ([[1, 2], [3, 4], [5, 6]], BAD_INDEX_RANGE_NO_DATA),
        ([[1, 2, 3, 4], [5, 6]], BAD_INDEX_RANGE_NO_DATA), ([[1, 2, 3], 4, 5, 6], BAD_INDEX_RANGE_NO_DATA),
        ([1, 2, 3, 4, 5], BAD_INDEX_RANGE_NO_DATA), ([[[1], [2], [3]], [[4], [5], [6]]], BAD_TYPE_MISMATCH),
    ):  # fmt: skip
        broker.publish("t", given)
        assert (broker.value("a"), broker.status("a").code) == (right, code), given
    broker.publish("u", [[1, 2, 3, 4], [5, 6, 7, 8]])
    assert broker.status("b").code == BAD_INDEX_RANGE_NO_DATA


def test_numbers_that_json_does_not_have() -> None:
    """Python's json writes them."""
    broker = Broker({"a": ("LREAL", "t $.a"), "b": ("INT", "t $.b"), "c": ("STRING[9]", "t $.c")})
    broker.publish("t", {"a": -math.inf, "b": math.nan, "c": "NaN"})
    assert (broker.value("a"), broker.value("c")) == (-math.inf, "NaN")
    assert [broker.status(name).code for name in "abc"] == [GOOD, BAD_TYPE_MISMATCH, GOOD]


def test_an_element_is_written_with_the_elements_written_before_it() -> None:
    """The device has not sent its array since, so the first of two writes is not undone by the second."""
    tags = {"a": {"type": "ARRAY[0..2] OF INT", "address": "t $ -> s $", "writable": True}}
    broker = Broker(tags)
    layout = broker.store.layout

    def write(place: int, value: int) -> Any:
        register = layout.element(layout.registers[0], (place,))
        commands, outcomes = plan(
            broker.store, MqttOptions(url="mqtt://127.0.0.1", max_age_ms=0), to_writes(register, value, "little")
        )
        assert outcomes == [""]
        broker.store.wrote(commands[0].values)
        return json.loads(commands[0].publication.payload)

    broker.publish("t", [1, 2, 3])
    assert write(0, 7) == [7, 2, 3]
    assert write(2, 9) == [7, 2, 9]
    broker.publish("t", [4, 5, 6])  # from here on, the device's own values count
    assert write(1, 8) == [4, 8, 6]


def test_times(caplog: pytest.LogCaptureFixture) -> None:
    broker = Broker({"x": ("INT", "t $.x"), "y": ("INT", "t $.x")}, time="$.at")
    for text, at_ns in (
        (str(SECOND), SECOND * 10**9), (f"{SECOND}123", SECOND * 10**9 + 123 * 10**6),
        ("1709208000.5", SECOND * 10**9 + 5 * 10**8), ("1701121200123", 1_701_121_200_123 * 10**6),
        ("2024-02-29T12:00:00Z", SECOND * 10**9), ("20240229", 1_709_164_800 * 10**9),
    ):  # fmt: skip
        broker.publish("t", {"at": text, "x": 1})
        assert broker.status("x") == (GOOD, at_ns), text
    wrongs: tuple[Any, ...] = ("02/29/2024 12:00:00", 0, "0", "", "202402291200", "20240229120000", [], None)
    for wrong in wrongs:
        broker.publish("t", {"at": wrong, "x": 1})
        code, at_ns = broker.status("x")
        assert code == UNREADABLE_TIME, wrong
        assert abs(at_ns - time.time_ns()) < 60e9, wrong
    broker.publish("t", {"x": 1})
    assert broker.status("x").code == GOOD  # it does not state a time
    assert [record.getMessage() for record in caplog.records] == [
        "t: its time '02/29/2024 12:00:00' cannot be read, so its values are uncertain; shmio uses the time of receipt"
    ]


def test_a_list_that_contains_only_what_has_changed() -> None:
    tags: dict[str, Any] = {name: ("INT", f"kep $.values[id=Line.{name}].v") for name in "abc"}
    broker = Broker(tags, time="$.timestamp")
    broker.publish("kep", {"timestamp": SECOND, "values": [{"id": "Line.a", "v": 1}, {"id": "Line.b", "v": 2}]})
    assert broker.status("c") == (BAD_WAITING_FOR_INITIAL_DATA, 0)
    broker.publish("kep", {"timestamp": SECOND + 1, "values": [{"id": "Line.b", "v": 3}]})
    broker.publish("kep", {"timestamp": SECOND + 2, "values": [{"id": "Line.c", "v": 4}, {"id": "Line.c", "v": 5}]})
    assert [broker.value(name) for name in "abc"] == [1, 3, 5]
    assert [broker.status(name).source_ns // 10**9 - SECOND for name in "abc"] == [0, 1, 2]
    broker.publish("kep", {"timestamp": SECOND, "values": [{"id": "Line.a"}, {"v": 9}, 7]})
    assert [broker.status(name).quality.name for name in "abc"] == ["BAD", "GOOD", "GOOD"]
    after = Broker(tags | {"d": tags["a"]}, time="$.timestamp")
    after.store.inherit(broker.store)
    assert [after.status(name).quality.name for name in "abcd"] == ["BAD", "GOOD", "GOOD", "BAD"]
    assert [after.value(name) for name in "bc"] == [3, 5]


def test_a_quality_and_a_time_beside_each_value(caplog: pytest.LogCaptureFixture) -> None:
    """As Kepware's IoT gateway sends them."""
    tags: dict[str, Any] = {name: ("INT", f"kep $.values[id=Line.{name}].v") for name in "abc"}
    broker = Broker(tags | {"whole": ("INT", "n $")}, time="@.t", quality="@.q")
    for quality, code in (
        (True, GOOD), (False, BAD), (192, GOOD), (24, 0x80310000), ("Good", GOOD), ("bad", BAD), ("odd", UNCERTAIN),
        (None, UNCERTAIN), (512, unknown_quality(512)),
    ):  # fmt: skip
        values = [{"id": "Line.a", "v": 1, "q": quality, "t": SECOND}, {"id": "Line.b", "v": 2, "q": True, "t": 0}]
        broker.publish("kep", {"timestamp": 5, "values": [*values, {"id": "Line.c", "v": 3, "t": SECOND + 1}]})
        assert broker.status("a") == (code, SECOND * 10**9), quality
        assert (broker.status("b").code, broker.status("c")) == (UNREADABLE_TIME, (UNCERTAIN, (SECOND + 1) * 10**9))
        assert [broker.value(name) for name in "abc"] == [1, 2, 3]
    assert "c: it has no quality (the JSON has no member 'q')" in caplog.text
    broker.publish("n", 7)
    assert (broker.value("whole"), broker.status("whole").code) == (7, UNCERTAIN)


def metric(value: int | float, alias: int, name: str = "", datatype: int = 2, quality: Any = None) -> wire.Metric:
    made = wire.Metric(alias=alias)
    if name:
        made.name = name
    encode(made, datatype, value, None)
    if quality is not None:
        made.properties.keys.append("Quality")
        stated = made.properties.values.add()
        field = {int: "int_value", str: "string_value", float: "double_value"}[type(quality)]
        setattr(stated, field, quality & 0xFFFFFFFF if isinstance(quality, int) else quality)
    return made


def test_an_alias_of_two_devices(caplog: pytest.LogCaptureFixture) -> None:
    broker = Broker({name: ("INT", f"sparkplug G/N/{name} metric m") for name in "ab"})
    broker.sparkplug("NBIRTH/N")
    for name in "ab":
        broker.sparkplug(f"DBIRTH/N/{name}", metric(0, 7, "m"), metric(0, 8, "n"))
    broker.sparkplug("DDATA/N/a", metric(5, 7))
    assert (broker.value("a"), broker.value("b")) == (5, 0)
    broker.sparkplug("DDATA/N/b", metric(6, 7))
    assert (broker.value("a"), broker.value("b")) == (5, 6)
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 1
    assert "'a' and of 'b' have the same alias 7" in lines[0]
    after = Broker({name: ("INT", f"sparkplug G/N/{name} metric m") for name in "ab"})
    after.store.inherit(broker.store)
    after.seq = broker.seq
    after.sparkplug("DDATA/N/a", metric(9, 7))
    assert (after.value("a"), after.value("b")) == (9, 6)
    after.sparkplug("DBIRTH/N/a", metric(1, 9, "m"))
    after.sparkplug("DDATA/N/a", metric(2, 7))  # the alias of the other device is not its own
    assert after.status("a").code == BAD_WAITING_FOR_INITIAL_DATA
    after.sparkplug("NBIRTH/N")
    after.sparkplug("DBIRTH/N/a", metric(1, 9, "m"))
    after.sparkplug("DBIRTH/N/a", wire.Metric(name="m", datatype=2, int_value=3))
    assert (after.value("a"), after.status("a").code) == (3, GOOD)
    after.sparkplug("DDATA/N/a", metric(2, 9))  # its last birth does not have the alias
    assert after.status("a").code == BAD_WAITING_FOR_INITIAL_DATA


def test_an_alias_of_two_metrics() -> None:
    """Nobody knows which metric a value with this alias belongs to; a command names the metric."""
    broker = Broker({name: ("INT", f"sparkplug G/N metric {name}") for name in "abc"})
    broker.sparkplug("NBIRTH/N", metric(1, 7, "a"), metric(2, 7, "b"), metric(3, 8, "c"), metric(4, 8, "unread"))
    broker.sparkplug("NDATA/N", metric(5, 7), metric(6, 8))
    assert [broker.status(name).code for name in "abc"] == [BAD_CONFIGURATION_ERROR] * 3
    broker.sparkplug("NDATA/N", metric(9, 7, "b"))
    assert (broker.value("b"), broker.status("b").code, broker.status("a").code) == (9, GOOD, BAD_CONFIGURATION_ERROR)
    command = wire.Payload.FromString(broker.store.command({0: 3})[1])
    assert [(one.name, one.HasField("alias")) for one in command.metrics] == [("a", False)]


def test_qualities() -> None:
    """OPC 10000-8, table A.61, and the three numbers of Sparkplug's specification."""
    broker = Broker({"m": ("INT", "sparkplug G/N metric m")})
    for quality, found in (
        (192, "Good "), (195, "Good "), (255, "Good "), (216, "GoodLocalOverride "), (192.0, "Good "),
        (64, "Uncertain "), (68, "UncertainLastUsableValue "), (80, "UncertainSensorNotAccurate "),
        (84, "UncertainEngineeringUnitsExceeded "), (88, "UncertainSubNormal "), (127, "Uncertain "),
        (0, "Bad "), (4, "BadConfigurationError "), (8, "BadNotConnected "), (12, "BadDeviceFailure "),
        (16, "BadSensorFailure "), (20, "BadOutOfService "), (24, "BadNoCommunication "), (28, "BadOutOfService "),
        (32, "BadWaitingForInitialData "), (63, "Bad "), (500, "UncertainLastUsableValue "),
        (512, "Uncertain "), (128, "Uncertain "), (191, "Uncertain "), (256, "Uncertain "),
        (-1, "Uncertain "), (70_000, "Uncertain "), ("192", "Uncertain "), (192.5, "Uncertain "),
    ):  # fmt: skip
        broker.sparkplug("NBIRTH/N", metric(3, 1, "m", quality=quality))
        status = broker.status("m")
        assert describe(status.code).startswith(found), quality
        assert broker.value("m") == 3
        assert ("which has no meaning" in status.reason) == (quality in (512, 128, 191, 256, 70_000)), quality
        assert ("the quality 512," in status.reason) == (quality == 512)


def test_an_unknown_quality_is_logged_with_its_number(caplog: pytest.LogCaptureFixture) -> None:
    broker = Broker({"m": ("INT", "sparkplug G/N metric m")})
    for quality in (70_000, 70_000, "good"):
        broker.sparkplug("NBIRTH/N", metric(3, 1, "m", quality=quality))
        broker.store.image(0)
    assert [record.getMessage().split(",")[0] for record in caplog.records] == [
        "m: its quality is 70000", "m: its quality is 'good'"
    ]  # fmt: skip


def test_metrics_that_contradict_their_birth_or_have_no_time() -> None:
    broker = Broker({"m": ("DINT", "sparkplug G/N metric m")})
    for given, code in (
        (metric(1, 1), GOOD), (metric(1.0, 1, datatype=10), BAD_TYPE_MISMATCH),
        (wire.Metric(alias=1, int_value=40_000), GOOD), (wire.Metric(alias=1, int_value=100_000), BAD_OUT_OF_RANGE),
        (wire.Metric(alias=1, int_value=0xFFFF_FFFF), GOOD),
        (wire.Metric(alias=1, int_value=5, timestamp=0), UNREADABLE_TIME),
        (wire.Metric(alias=1, int_value=5, timestamp=1 << 63), UNREADABLE_TIME),
    ):  # fmt: skip
        broker.sparkplug("NBIRTH/N", metric(0, 1, "m"))
        broker.sparkplug("NDATA/N", given)
        assert broker.status("m").code == code, given
    broker.sparkplug("NBIRTH/N", metric(0, 1, "m"), timestamp=None)
    assert broker.status("m").code == GOOD
