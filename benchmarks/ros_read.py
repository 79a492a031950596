"""ROS: values a second and CPU of the connectors ``rosbridge`` and ``ros2``, beside bare libraries at the same robot.

A robot in a process of its own publishes the six joints of all its arms at once, again as soon as the client has the
last of them. The clients take turns in this process. The bare clients, websockets with json and cyclonedds, make a
dict of each message's positions. The connectors put each position with its status and time into an image, which they
make at most 1000 times a second.
"""

from __future__ import annotations

import importlib.util
import json
import os
import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from common import Child, Connect, begin, compare_clients, follow
from ros_peer import JOINTS, KIND

from shmio.connectors.base import Connector
from shmio.connectors.ros.dds import Ros2Connector, Ros2Options
from shmio.connectors.ros.rosbridge import RosbridgeConnector, RosbridgeOptions
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec

PERIOD_S = 0.001
DOMAIN = 100 + os.getpid() % 100
Newest = Callable[[], object]
"""Returns the newest number from the last arm."""
Make = Callable[[ExitStack, Any, int], Newest]
"""Connects a client to the robot at an address, with so many arms."""


def layout_of(arms: int) -> Layout:
    """Return a register for each joint."""
    tags = {
        f"arm{arm}/{joint}": {"type": "LREAL", "address": f"/arm{arm} {KIND} position[name={joint}]"}
        for arm in range(arms)
        for joint in JOINTS
    }
    return place_tags("bench", tags).with_statuses()


def connected(stack: ExitStack, connector: Connector, layout: Layout) -> Newest:
    """Connect a connector."""
    connector.connect()
    stack.callback(connector.close)
    last = codec(layout.registers[-1], layout.byte_order)
    return lambda: last.decode(connector.read())


def bridge_connector(stack: ExitStack, port: Any, arms: int) -> Newest:
    """Connect the connector ``rosbridge``."""
    layout = layout_of(arms)
    return connected(
        stack, RosbridgeConnector(RosbridgeOptions(url=f"ws://127.0.0.1:{port}", max_age=0), layout), layout
    )


def bridge_library(stack: ExitStack, port: Any, arms: int) -> Newest:
    """Connect a client of websockets."""
    from websockets.sync.client import connect  # noqa: PLC0415

    values: dict[str, dict[str, float]] = {}
    client = stack.enter_context(connect(f"ws://127.0.0.1:{port}", compression=None))
    for arm in range(arms):
        client.send(json.dumps({"op": "subscribe", "topic": f"/arm{arm}", "type": KIND}))

    def receive() -> None:
        for text in client:
            found = json.loads(text)
            values[found["topic"]] = dict(zip(found["msg"]["name"], found["msg"]["position"], strict=True))

    thread = threading.Thread(target=receive, daemon=True)
    thread.start()
    return lambda: values.get(f"/arm{arms - 1}", {}).get(JOINTS[-1])


def dds_connector(stack: ExitStack, _: Any, arms: int) -> Newest:
    """Connect the connector ``ros2``."""
    layout = layout_of(arms)
    return connected(stack, Ros2Connector(Ros2Options(domain=DOMAIN, max_age=0), layout), layout)


def dds_library(stack: ExitStack, _: Any, arms: int) -> Newest:
    """Create readers of cyclonedds."""
    from cyclonedds.core import Listener  # noqa: PLC0415
    from cyclonedds.domain import Domain, DomainParticipant  # noqa: PLC0415
    from cyclonedds.idl import make_idl_struct  # noqa: PLC0415
    from cyclonedds.idl.types import float64, int32, sequence, uint32  # noqa: PLC0415
    from cyclonedds.qos import Policy, Qos  # noqa: PLC0415
    from cyclonedds.sub import DataReader  # noqa: PLC0415
    from cyclonedds.topic import Topic  # noqa: PLC0415

    from shmio.connectors.ros import participant  # noqa: PLC0415
    from shmio.connectors.ros.dds_types import dds_type  # noqa: PLC0415

    def struct(ros_type: str, **fields: Any) -> Any:
        return make_idl_struct(ros_type.partition("/")[2], dds_type(ros_type), fields)

    time = struct("builtin_interfaces/Time", sec=int32, nanosec=uint32)
    header = struct("std_msgs/Header", stamp=time, frame_id=str)
    numbers = sequence[float64]
    kind = struct(KIND, header=header, name=sequence[str], position=numbers, velocity=numbers, effort=numbers)
    values: dict[str, dict[str, float]] = {}

    class Taking(Listener):  # type: ignore[misc]  # the library has no types
        def on_data_available(self, reader: Any) -> None:
            for sample in reader.take(10):
                values[reader.topic.name] = dict(zip(sample.name, sample.position, strict=True))

    kept = [Domain(DOMAIN, participant.configuration(DOMAIN, "lo", [], 1 << 20))]
    member = DomainParticipant(DOMAIN)
    qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1))
    kept += [DataReader(member, Topic(member, f"rt/arm{arm}", kind), qos=qos, listener=Taking()) for arm in range(arms)]
    stack.callback(kept.clear)
    return lambda: values.get(f"rt/arm{arms - 1}", {}).get(JOINTS[-1])


def compare(title: str, makes: dict[str, Make], robot: Child, arms: int, rounds: int, round_s: float) -> None:
    """Print the table of a connector, which is the first client, and the bare library."""

    def client(make: Make) -> Connect:
        return lambda stack: follow(robot, make(stack, robot.hello, arms), PERIOD_S)

    clients = {name: client(make) for name, make in makes.items()}
    compare_clients(title, clients, arms * len(JOINTS), rounds, round_s)


def main() -> None:
    quick = begin("ROS: values a second of the connectors rosbridge and ros2, and of bare libraries")
    arms, rounds, round_s = (10, 1, 0.3) if quick else (100, 5, 2.0)
    with Child("ros_peer.py", "bridge", arms) as robot:
        clients: dict[str, Make] = {"rosbridge": bridge_connector, "websockets, json": bridge_library}
        compare(f"{arms} topics of 6 joints", clients, robot, arms, rounds, round_s)
    if importlib.util.find_spec("cyclonedds") is None:
        print("ros2 needs cyclonedds")
        return
    with Child("ros_peer.py", "dds", arms, DOMAIN) as robot:
        clients = {"ros2": dds_connector, "cyclonedds": dds_library}
        compare(f"{arms} topics of 6 joints", clients, robot, arms, rounds, round_s)


if __name__ == "__main__":
    main()
