"""The MQTT connector against mosquitto and a device made with Node's mqtt."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest

from shmio.connectors.base import Lost, UnconfirmedError, WriteLostError
from shmio.errors import ConnectorError
from shmio.layout.values.write import encode
from shmio.model import statuses
from shmio.testing.ports import reserved_port
from shmio.testing.proxy import FaultProxy
from shmio.testing.write_conformance import confirm, write
from tests.unit.connectors.mqtt.conftest import Plant
from tests.unit.connectors.mqtt.peer import Peer, connected, framing
from tests.unit.connectors.source import Source

TAGS = {
    "pos": ("LREAL", "plant/pos"),
    "lamp": ("BOOL", "plant/lamp 1"),
    "name": ("STRING[20]", "plant/name"),
    "x": ("LREAL", "plant/state $.axes[0].pos"),
    "y": ("INT", "plant/state $['axes'][1].pos"),
    "all": ("ARRAY[1..3] OF DINT", "plant/all $"),
}


def test_texts_and_json_of_topics(plant: Plant) -> None:
    with connected(plant.address, TAGS) as source:
        source.read()
        assert {source.code(path) for path in TAGS} == {statuses.BAD_WAITING_FOR_INITIAL_DATA}
        plant.device.publish("plant/pos", " 1.5e0\n")
        plant.device.publish("plant/lamp 1", "ON")
        plant.device.publish("plant/name", "Größe 3")
        plant.device.publish("plant/state", {"axes": [{"pos": 2.5}, {"pos": -7}]})
        plant.device.publish("plant/all", [1, 2, 3])
        source.until(lambda: source.code("all") == 0)
        assert [source.value(path) for path in TAGS] == [1.5, True, "Größe 3", 2.5, -7, [1, 2, 3]]
        assert {source.code(path) for path in TAGS} == {0}
        assert abs(source.source_ns("pos") - time.time_ns()) < 60e9


@pytest.mark.parametrize(
    ("payload", "codes"),
    [
        ({"axes": [{"pos": 1}]}, (0, statuses.BAD_INDEX_RANGE_NO_DATA)),
        ({"axes": [{"pos": 1}, {}]}, (0, statuses.BAD_NOT_FOUND)),
        ({"axes": [{"pos": 1}, {"pos": 40000}]}, (0, statuses.BAD_OUT_OF_RANGE)),
        ({"axes": [{"pos": 1}, {"pos": 1.5}]}, (0, statuses.BAD_TYPE_MISMATCH)),
        ({"axes": [{"pos": 1}, {"pos": True}]}, (0, statuses.BAD_TYPE_MISMATCH)),
        ({"axes": [{"pos": None}, {"pos": "12"}]}, (statuses.BAD_NO_DATA, 0)),
        ({"axes": {"0": 1}}, (statuses.BAD_TYPE_MISMATCH,) * 2),
        ("{", (statuses.BAD_DECODING_ERROR,) * 2),
        ("", (statuses.BAD_NO_DATA,) * 2),
        ("[" * 100_000, (statuses.BAD_DECODING_ERROR,) * 2),
        ('{"axes": [{"pos": 1e999}]}', (statuses.BAD_DECODING_ERROR,) * 2),
        ("9" * 5000, (statuses.BAD_DECODING_ERROR,) * 2),
        ("9" * 500, (statuses.BAD_TYPE_MISMATCH,) * 2),
    ],
)
def test_a_wrong_value_is_bad_alone(plant: Plant, payload: Any, codes: tuple[int, int]) -> None:
    with connected(plant.address, TAGS) as source:
        plant.device.publish("plant/state", {"axes": [{"pos": 1}, {"pos": 2}]})
        plant.device.publish("plant/pos", "1")
        source.until(lambda: (source.code("x"), source.code("y"), source.code("pos")) == (0, 0, 0))
        plant.device.publish("plant/state", payload)
        source.until(lambda: (source.code("x"), source.code("y")) == codes)
        assert source.code("pos") == 0


def test_the_reason_is_logged_once(plant: Plant, caplog: pytest.LogCaptureFixture) -> None:
    with connected(plant.address, TAGS) as source:
        for text in ("one", "two", "three"):
            plant.device.publish("plant/pos", text)
            source.until(lambda: source.code("pos") == statuses.BAD_DECODING_ERROR)
        assert [record.getMessage() for record in caplog.records] == ["pos: 'one' is not a number"]


def test_the_last_message_of_a_period_wins(plant: Plant) -> None:
    with connected(plant.address, TAGS) as source:
        plant.device.ask("flood", "plant/pos", 3000)
        source.until(lambda: source.value("pos") == 3000.0)
        assert source.code("pos") == 0


def test_a_value_grows_old(plant: Plant) -> None:
    ages = {"pos": 60, "**": 0}
    with connected(plant.address, TAGS, max_age_ms=ages) as source:
        plant.device.publish("plant/pos", "1")
        plant.device.publish("plant/name", "a")
        source.until(lambda: source.code("pos") == 0 == source.code("name"))
        source.until(lambda: source.code("pos") == statuses.BAD_TIMEOUT)
        assert (source.value("pos"), source.code("name")) == (1.0, 0)
        plant.device.publish("plant/pos", "1")
        source.until(lambda: source.code("pos") == 0)


def test_the_age_of_a_kept_message_is_unknown(plant: Plant) -> None:
    plant.device.publish("plant/pos", "7", retain=True)
    plant.device.publish("plant/name", "kept", retain=True)
    with connected(plant.address, TAGS, max_age_ms={"pos": 60_000, "**": 0}) as source:
        source.read()  # what is kept has come with the connection
        assert (source.value("pos"), source.code("pos")) == (7.0, statuses.UNCERTAIN_LAST_USABLE_VALUE)
        assert (source.value("name"), source.code("name")) == ("kept", 0)
        plant.device.publish("plant/pos", "7")
        source.until(lambda: source.code("pos") == 0)
    plant.device.clear("plant/pos", "plant/name")


def test_a_device_that_is_gone(plant: Plant) -> None:
    with (
        Peer() as other,
        connected(plant.address, TAGS, will=[{"topic": "plant/there", "match": ["pos", "x"]}]) as source,
    ):
        offline = {"topic": "plant/there", "payload": "offline", "retain": True, "qos": 1}
        other.ask("connect", plant.address.port, {"will": offline})
        other.publish("plant/pos", "1")
        other.publish("plant/name", "a")
        source.until(lambda: source.code("name") == 0)
        assert source.code("pos") == statuses.BAD_WAITING_FOR_INITIAL_DATA  # it has not said that it is there
        other.publish("plant/there", "online", retain=True)
        source.until(lambda: source.code("pos") == 0)
        other.ask("die")
        source.until(lambda: source.code("pos") == statuses.BAD_NO_COMMUNICATION)
        assert source.code("name") == 0
        plant.device.publish("plant/there", "online", retain=True)
        source.until(
            lambda: source.code("pos") == statuses.BAD_WAITING_FOR_INITIAL_DATA
        )  # its value is of its last life
        plant.device.publish("plant/pos", "2")
        source.until(lambda: source.code("pos") == 0)
    plant.device.clear("plant/there")


def test_kept_values_of_a_device_that_was_gone_are_not_good(plant: Plant) -> None:
    plant.device.publish("plant/pos", "1", retain=True)
    plant.device.publish("plant/there", '{"up": false}', retain=True)
    will = [{"topic": "plant/there $.up"}]
    with connected(plant.address, TAGS, will=will) as source:
        source.read()
        assert source.code("pos") == statuses.BAD_NO_COMMUNICATION
        plant.device.publish("plant/there", '{"up": true}', retain=True)
        source.until(lambda: source.code("pos") == statuses.BAD_WAITING_FOR_INITIAL_DATA)
    plant.device.clear("plant/pos", "plant/there")


def test_source_times(plant: Plant) -> None:
    with connected(plant.address, TAGS, time="$.at") as source:
        for at, expected_ns in (
            (1_700_000_000, 1_700_000_000 * 10**9),
            (1_700_000_000_123, 1_700_000_000_123 * 10**6),
            ("2023-11-14T22:13:20.5Z", 1_700_000_000_500_000_000),
        ):
            plant.device.publish("plant/state", {"at": at, "axes": [{"pos": 1}, {"pos": 1}]})
            source.until(lambda expected_ns=expected_ns: source.source_ns("x") == expected_ns)  # type: ignore[misc]
        for wrong in ("yesterday", -5, 1e300, None, True):
            plant.device.publish("plant/state", {"at": wrong, "axes": [{"pos": 1}, {"pos": 1}]})
            source.until(lambda: abs(source.source_ns("x") - time.time_ns()) < 60e9)
            assert source.code("x") == statuses.UNREADABLE_TIME
            plant.device.publish("plant/state", {"at": 5, "axes": [{"pos": 1}, {"pos": 1}]})
            source.until(lambda: source.source_ns("x") == 5 * 10**9)


def test_a_payload_that_is_too_large_is_bad_alone(plant: Plant) -> None:
    with connected(plant.address, TAGS, max_payload_bytes=1000) as source:
        plant.device.publish("plant/pos", "1")
        plant.device.publish("plant/name", " " * 1001)
        source.until(lambda: source.code("name") == statuses.BAD_OUT_OF_RANGE)
        assert source.code("pos") == 0


def test_scaled_values(plant: Plant) -> None:
    tags = {
        "t": {"type": "INT", "address": "plant/t", "scale": [0.1, 5.0], "writable": True},
        "big": {"type": "INT", "address": "plant/big", "scale": 10.0},
    }
    with connected(plant.address, tags) as source:
        plant.device.publish("plant/t", "200")
        plant.device.publish("plant/big", "1e308")
        source.until(lambda: source.code("t") == 0 and source.code("big") == statuses.BAD_OUT_OF_RANGE)
        assert source.value("t") == 25
        assert source.write(t=45) == [""]
        source.read()
        assert source.value("t") == 45


# -- writing -----------------------------------------------------------------------------------------------------------

WRITABLE: dict[str, Any] = {
    "lamp": {"type": "BOOL", "address": "w/lamp -> w/lamp/set", "writable": True},
    "speed": {"type": "LREAL", "address": "w/speed", "writable": True},
    "x": {"type": "LREAL", "address": "w/state $.x -> w/set $.target.x", "writable": True},
    "y": {"type": "DINT", "address": "w/state $.y -> w/set $.target.y", "writable": True},
    "list": {"type": "ARRAY[1..3] OF INT", "address": "w/list $ -> w/list/set $.v", "writable": True},
    "fixed": {"type": "INT", "address": "fixed/number", "writable": True},
    "read": ("INT", "w/read"),
}


def test_writes_are_published(plant: Plant) -> None:
    device = plant.device
    for topic in ("w/lamp/set", "w/set", "w/list/set", "w/speed"):
        device.ask("subscribe", topic)
    with connected(plant.address, WRITABLE, texts=["OFF", "ON"], templates={"w/set": '{"op": "move"}'}) as source:
        assert source.write(lamp=True, speed=2.5, x=1.0, y=-3, list=[1, 2, 3]) == [""] * 5
        assert device.ask("next", "w/lamp/set")["payload"] == "ON"
        assert device.ask("next", "w/set")["payload"] == '{"op":"move","target":{"x":1.0,"y":-3}}'
        assert device.ask("next", "w/list/set")["payload"] == '{"v":[1,2,3]}'
        assert device.ask("next", "w/speed")["retain"] is False
        source.read()
        assert (source.value("speed"), source.code("speed")) == (2.5, 0)
        assert source.code("lamp") == statuses.BAD_WAITING_FOR_INITIAL_DATA  # nobody has reported it
        register = source.layout.registers[source.layout.by_path["speed"]]
        pulse = [encode(register, value, source.layout.byte_order)[0] for value in (1.0, 0.0)]
        assert write(source.connector, pulse) == ["", ""]
        assert [device.ask("next", "w/speed")["payload"] for _ in range(2)] == ["1.0", "0.0"]


def test_writes_that_are_refused(plant: Plant) -> None:
    with connected(plant.address, WRITABLE, will=[{"topic": "w/there", "match": "lamp"}]) as source:
        outcomes = source.write(read=1, fixed=1, x=math.nan, lamp=True, speed=1.0)
        for outcome, words in zip(
            outcomes, ("set `writable", "Not authorized", "neither NaN", "is offline", ""), strict=True
        ):
            assert words in outcome
            assert bool(words) == bool(outcome)
        assert "nobody subscribes to w/nobody" in _write_to_nobody(plant)
        array = source.layout.registers[source.layout.by_path["list"]]
        (element,) = encode(source.layout.element(array, (2,)), 5, source.layout.byte_order)
        assert "write the whole array" in write(source.connector, [element])[0]
        plant.device.publish("w/list", [1, 2, 3])
        source.until(lambda: source.code("list") == 0)
        plant.device.ask("subscribe", "w/list/set")
        assert write(source.connector, [element]) == [""]
        assert plant.device.ask("next", "w/list/set")["payload"] == '{"v":[1,5,3]}'
        (other,) = encode(source.layout.element(array, (3,)), 6, source.layout.byte_order)
        assert write(source.connector, [other]) == [""]  # before the device has sent its array again
        assert plant.device.ask("next", "w/list/set")["payload"] == '{"v":[1,5,6]}'


def _write_to_nobody(plant: Plant) -> str:
    tags = {"a": {"type": "INT", "address": "w/a -> w/nobody", "writable": True}}
    with connected(plant.address, tags) as source:
        (outcome,) = source.write(a=1)
    with connected(plant.address, tags, retain=True) as source:
        assert source.write(a=1) == [""]
    plant.device.clear("w/nobody")
    return outcome


def test_many_writes_and_qos_0(plant: Plant) -> None:
    tags = {f"r{at}": {"type": "INT", "address": f"w/many/{at}", "writable": True} for at in range(100)}
    for qos in (1, 0):
        with connected(plant.address, tags, write_qos=qos) as source:
            assert source.write(**{f"r{at}": at + qos for at in range(100)}) == [""] * 100
            source.read()
            assert [source.value(f"r{at}") for at in range(100)] == [at + qos for at in range(100)]


class Echoes:
    """Keeps back what the broker sends on the topic of a write, until a message comes on another topic."""

    def __init__(self) -> None:
        self._kept = b""

    def __call__(self, packet: bytes) -> bytes:
        if packet[0] >> 4 == 3 and b"w/speed" in packet:
            self._kept += packet
            return b""
        if b"w/read" in packet:
            packet, self._kept = self._kept + packet, b""
        return packet


@contextmanager
def kept_back(plant: Plant, *, value: float | None = 1.0, **options: Any) -> Iterator[tuple[Source, FaultProxy]]:
    """Provide a source that has received a value, and will receive no echoes of its writes."""
    with (
        FaultProxy(plant.address, framing=framing) as proxy,
        connected(plant.address, WRITABLE, url=f"mqtt://{proxy.address}", **options) as source,
    ):
        if value is not None:
            plant.device.publish("w/speed", str(value))
            source.until(lambda: source.value("speed") == value)
        proxy.edit(Echoes())
        yield source, proxy
    plant.device.clear("w/speed")


def test_a_write_is_confirmed_when_frames_show_it(plant: Plant) -> None:
    """Not earlier, although the broker has acknowledged it long ago."""
    with kept_back(plant) as (source, _):
        register = source.layout.registers[source.layout.by_path["speed"]]
        source.connector.send(encode(register, 2.5, source.layout.byte_order))
        assert source.connector.confirm(time.monotonic_ns() + 500_000_000) is None
        source.read()
        assert source.value("speed") == 1.0
        plant.device.publish("w/read", "1")
        assert confirm(source.connector) == [""]
        source.read()
        assert (source.value("speed"), source.code("speed")) == (2.5, 0)


def test_the_outcome_of_a_write_that_frames_do_not_show_is_unknown(plant: Plant) -> None:
    with kept_back(plant, timeout=1500) as (source, _):
        with pytest.raises(UnconfirmedError, match="not sent it back within 1500 ms") as raised:
            source.write(speed=2.5, lamp=True)
        assert raised.value.outcomes[0] is Lost.UNKNOWN
        assert raised.value.outcomes[1] is not Lost.UNKNOWN
        plant.device.publish("w/read", "1")  # the connection still works
        source.until(lambda: source.value("speed") == 2.5)
        assert source.write(speed=2.5) == [""]  # frames show it already
    with kept_back(plant, value=None, timeout=20_000) as (source, _):
        begin_s = time.monotonic()
        assert source.write(speed=2.5) == [""]  # frames show no older value
        assert time.monotonic() - begin_s < 10, "it does not wait for the time-out"
        source.read()
        assert source.code("speed") == statuses.BAD_WAITING_FOR_INITIAL_DATA


@pytest.mark.parametrize("retain", [True, False])
def test_a_write_whose_echo_is_lost_with_the_connection(plant: Plant, retain: bool) -> None:
    """On the next connection, the source sees a retained message, and no other one."""
    with kept_back(plant, retain=retain) as (source, proxy):
        register = source.layout.registers[source.layout.by_path["speed"]]
        source.connector.send(encode(register, 2.5, source.layout.byte_order))
        assert source.connector.confirm(time.monotonic_ns() + 500_000_000) is None
        proxy.cut()
        with pytest.raises(WriteLostError) as raised:
            confirm(source.connector)
        assert raised.value.outcomes == (("",) if retain else (Lost.UNKNOWN,))
        proxy.pass_all()
        source.connector.connect()
        source.read()
        assert source.code("speed") == (0 if retain else statuses.BAD_WAITING_FOR_INITIAL_DATA)
        assert source.value("speed") == (2.5 if retain else 1.0)


def test_a_retained_message_that_may_be_older_than_a_write_is_uncertain(plant: Plant) -> None:
    plant.device.publish("w/speed", "1.0", retain=True)
    with connected(plant.address, WRITABLE) as source:
        source.until(lambda: source.value("speed") == 1.0)
        assert source.write(speed=2.5) == [""]
        for _ in range(2):
            source.connector.connect()
            source.until(lambda: source.value("speed") == 1.0)
            assert source.code("speed") == statuses.UNCERTAIN_LAST_USABLE_VALUE
            plant.device.publish("w/speed", "3.0")
            source.until(lambda: source.value("speed") == 3.0)
            assert source.code("speed") == 0
        plant.device.publish("w/speed", "4.0", retain=True)
        source.until(lambda: source.value("speed") == 4.0)
        source.connector.connect()
        source.until(lambda: source.value("speed") == 4.0)
        assert source.code("speed") == 0, "nothing newer was seen"
    plant.device.clear("w/speed")


def test_without_a_connection_nothing_is_written(plant: Plant) -> None:
    with connected(plant.address, WRITABLE) as source:
        source.connector.close()
        with pytest.raises(WriteLostError) as raised:
            source.write(speed=1.0)
        assert raised.value.outcomes == (Lost.UNSENT,)
        with pytest.raises(ConnectorError, match="not connected"):
            source.read()


# -- the connection ----------------------------------------------------------------------------------------------------


def test_a_reload_keeps_messages_and_changes_the_subscriptions(plant: Plant) -> None:
    device = plant.device
    device.publish("line/a", "1")
    device.publish("line/new", "7", retain=True)
    device.publish("line/status", '{"a": "online", "b": "offline"}', retain=True)
    tags = {name: ("INT", f"line/{name}") for name in ("a", "b", "gone")}
    try:
        with connected(plant.address, tags, client_id="shmio-reload") as source:
            device.publish("line/a", "3")
            source.until(lambda: source.code("a") == 0)
            at_ns = source.source_ns("a")
            tags = {"new": ("INT", "line/new"), "a": tags["a"], "both": ("LREAL", "line/a")}
            wills = [{"topic": "line/status $.a", "match": "a"}, {"topic": "line/status $.b", "match": "both"}]
            source.reload(tags, will=wills)
            assert source.connector.describe().count("shmio-reload") == 1
            source.until(lambda: source.code("a") == 0)  # after the first message about its device
            assert (source.value("a"), source.source_ns("a")) == (3, at_ns)
            source.until(lambda: source.code("new") == 0)
            assert source.value("new") == 7
            source.until(lambda: source.code("both") == statuses.BAD_NO_COMMUNICATION)
            assert source.code("a") == 0
            source.reload(tags, will=[*wills, {"topic": "line/status $.a", "match": "new"}])  # nothing is subscribed
            source.read()
            assert [source.code(path) for path in tags][:2] == [0, 0]
            assert source.code("both") == statuses.BAD_NO_COMMUNICATION
            device.publish("line/gone", "5")  # nobody subscribes to this topic any more
            device.publish("line/a", "4")
            source.until(lambda: source.value("a") == 4)
    finally:
        device.clear("line/new", "line/status")


def test_no_message_is_lost_by_reloads(plant: Plant) -> None:
    tags = {"count": ("DINT", "line/count"), "other": ("INT", "line/other")}
    with connected(plant.address, tags, timeout=10_000) as source, ThreadPoolExecutor(1) as pool:
        flood = pool.submit(plant.device.ask, "flood", "line/count", 5000)
        last, turn = 0, 0
        while not flood.done():
            turn += 1
            source.reload({"count": tags["count"]} if turn % 2 else tags)
            source.read()
            found = source.value("count")
            assert isinstance(found, int)
            assert found >= last
            last = found
        source.until(lambda: source.value("count") == 5000)
        assert turn > 2


def test_a_client_that_takes_over_is_named(plant: Plant) -> None:
    with connected(plant.address, TAGS, client_id="twin") as source:
        source.read()
        taken_over = pytest.raises(ConnectorError, match="does another client connect as twin")
        with connected(plant.address, TAGS, client_id="twin"), taken_over:
            source.until(lambda: False)


def test_both_versions_of_mqtt(plant: Plant) -> None:
    for version, shown in (("auto", "MQTT 5"), ("3.1.1", "MQTT 3.1.1")):
        with connected(plant.address, TAGS, version=version) as source:
            plant.device.publish("plant/pos", "3")
            source.until(lambda: source.value("pos") == 3.0)
            assert shown in source.connector.describe()


def test_a_broker_that_knows_only_mqtt_3() -> None:
    with reserved_port() as address, Peer() as peer:
        peer.ask("broker", address.port)
        peer.ask("connect", address.port, {"protocolVersion": 4})
        with connected(address, TAGS | {"fixed": ("INT", "fixed/number")}) as source:
            peer.publish("plant/pos", "3")
            source.until(lambda: source.value("pos") == 3.0)
            assert "MQTT 3.1.1" in source.connector.describe()
            assert source.code("fixed") == statuses.BAD_USER_ACCESS_DENIED  # alone
            source.reload({"other": ("INT", "fixed/other"), "fixed": ("INT", "fixed/number"), "pos": TAGS["pos"]})
            source.read()
            assert source.value("pos") == 3.0
            assert source.code("fixed") == source.code("other") == statuses.BAD_USER_ACCESS_DENIED
        with pytest.raises(ConnectorError, match="version"), connected(address, TAGS, version="5"):
            pass
