"""The rosbridge connector against a server made with Node's ws, and against hostile ones."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

import pytest

from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.ros.rosbridge import RosbridgeConnector, RosbridgeOptions
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.values.write import encode
from shmio.model import statuses
from shmio.testing.write_conformance import write
from tests.unit.connectors.ros.bridge import Bridge
from tests.unit.connectors.ros.harness import connected
from tests.unit.connectors.source import layout_of

STATES = "/joint_states sensor_msgs/JointState "
JOINTS = {
    "j1": ("LREAL", f"{STATES}position[name=j1]"),
    "j2": ("LREAL", f"{STATES}position[name=j2]"),
    "third": ("LREAL", f"{STATES}velocity[2]"),
    "all": ("ARRAY[1..2] OF LREAL", f"{STATES}position"),
}
TWIST = {
    path: {"type": "LREAL", "address": f"/cmd_vel geometry_msgs/msg/Twist {field}", "writable": True}
    for path, field in (("vx", "linear.x"), ("wz", "angular.z"))
}


@pytest.fixture(scope="module")
def shared() -> Iterator[Bridge]:
    with Bridge() as bridge:
        yield bridge


@pytest.fixture
def bridge(shared: Bridge) -> Bridge:
    for topic in ("/joint_states", "/cmd_vel", "/mode", "/command", "/other"):
        shared.ask("forget", topic)
    return shared


def joint_state(
    names: list[str], positions: list[Any], sec: int = 0, velocity: list[Any] | None = None
) -> dict[str, Any]:
    stamp = {"sec": sec, "nanosec": 7}
    header = {"stamp": stamp if sec else {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": header, "name": names, "position": positions, "velocity": velocity or [], "effort": []}


def test_joints_are_found_by_name_in_any_order(bridge: Bridge) -> None:
    with connected(bridge.url, JOINTS) as source:
        source.read()
        assert source.code("j1") == statuses.BAD_WAITING_FOR_INITIAL_DATA
        bridge.ask("publish", "/joint_states", joint_state(["j1", "j2"], [1.5, None], sec=1_700_000_000))
        source.until(lambda: source.code("j1") == 0)
        found = source.value("j2")
        assert isinstance(found, float)
        assert math.isnan(found)  # a bridge sends NaN as null
        assert (source.value("j1"), source.source_ns("j1")) == (1.5, 1_700_000_000_000_000_007)
        assert source.code("third") == statuses.BAD_INDEX_RANGE_NO_DATA
        bridge.ask("publish", "/joint_states", joint_state(["j3", "j1"], [9.0, 2.5]))
        source.until(lambda: source.value("j1") == 2.5)
        assert source.value("all") == [9.0, 2.5]
        assert source.source_ns("j1") > 1_700_000_000_000_000_007  # a stamp of 0 is none
        assert source.code("j2") == statuses.BAD_NOT_FOUND
        bridge.ask("publish", "/joint_states", joint_state(["j1"], [3.5]))
        source.until(lambda: source.value("j1") == 3.5)
        assert source.code("all") == statuses.BAD_INDEX_RANGE_NO_DATA


def test_an_old_message_is_bad_and_a_latched_one_is_not(bridge: Bridge) -> None:
    tags = JOINTS | {"mode": ("STRING[20]", "/mode std_msgs/String data")}
    with connected(bridge.url, tags, max_age=50, latched=["/mode"]) as source:
        bridge.ask("publish", "/mode", {"data": "auto"})
        bridge.ask("publish", "/joint_states", joint_state(["j1"], [1.0]))
        source.until(lambda: source.code("j1") == 0)
        source.until(lambda: source.code("j1") == statuses.BAD_TIMEOUT)
        assert (source.value("j1"), source.code("mode"), source.value("mode")) == (1.0, 0, "auto")
        bridge.ask("publish", "/joint_states", joint_state(["j1"], [1.0]))
        source.until(lambda: source.code("j1") == 0)


@pytest.mark.parametrize(
    "message",
    [None, 5, [], "text", {}, {"name": 7, "position": [1.0]}, {"name": ["j1"], "position": "x"},
     {"name": ["j1"], "position": [[]]}, {"name": ["j1"], "position": [True]}, {"name": [["j1"]], "position": [{}]}],
)  # fmt: skip
def test_a_wrong_message_is_bad_alone(bridge: Bridge, message: Any) -> None:
    tags = JOINTS | {"other": ("DINT", "/other std_msgs/Int32 data")}
    with connected(bridge.url, tags) as source:
        bridge.ask("publish", "/joint_states", joint_state(["j1"], [1.0]))
        bridge.ask("publish", "/other", {"data": 7})
        source.until(lambda: source.code("j1") == 0 and source.code("other") == 0)
        bridge.ask("publish", "/joint_states", message)
        source.until(lambda: source.code("j1") >> 30 == 2)
        assert source.code("other") == 0


def test_values_that_do_not_fit_their_register(bridge: Bridge) -> None:
    tags = {"small": ("SINT", "/other std_msgs/Int32 data"), "real": ("REAL", "/mode any_msgs/Thing inside.value")}
    with connected(bridge.url, tags) as source:
        for data in (300, 1 << 70, 1e300):
            bridge.ask("publish", "/other", {"data": 5})
            source.until(lambda: source.code("small") == 0)
            bridge.ask("publish", "/other", {"data": data})
            source.until(lambda: source.code("small") >> 30 == 2)
        bridge.ask("publish", "/mode", {"inside": {"value": 2.5}})  # a type that is not known is read as it comes
        source.until(lambda: source.value("real") == 2.5)
        bridge.ask("publish", "/mode", {"inside": {"value": 1e300}})
        source.until(lambda: source.code("real") == statuses.BAD_OUT_OF_RANGE)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", '{"op": 5}', '{"op": "publish", "topic": 5}', "[" * 100_000,
     '{"op": "status", "msg": ' + "[" * 50_000],
)  # fmt: skip
def test_what_is_not_of_the_protocol_ends_the_connection(bridge: Bridge, text: str) -> None:
    with connected(bridge.url, JOINTS) as source:
        bridge.ask("raw", text)
        with pytest.raises(ConnectorError, match="rosbridge protocol"):
            source.until(lambda: False)


def test_a_message_that_cannot_be_read_is_bad_alone(bridge: Bridge) -> None:
    tags = JOINTS | {"other": ("DINT", "/other std_msgs/Int32 data")}
    head = '{"op": "publish", "topic": "/joint_states", "msg": '
    with connected(bridge.url, tags) as source:
        bridge.ask("publish", "/other", {"data": 7})
        for message in (
            '{"position": [', '{"position": [1.0], "name": ["j1"]', "[" * 5000 + "]" * 5000 + "}", '{"x": 1e999}}',
            "{}}}", "nan}",
        ):  # fmt: skip
            bridge.ask("publish", "/joint_states", joint_state(["j1"], [1.0]))
            source.until(lambda: source.code("j1") == 0 == source.code("other"))
            bridge.ask("raw", head + message)
            source.until(lambda: source.code("j1") == statuses.BAD_DECODING_ERROR)
            assert source.code("other") == 0, message
        for message in (
            '{"topic": "/joint_states", "op": "publish", "msg": nan}', f'{{"msg": nan{" " * 5000}, {head[1:42]}}}',
        ):  # fmt: skip
            bridge.ask("publish", "/joint_states", joint_state(["j1"], [1.0]))
            source.until(lambda: source.code("j1") == 0 == source.code("other"))
            bridge.ask("raw", message)
            source.until(lambda: source.code("j1") == statuses.BAD_DECODING_ERROR)


def test_a_message_that_is_too_large_is_bad_alone(bridge: Bridge, caplog: pytest.LogCaptureFixture) -> None:
    tags = JOINTS | {"other": ("DINT", "/other std_msgs/Int32 data")}
    with connected(bridge.url, tags, max_message_bytes=1000) as source:
        bridge.ask("publish", "/other", {"data": 7})
        bridge.ask("publish", "/joint_states", joint_state(["j1"], [1.0]))
        source.until(lambda: source.code("j1") == 0 == source.code("other"))
        bridge.ask("publish", "/joint_states", joint_state(["j1"], [1.0] * 500))
        source.until(lambda: source.code("j1") == statuses.BAD_DECODING_ERROR)
        assert source.code("other") == 0
        assert "raise max_message_bytes" in caplog.text
        bridge.ask("publish", "/joint_states", joint_state(["j1"], [1.0]))
        source.until(lambda: source.code("j1") == 0)


def test_numbers_that_json_does_not_have(bridge: Bridge) -> None:
    """rosbridge_suite writes them for floats, as Python's json does."""
    tags = JOINTS | {"count": ("DINT", "/other any_msgs/Thing count"), "text": ("STRING[9]", "/other any_msgs/Thing s")}
    with connected(bridge.url, tags) as source:
        bridge.ask("raw", json.dumps({"op": "publish", "topic": "/joint_states", "msg": {
            "name": ["j1", "j2"], "position": [-math.inf, math.nan], "velocity": [1.0, 2.0, math.inf],
        }}))  # fmt: skip
        bridge.ask("raw", '{"op": "publish", "topic": "/other", "msg": {"count": NaN, "s": "NaN, é"}}')
        source.until(lambda: source.code("j1") == 0 == source.code("text"))
        assert (source.value("j1"), str(source.value("j2")), source.value("third")) == (-math.inf, "nan", math.inf)
        assert (source.value("text"), source.code("count")) == ("NaN, é", statuses.BAD_TYPE_MISMATCH)


def test_topics_that_nobody_asked_for_are_ignored(bridge: Bridge) -> None:
    with connected(bridge.url, JOINTS) as source:
        for number in range(100):
            bridge.ask("raw", f'{{"op": "publish", "topic": "/t{number}", "msg": {{}}}}')
        bridge.ask("publish", "/joint_states", joint_state(["j1"], [1.0]))
        source.until(lambda: source.code("j1") == 0)


def test_both_values_of_a_pulse_are_published(bridge: Bridge) -> None:
    with connected(bridge.url, TWIST) as source:
        assert source.write(vx=1.0, wz=0.5) == ["", ""]
        register = source.layout.registers[source.layout.by_path["vx"]]
        pulse = [encode(register, value, source.layout.byte_order)[0] for value in (2.0, 0.0)]
        assert write(source.connector, pulse) == ["", ""]
        assert [one["linear"]["x"] for one in bridge.ask("history", "/cmd_vel")] == [1.0, 2.0, 0.0]


def test_a_large_or_a_binary_message_ends_the_connection(bridge: Bridge) -> None:
    with connected(bridge.url, JOINTS, max_message_bytes=1000) as source:
        bridge.ask("raw", " " * 4001)
        with pytest.raises(ConnectorError, match="lost"):
            source.until(lambda: False)
    with connected(bridge.url, JOINTS) as source:
        bridge.ask("binary", "a0")
        with pytest.raises(ConnectorError, match="binary"):
            source.until(lambda: False)


def test_a_message_is_published_with_all_its_fields(bridge: Bridge) -> None:
    with connected(bridge.url, TWIST) as source:
        assert "/cmd_vel yet" in source.write(vx=1.0)[0]
        assert bridge.ask("last", "/cmd_vel") is None
        assert source.write(vx=1.0, wz=0.5) == ["", ""]
        zero = {"x": 0.0, "y": 0.0, "z": 0.0}
        assert bridge.ask("last", "/cmd_vel") == {"linear": zero | {"x": 1.0}, "angular": zero | {"z": 0.5}}
        other = {"linear": zero | {"y": 3.0}, "angular": zero}
        bridge.ask("publish", "/cmd_vel", other)
        source.until(lambda: source.value("vx") == 0.0)
        assert source.write(wz=2.0) == [""]
        assert bridge.ask("last", "/cmd_vel") == other | {"angular": zero | {"z": 2.0}}
        source.read()
        assert (source.value("wz"), source.code("wz")) == (2.0, 0)
        assert "NaN" in source.write(wz=math.nan)[0]
        assert bridge.ask("last", "/cmd_vel")["angular"]["z"] == 2.0


def test_a_joint_command_names_its_joints(bridge: Bridge) -> None:
    tags = {
        name: {"type": "LREAL", "address": f"/command sensor_msgs/JointState {field}[name={name}]", "writable": True}
        for name, field in (("a", "position"), ("b", "position"))
    }
    with connected(bridge.url, tags) as source:
        assert source.write(a=1.0, b=2.0) == ["", ""]
        sent = bridge.ask("last", "/command")
        assert (sent["name"], sent["position"], sent["velocity"]) == (["a", "b"], [1.0, 2.0], [])
        assert sent["header"]["stamp"]["sec"]  # of the server
        bridge.ask("publish", "/command", joint_state(["b", "a"], [5.0, 6.0]))
        source.until(lambda: source.value("a") == 6.0)
        assert source.write(b=7.0) == [""]
        assert bridge.ask("last", "/command")["position"] == [7.0, 6.0]
        bridge.ask("publish", "/command", joint_state(["a"], [5.0]))
        source.until(lambda: source.code("b") == statuses.BAD_NOT_FOUND)
        assert "does not contain 'b'" in source.write(b=7.0)[0]
    gap = {"v": {"type": "LREAL", "address": "/other sensor_msgs/JointState velocity[1]", "writable": True}}
    with connected(bridge.url, gap) as source:
        assert "without a value" in source.write(v=1.0)[0]


def test_what_the_server_refuses_or_does_not_send_back(bridge: Bridge) -> None:
    with connected(bridge.url, TWIST, timeout=300) as source:
        bridge.ask("refuse", "/cmd_vel", "not in this state")
        assert source.write(vx=1.0, wz=0.5) == ["the server refuses the message: not in this state"] * 2
        bridge.ask("refuse", "/cmd_vel", "")
        bridge.freeze()
        try:
            with pytest.raises(WriteLostError, match="no answer") as raised:
                source.write(vx=1.0, wz=0.5)
        finally:
            bridge.thaw()
        assert raised.value.outcomes == (Lost.UNKNOWN, Lost.UNKNOWN)


@pytest.mark.parametrize(
    ("tag", "options", "words"),
    [
        (("LREAL", ""), {}, "`address` is missing"),
        (("LREAL", "/a std_msgs/Bool data"), {}, "does not fit"),
        (("DINT", "/a std_msgs/Float64 data"), {}, "scale"),
        (("LREAL", f"{STATES}position"), {}, "does not fit"),
        (("LREAL", f"{STATES}header.stamp"), {}, "name one of its fields"),
        (("LREAL", f"{STATES}position[label=j1]"), {}, "no sequence of names"),
        ({"type": "LREAL", "address": "/a my_msgs/Thing x", "writable": True}, {}, "be written"),
        (("DATE", "/a std_msgs/Int16 data"), {}, "DATE"),
        (("LREAL", f"{STATES}position[0]"), {"latched": ["/mode"]}, "latched"),
    ],
)
def test_what_is_wrong_is_said_before_anything_starts(tag: Any, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        RosbridgeConnector(RosbridgeOptions(url="ws://robot", **options), layout_of({"r": tag}))


@pytest.mark.parametrize(
    "url", ["http://robot", "ws://", "ws://user@robot", "ws://robot:0", "ws://robot:x", "wss://robot"]
)
def test_a_wrong_url(url: str) -> None:
    with pytest.raises(ValueError, match="url: expected"):
        RosbridgeOptions(url=url)


def test_a_reload_keeps_last_messages_and_changes_what_is_subscribed_and_advertised(bridge: Bridge) -> None:
    bridge.ask("publish", "/mode", {"data": "auto"})
    mode: dict[str, Any] = {"type": "STRING[20]", "address": "/mode std_msgs/String data"}
    with connected(bridge.url, {"mode": mode | {"writable": True}, **JOINTS}, max_age=0) as source:
        bridge.ask("publish", "/joint_states", joint_state(["j1", "j2"], [1.5, 2.5], sec=1_700_000_000))
        source.until(lambda: source.code("j2") == 0)
        source.reload({"j2": JOINTS["j2"], "mode": mode, **TWIST})
        source.read()
        assert (source.value("j2"), source.value("mode")) == (2.5, "auto")
        assert source.source_ns("j2") == 1_700_000_000_000_000_007
        assert source.code("vx") == statuses.BAD_WAITING_FOR_INITIAL_DATA
        assert source.write(vx=0.5, wz=0.25) == ["", ""]
        assert sorted(bridge.ask("subscribed")) == ["/cmd_vel", "/joint_states", "/mode"]
        assert bridge.ask("advertised") == ["/cmd_vel"]
        source.reload({"mode": mode | {"writable": True}}, throttle_ms=1)
        assert source.write(mode="hand") == [""]
        source.read()
        assert source.value("mode") == "hand"
        assert (bridge.ask("subscribed"), bridge.ask("advertised")) == (["/mode"], ["/mode"])
        assert bridge.ask("clients") == 1
