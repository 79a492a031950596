"""A robot, as a program: it publishes the joints of each of its arms when it reads a number from its standard input.

Usage: ros_peer.py bridge ARMS, a rosbridge server; or ros_peer.py dds ARMS DOMAIN, a node of ROS 2. All positions are
the number.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable
from typing import Any

from common import tell

JOINTS = [f"joint_{n}" for n in range(6)]
KIND = "sensor_msgs/JointState"


def message(number: float) -> dict[str, Any]:
    """Return the joints of an arm."""
    header = {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": ""}
    return {"header": header, "name": JOINTS, "position": [number] * 6, "velocity": [0.0] * 6, "effort": [0.0] * 6}


def serve(publish: Callable[[float], None]) -> None:
    """Publish each number that comes."""
    for line in sys.stdin:
        publish(float(line))
        tell(True)


def bridge(arms: int) -> None:
    """Run a rosbridge server, which sends all topics to all clients."""
    from websockets.sync import server as websockets  # noqa: PLC0415

    clients: set[websockets.ServerConnection] = set()

    def handle(client: websockets.ServerConnection) -> None:
        for asked, _ in enumerate(client, 1):
            if asked == arms:  # the last subscription
                clients.add(client)
        clients.discard(client)

    def publish(number: float) -> None:
        for arm in range(arms):
            text = json.dumps({"op": "publish", "topic": f"/arm{arm}", "msg": message(number)})
            for client in [*clients]:
                client.send(text)

    with websockets.serve(handle, "127.0.0.1", 0, compression=None) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        tell(server.socket.getsockname()[1])
        serve(publish)
        server.shutdown()


def dds(arms: int, domain: int) -> None:
    """Run a node that publishes by DDS."""
    from cyclonedds.domain import Domain, DomainParticipant  # noqa: PLC0415
    from cyclonedds.pub import DataWriter  # noqa: PLC0415
    from cyclonedds.qos import Policy, Qos  # noqa: PLC0415
    from cyclonedds.topic import Topic  # noqa: PLC0415
    from cyclonedds.util import duration  # noqa: PLC0415

    from shmio.connectors.ros import participant  # noqa: PLC0415
    from shmio.connectors.ros.dds_types import sample_type, to_sample  # noqa: PLC0415

    _domain = Domain(domain, participant.configuration(domain, "lo", [], 1 << 20))
    member = DomainParticipant(domain)
    qos = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(1))
    writers = [DataWriter(member, Topic(member, f"rt/arm{arm}", sample_type(KIND)), qos=qos) for arm in range(arms)]

    def publish(number: float) -> None:
        sample = to_sample(message(number), KIND)
        for writer in writers:
            writer.write(sample)

    tell(True)
    serve(publish)


if __name__ == "__main__":
    if sys.argv[1] == "bridge":
        bridge(int(sys.argv[2]))
    else:
        dds(int(sys.argv[2]), int(sys.argv[3]))
