"""A ROS 2 node as a program, made with cyclonedds, with types written from the public definitions rather than ours.

Usage: dds_node.py DOMAIN PREFIX. Each line of its standard input is a command, a JSON list. It answers each.
"""

import json
import sys
import threading
from dataclasses import dataclass
from types import new_class
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, float64, int8, int16, int32, int64, sequence, uint8, uint16, uint32, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

CONFIG = """<CycloneDDS><Domain Id="{}"><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex><LeaseDuration>{}s</LeaseDuration>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""


@dataclass
class Time_(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):  # noqa: N801
    sec: int32
    nanosec: uint32


@dataclass
class Header_(IdlStruct, typename="std_msgs::msg::dds_::Header_"):  # noqa: N801
    stamp: Time_
    frame_id: str


@dataclass
class JointState_(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):  # noqa: N801
    header: Header_
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class MultiArrayDimension_(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):  # noqa: N801
    label: str
    size: uint32
    stride: uint32


@dataclass
class MultiArrayLayout_(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):  # noqa: N801
    dim: sequence[MultiArrayDimension_]
    data_offset: uint32


@dataclass
class Float64MultiArray_(IdlStruct, typename="std_msgs::msg::dds_::Float64MultiArray_"):  # noqa: N801
    layout: MultiArrayLayout_
    data: sequence[float64]


@dataclass
class Int16MultiArray_(IdlStruct, typename="std_msgs::msg::dds_::Int16MultiArray_"):  # noqa: N801
    layout: MultiArrayLayout_
    data: sequence[int16]


@dataclass
class String_(IdlStruct, typename="std_msgs::msg::dds_::String_"):  # noqa: N801
    data: str


def std_type(name: str, data: Any) -> Any:
    """Return the type ``std_msgs/name``, whose values are in its field ``data``."""
    layout = {"layout": MultiArrayLayout_} if name.endswith("MultiArray") else {}
    body = {"__annotations__": {**layout, "data": data}, "__module__": __name__}
    return dataclass(
        new_class(
            f"{name}_", (IdlStruct,), {"typename": f"std_msgs::msg::dds_::{name}_"}, lambda made: made.update(body)
        )
    )


NUMBERS = {
    "Float32": float32, "Float64": float64, "Int8": int8, "Int16": int16, "Int32": int32, "Int64": int64,
    "UInt8": uint8, "UInt16": uint16, "UInt32": uint32, "UInt64": uint64,
}  # fmt: skip
STD_TYPES = {
    "Bool": std_type("Bool", bool),
    "String": String_,
    **{name: std_type(name, number) for name, number in NUMBERS.items()},
    **{f"{name}MultiArray": std_type(f"{name}MultiArray", sequence[number]) for name, number in NUMBERS.items()},
}
RELIABLE = Policy.Reliability.Reliable(10**9)


def qos_of(policies: dict[str, Any]) -> Qos:
    ms = 1_000_000
    return Qos(
        RELIABLE if policies.get("reliability", "reliable") == "reliable" else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if policies.get("stored") else Policy.Durability.Volatile,
        Policy.History.KeepLast(policies.get("depth", 1)),
        *([Policy.Deadline(policies["deadline"] * ms)] if "deadline" in policies else []),
        *([Policy.Liveliness.ManualByTopic(policies["lease"] * ms)] if "lease" in policies else []),
    )


class Node:
    """A node: the topics that it publishes, and the messages that it has received."""

    def __init__(self, domain: str, prefix: str) -> None:
        self.domain, self.prefix = int(domain), prefix
        self.last = 0
        self.counting: threading.Thread | None = None
        self.stopped = threading.Event()
        self.entities: list[Any] = []
        self.opened: dict[str, tuple[Any, Any]] = {}  # reader and writer, by topic
        self.join()

    def topic(self, name: str, kind: Any) -> Any:
        return Topic(self.entities[1], f"rt/{self.prefix}/{name}", kind)

    def join(self, lease_s: int = 10) -> None:
        self.entities = [Domain(self.domain, CONFIG.format(self.domain, lease_s))]
        self.entities.append(DomainParticipant(self.domain))
        last, durable = Policy.History.KeepLast(1), Policy.Durability.TransientLocal
        self.states = DataWriter(self.entities[1], self.topic("states", JointState_), qos=Qos(RELIABLE, last))
        self.counts = DataWriter(self.entities[1], self.topic("counted", Float64MultiArray_), qos=Qos(RELIABLE, last))
        spare = self.topic("spare", Int16MultiArray_)
        self.spares = DataWriter(self.entities[1], spare, qos=Qos(RELIABLE, last))
        self.received = DataReader(self.entities[1], spare, qos=Qos(RELIABLE, last, Policy.IgnoreLocal.Participant))
        self.modes = DataWriter(self.entities[1], self.topic("mode", String_), qos=Qos(RELIABLE, last, durable))

    def leave(self) -> None:
        if self.counting is not None:
            self.stopped.set()
            self.counting.join()
            self.counting = None
        self.opened.clear()
        del self.states, self.counts, self.spares, self.received, self.modes
        for entity in reversed(self.entities):
            entity.__del__()
        self.entities = []

    def participants(self) -> list[str]:
        """Return the keys of the participants in the domain."""
        reader = BuiltinDataReader(self.entities[1], BuiltinTopicDcpsParticipant)
        return sorted(str(one.key) for one in reader.take(100))

    def state(self, names: list[str], positions: list[float], sec: int = 0) -> None:
        self.states.write(JointState_(Header_(Time_(sec, 7), ""), names, [float(one) for one in positions], [], []))

    def mode(self, text: str) -> None:
        self.modes.write(String_(text))

    def spare(self, data: list[int]) -> None:
        self.spares.write(Int16MultiArray_(MultiArrayLayout_([], 0), data))

    def commanded(self) -> Any:
        found = self.received.take(1)
        return list(found[-1].data) if found else None

    def open(self, kinds: dict[str, str]) -> None:
        """Subscribe to topics, and publish on them. Their types are those of ``std_msgs``."""
        for name, kind in kinds.items():
            topic = self.topic(name, STD_TYPES[kind])
            qos = Qos(RELIABLE, Policy.History.KeepLast(1), Policy.IgnoreLocal.Participant)
            self.opened[name] = (DataReader(self.entities[1], topic, qos=qos), DataWriter(self.entities[1], topic, qos))

    def offer(self, name: str, kind: str, policies: dict[str, Any]) -> None:
        """Publish on a topic with this QoS."""
        self.opened[name] = (None, DataWriter(self.entities[1], self.topic(name, STD_TYPES[kind]), qos_of(policies)))

    def request(self, name: str, kind: str, policies: dict[str, Any], prefix: str = "") -> None:
        """Subscribe to a topic of this node, or of the one with another prefix, with this QoS."""
        topic = Topic(self.entities[1], f"rt/{prefix or self.prefix}/{name}", STD_TYPES[kind])
        reader = DataReader(self.entities[1], topic, qos=qos_of(policies))
        self.opened[name] = (reader, None)

    def opened_names(self) -> list[str]:
        return list(self.opened)

    def withdraw(self, name: str) -> None:
        """Delete what was opened on a topic."""
        for one in self.opened.pop(name):
            if one is not None:
                one.__del__()

    def received_all(self, name: str) -> Any:
        """Return the data of the messages that have arrived on an opened topic since the last call."""
        return [one.data for one in self.opened[name][0].take(100)]

    def received_data(self, name: str) -> Any:
        """Return the data of the newest message that has arrived on an opened topic since the last call."""
        found = self.opened[name][0].take(1)
        return found[-1].data if found else None

    def send_data(self, name: str, data: Any) -> None:
        """Publish data on an opened topic."""
        made = self.opened[name][1].topic.data_type
        self.opened[name][1].write(made(MultiArrayLayout_([], 0), data) if isinstance(data, list) else made(data))

    def repeat(self, commands: list[list[Any]]) -> None:
        """Carry out commands again and again, each 20 ms."""

        def run() -> None:
            while not self.stopped.wait(0.02):
                for name, *given in commands:
                    getattr(self, name)(*given)

        self.stopped.clear()
        self.counting = threading.Thread(target=run)
        self.counting.start()

    def restore(self, number: int) -> None:
        self.last = number

    def count(self, size: int, period_s: float) -> None:
        def run() -> None:
            while not self.stopped.wait(period_s):
                self.last += 1
                self.counts.write(Float64MultiArray_(MultiArrayLayout_([], 0), [float(self.last)] * size))

        if self.counting is not None:
            return
        self.stopped.clear()
        self.counting = threading.Thread(target=run)
        self.counting.start()


def main() -> None:
    node = Node(*sys.argv[1:])
    print('"ready"', flush=True)  # noqa: T201
    for line in sys.stdin:
        name, *given = json.loads(line)
        print(json.dumps(getattr(node, name)(*given)), flush=True)  # noqa: T201
    node.leave()


if __name__ == "__main__":
    main()
