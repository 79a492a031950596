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
import statistics
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from common import Child, begin, interleave, table
from ros_peer import JOINTS, KIND

from shmio.connectors.base import Connector
from shmio.connectors.ros.dds import Ros2Connector, Ros2Options
from shmio.connectors.ros.rosbridge import RosbridgeConnector, RosbridgeOptions
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec

PERIOD_S, PATIENCE_S = 0.001, 20.0
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
    from cyclonedds.qos import Policy, Qos  # noqa: PLC0415
    from cyclonedds.sub import DataReader  # noqa: PLC0415
    from cyclonedds.topic import Topic  # noqa: PLC0415

    from shmio.connectors.ros import participant  # noqa: PLC0415
    from shmio.connectors.ros.dds_types import sample_type  # noqa: PLC0415

    values: dict[str, dict[str, float]] = {}

    class Taking(Listener):  # type: ignore[misc]  # the library has no types
        def on_data_available(self, reader: Any) -> None:
            for sample in reader.take(10):
                values[reader.topic.name] = dict(zip(sample.name, sample.position, strict=True))

    kept = [Domain(DOMAIN, participant.configuration(DOMAIN, "lo", [], 1 << 20))]
    member = DomainParticipant(DOMAIN)
    qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1))
    kept += [
        DataReader(member, Topic(member, f"rt/arm{arm}", sample_type(KIND)), qos=qos, listener=Taking())
        for arm in range(arms)
    ]
    stack.callback(kept.clear)
    return lambda: values.get(f"rt/arm{arms - 1}", {}).get(JOINTS[-1])


def reaches(newest: Newest, number: float, patience_s: float) -> bool:
    """Wait until the client has a number; return False if it does not come."""
    end_s = time.monotonic() + patience_s
    while newest() != number:
        if time.monotonic() > end_s:
            return False
        time.sleep(PERIOD_S)
    return True


def sampler(client: Make, robot: Child, arms: int, duration_s: float, costs: list[float]) -> Callable[[], float]:
    """Make a function that returns a client's values a second, and adds its CPU time for each, in us, to a list."""

    def sample() -> float:
        with ExitStack() as stack:
            newest = client(stack, robot.hello, arms)
            end_s = time.monotonic() + PATIENCE_S
            robot.ask(-1)
            while not reaches(newest, -1, 0.5):  # until the robot has found the client
                if time.monotonic() > end_s:
                    raise SystemExit("the client does not get the robot's messages")
                robot.ask(-1)
            cycles, used_s, begun_s = 0, time.process_time(), time.perf_counter()
            while (taken_s := time.perf_counter() - begun_s) < duration_s:
                cycles += 1
                robot.ask(cycles)
                if not reaches(newest, cycles, PATIENCE_S):
                    raise SystemExit("a message of the robot is lost")
            values = cycles * arms * len(JOINTS)
            costs.append(1e6 * (time.process_time() - used_s) / values)
        return values / taken_s

    return sample


def compare(title: str, clients: dict[str, Make], robot: Child, arms: int,
            rounds: int, round_s: float) -> None:  # fmt: skip
    """Print the table of a connector, which is the first client, and the bare library."""
    used: dict[str, list[float]] = {name: [] for name in clients}
    samplers = {name: sampler(client, robot, arms, round_s, used[name]) for name, client in clients.items()}
    rates = {name: statistics.median(found) for name, found in interleave(samplers, rounds).items()}
    costs = {name: statistics.median(found) for name, found in used.items()}
    ours = next(iter(clients))
    rows = [
        [name, f"{rates[name]:.0f}", f"{costs[name]:.2f}"]
        + (["", ""] if name == ours else [f"{rates[ours] / rates[name]:.2f}", f"{costs[ours] / costs[name]:.2f}"])
        for name in clients
    ]
    table([title, "values/s", "µs of CPU a value", "shmio's rate to it", "shmio's CPU to it"], rows)


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
