"""``shmio-supervisor browse`` of ROS topics: as a tree, and as a tag table that a source reads from the same peer."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shmio.cli import supervisor
from shmio.connectors.base import Connector
from shmio.connectors.ros.dds import Ros2Connector, Ros2Options
from shmio.connectors.ros.qos import TopicQos
from shmio.connectors.ros.rosbridge import RosbridgeConnector, RosbridgeOptions
from shmio.layout.compiler import Source as SourceFile
from shmio.layout.compiler import compile_sources
from shmio.layout.model import Layout
from shmio.model.statuses import GOOD
from tests.unit.connectors.ros.bridge import Bridge
from tests.unit.connectors.ros.dds_peer import Peer
from tests.unit.connectors.source import Source

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "robot"
connector = "{connector}"
layout = "tags.toml"
{keys}
"""
HEADER = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
DURATION = {"sec": 1, "nanosec": 0}
TRAJECTORY = {
    "header": HEADER,
    "joint_names": ["a.b", "c"],
    "points": [{"positions": [1, 2], "velocities": [], "accelerations": [], "effort": [], "time_from_start": DURATION}],
}  # fmt: skip
BRIDGE_TREE = """\
arm
  states
    name  ARRAY[0..1] OF STRING  /arm/states sensor_msgs/msg/JointState name
    position
      j1  LREAL  /arm/states sensor_msgs/msg/JointState position[name=j1]
      j2  LREAL  /arm/states sensor_msgs/msg/JointState position[name=j2]
    velocity  (it is empty)
    effort  ARRAY[0..2] OF LREAL  /arm/states sensor_msgs/msg/JointState effort
camera  (shmio does not know the type sensor_msgs/msg/Image)
cmd_vel
  linear
    x  LREAL  /cmd_vel geometry_msgs/msg/Twist linear.x  writable
    y  LREAL  /cmd_vel geometry_msgs/msg/Twist linear.y  writable
    z  LREAL  /cmd_vel geometry_msgs/msg/Twist linear.z  writable
  angular
    x  LREAL  /cmd_vel geometry_msgs/msg/Twist angular.x  writable
    y  LREAL  /cmd_vel geometry_msgs/msg/Twist angular.y  writable
    z  LREAL  /cmd_vel geometry_msgs/msg/Twist angular.z  writable
flags  ARRAY[0..1] OF USINT  /flags std_msgs/msg/UInt8MultiArray data
plan
  joint_names  ARRAY[0..1] OF STRING  /plan trajectory_msgs/msg/JointTrajectory joint_names
  points
    0
      positions
        a.b  LREAL  /plan trajectory_msgs/msg/JointTrajectory points[0].positions[joint_names=a.b]
        c  LREAL  /plan trajectory_msgs/msg/JointTrajectory points[0].positions[joint_names=c]
      velocities  (it is empty)
      accelerations  (it is empty)
      effort  (it is empty)
      time_from_start
        sec  DINT  /plan trajectory_msgs/msg/JointTrajectory points[0].time_from_start.sec
        nanosec  UDINT  /plan trajectory_msgs/msg/JointTrajectory points[0].time_from_start.nanosec
silent  (no message has arrived, so its length is unknown)
speed
  data  REAL  /speed std_msgs/msg/Float32 data
  limit  INT  /speed/limit std_msgs/msg/Int16 data
"""


@pytest.fixture(scope="module")
def bridge() -> Iterator[Bridge]:
    with Bridge() as bridge:
        for topic, kind, message in (
            ("/arm/states", "sensor_msgs/JointState",
             {"header": HEADER, "name": ["j1", "j2"], "position": [1.5, 2.5], "velocity": [], "effort": [0, 0, 0]}),
            ("/camera", "sensor_msgs/Image", {"data": "AA=="}),
            ("/flags", "std_msgs/UInt8MultiArray", {"layout": {"dim": [], "data_offset": 0}, "data": [1, 255]}),
            ("/plan", "trajectory_msgs/JointTrajectory", TRAJECTORY),
            ("/speed", "std_msgs/Float32", {"data": 0.5}),
            ("/speed/limit", "std_msgs/Int16", {"data": 7}),
        ):  # fmt: skip
            bridge.ask("declare", topic, kind)
            bridge.ask("publish", topic, message)
        bridge.ask("declare", "/cmd_vel", "geometry_msgs/Twist")
        bridge.ask("declare", "/silent", "std_msgs/Float64MultiArray")
        yield bridge


def browse(url: str, *arguments: object) -> int:
    return supervisor.main(["browse", url, *map(str, arguments), "--set", "timeout=1000"])


def layout_in(table: Path, instance: str, connector: str, keys: str) -> Layout:
    """Return the layout of a tag table that ``check`` accepts for a source."""
    config = table.with_name("supervisor.toml")
    config.write_text(CONFIG.format(instance=instance, connector=connector, keys=keys))
    assert supervisor.main(["check", "-c", str(config)]) == 0
    return compile_sources([SourceFile(str(table), table.read_bytes())]).layouts[0].with_statuses()


def good(connector: Connector, layout: Layout, then: Callable[[Source], None]) -> None:
    """Connect, wait until all registers are good, and let the caller look at their values."""
    source = Source(connector, layout)
    try:
        connector.connect()
        source.until(lambda: all(source.code(register.path) == GOOD for register in layout.registers))
        then(source)
    finally:
        connector.close()


def test_the_topics_of_a_rosbridge_server(bridge: Bridge, capsys: pytest.CaptureFixture[str]) -> None:
    assert browse(bridge.url) == 0
    assert capsys.readouterr().out == BRIDGE_TREE
    assert browse(bridge.url, "arm/states/position/*") == 0
    assert capsys.readouterr().out == "\n".join([*BRIDGE_TREE.splitlines()[:2], *BRIDGE_TREE.splitlines()[3:6], ""])
    assert browse(bridge.url, "--limit", 2) == 1
    assert "raise --limit" in capsys.readouterr().err


def test_the_table_of_a_rosbridge_server_can_be_read(bridge: Bridge, tmp_path: Path, instance: str) -> None:
    table = tmp_path / "tags.toml"
    assert browse(bridge.url, "arm", "flags", "plan", "speed", "-o", table) == 0
    layout = layout_in(table, instance, "rosbridge", f'url = "{bridge.url}"')

    def then(source: Source) -> None:
        assert source.value("arm/states/position/j2") == 2.5
        assert source.value("plan/points/0/positions/a.b") == 1.0
        assert (source.value("flags"), source.value("speed/data"), source.value("speed/limit")) == ([1, 255], 0.5, 7)

    good(RosbridgeConnector(RosbridgeOptions(url=bridge.url, max_age=0), layout), layout, then)


def test_a_server_without_rosapi(bridge: Bridge, capsys: pytest.CaptureFixture[str]) -> None:
    bridge.ask("services", False)
    try:
        assert browse(bridge.url) == 1
    finally:
        bridge.ask("services", True)
    assert "needs the node rosapi" in capsys.readouterr().err


@pytest.fixture
def peer() -> Iterator[Peer]:
    with Peer() as peer:
        peer.ask("offer", "speed", "Float32", {})
        peer.ask("offer", "list", "Int16MultiArray", {"reliability": "best_effort"})
        peer.ask("request", "command", "Bool", {})
        peer.ask("mode", "auto")
        peer.ask(
            "repeat", [["state", ["j1", "j2"], [1.5, 2.5]], ["send_data", "speed", 0.5], ["send_data", "list", [3, 4]]]
        )
        yield peer


def test_the_topics_of_a_domain(peer: Peer, capsys: pytest.CaptureFixture[str], tmp_path: Path, instance: str) -> None:
    url, table = f"ros2://{peer.domain}", tmp_path / "tags.toml"
    assert browse(url, peer.prefix) == 0
    shown = {tuple(line.split()) for line in capsys.readouterr().out.splitlines()}
    own = f"/{peer.prefix}"
    assert shown == {
        (peer.prefix,), ("states",), ("position",),
        ("name", "ARRAY[0..1]", "OF", "STRING", f"{own}/states", "sensor_msgs/JointState", "name"),
        ("j1", "LREAL", f"{own}/states", "sensor_msgs/JointState", "position[name=j1]"),
        ("j2", "LREAL", f"{own}/states", "sensor_msgs/JointState", "position[name=j2]"),
        ("velocity", "(it", "is", "empty)"), ("effort", "(it", "is", "empty)"),
        ("speed", "REAL", f"{own}/speed", "std_msgs/Float32", "data"),
        ("list", "ARRAY[0..1]", "OF", "INT", f"{own}/list", "std_msgs/Int16MultiArray", "data"),
        ("mode", "STRING", f"{own}/mode", "std_msgs/String", "data"),
        ("command", "BOOL", f"{own}/command", "std_msgs/Bool", "data", "writable"),
        ("counted", "(no", "message", "has", "arrived,", "so", "its", "length", "is", "unknown)"),
        ("spare", "(no", "message", "has", "arrived,", "so", "its", "length", "is", "unknown)"),
    }  # fmt: skip
    patterns = [f"{peer.prefix}/{name}" for name in ("states", "speed", "list", "mode")]
    assert browse(url, *patterns, "-o", table) == 0
    keys = f"domain = {peer.domain}\nlatched = [{json.dumps(f'{own}/mode')}]"
    layout = layout_in(table, instance, "ros2", keys)

    def then(source: Source) -> None:
        names = ("states/position/j2", "speed", "list", "mode")
        assert [source.value(f"{peer.prefix}/{name}") for name in names] == [2.5, 0.5, [3, 4], "auto"]

    good(Ros2Connector(Ros2Options(domain=peer.domain, latched=[f"{own}/mode"]), layout), layout, then)


def test_a_topic_that_the_library_refuses_is_listed_among_the_others(
    peer: Peer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node of another vendor publishes on a topic whose name Cyclone DDS does not accept."""
    discovery = pytest.importorskip("shmio.connectors.ros.discovery")
    odd = discovery.Endpoint(
        "rt/odd name", "std_msgs::msg::dds_::Int16MultiArray_", discovery.writer_qos(TopicQos(), 0)
    )  # fmt: skip
    publishers = discovery.Discovery.publishers
    monkeypatch.setattr(discovery.Discovery, "publishers", lambda found: [*publishers(found), odd])
    assert browse(f"ros2://{peer.domain}", "odd name", f"{peer.prefix}/speed") == 0
    shown = capsys.readouterr().out.splitlines()
    assert "odd name  (no message has arrived, so its length is unknown)" in shown
    assert f"  speed  REAL  /{peer.prefix}/speed std_msgs/Float32 data" in shown


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("ros2://robot", "expected ros2://DOMAIN"),
        ("ros2://231", "no topic of ROS was discovered"),
        ("modbus://plc", "write a tag table from the device's manual"),
        ("s7://plc", "export the data block"),
        ("memory://x", "reads no device"),
        ("ftp://plc", "valid: opc.tcp://HOST:PORT, .*ros2://DOMAIN; .*--connector"),
        ("ws://127.0.0.1:1", "refused"),
    ],
)
def test_what_cannot_be_browsed(url: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("cyclonedds")
    arguments = ["browse", url, *(["--set", "timeout=100"] if url[:2] in ("ro", "ws") else [])]
    assert supervisor.main(arguments) == 1
    assert re.search(words, capsys.readouterr().err)
