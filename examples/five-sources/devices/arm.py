"""A node of ROS 2, made with cyclonedds alone: it publishes the joints of an arm, at a speed that a topic sets.

Usage: arm.py [DOMAIN]

The message types are those of common_interfaces and builtin_interfaces. The node sends and receives on this host only.
"""

import math
import sys
import time
from dataclasses import dataclass

from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

PERIOD_S = 0.01
CONFIG = """<CycloneDDS><Domain Id="{}"><General>
<Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""


@dataclass
class Time_(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):  # noqa: N801  the names that ROS 2 gives
    """A time since 1970."""

    sec: int32
    nanosec: uint32


@dataclass
class Header_(IdlStruct, typename="std_msgs::msg::dds_::Header_"):  # noqa: N801
    """When and in which frame a message was measured."""

    stamp: Time_
    frame_id: str


@dataclass
class JointState_(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):  # noqa: N801
    """The state of joints: ``rad``, ``rad/s``, ``Nm``."""

    header: Header_
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Float64_(IdlStruct, typename="std_msgs::msg::dds_::Float64_"):  # noqa: N801
    """A number."""

    data: float64


def main(domain: int) -> None:
    """Publish the joints until the process ends."""
    _configured = Domain(domain, CONFIG.format(domain))  # it must live as long as the node
    node = DomainParticipant(domain)
    joints = DataWriter(node, Topic(node, "rt/arm/joint_states", JointState_))
    overrides = DataReader(node, Topic(node, "rt/arm/override", Float64_))
    override, phase = 1.0, 0.0
    while True:
        for message in overrides.take(10):
            if isinstance(message, Float64_):  # a node that ends leaves a mark that is no message
                override = message.data
        phase += PERIOD_S * override
        now_ns = time.time_ns()
        header = Header_(Time_(*divmod(now_ns, 10**9)), "base")
        position = [math.sin(phase), 0.5 * math.cos(phase)]
        joints.write(JointState_(header, ["joint_1", "joint_2"], position, [], []))
        time.sleep(PERIOD_S)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 42)
