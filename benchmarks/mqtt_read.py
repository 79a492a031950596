"""MQTT as a source: values a second and CPU of the connector ``mqtt``, beside a bare paho client at the same broker.

A device in a process of its own publishes a number on all topics at once, again as soon as the client has the last of
them. The clients take turns in this process, and both use MQTT 5. paho's client makes a float of each payload. The
connector also puts each value with its status and time into an image, which it makes 100 times a second.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from common import Child, Connect, begin, compare_clients, follow
from paho.mqtt.client import Client, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion

from shmio.config import Address
from shmio.connectors.mqtt.connector import MqttConnector
from shmio.connectors.mqtt.options import MqttOptions
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port

PERIOD_S = 0.01
Newest = Callable[[], object]
"""Returns the newest number from the last topic."""


def connector(stack: ExitStack, address: Address, topics: int) -> Newest:
    """Connect the connector."""
    layout = place_tags("bench", {f"v{n}": {"type": "REAL", "address": f"plant/{n}"} for n in range(topics)})
    layout = layout.with_statuses()
    made = MqttConnector(MqttOptions(url=f"mqtt://{address}", version="5", qos=0, max_age_ms=0), layout)
    made.connect()
    stack.callback(made.close)
    last = codec(layout.registers[-1], layout.byte_order)

    return lambda: last.decode(made.read())


def library(stack: ExitStack, address: Address, topics: int) -> Newest:
    """Connect paho's client."""
    values: dict[str, float] = {}
    last = f"plant/{topics - 1}"

    def take(_client: Client, _data: Any, message: Any) -> None:
        values[message.topic] = float(message.payload)

    client = Client(CallbackAPIVersion.VERSION2, "bare", protocol=MQTTv5)
    client.on_message = take
    client.connect(address.host, address.port)
    for n in range(topics):
        client.subscribe(f"plant/{n}")
    client.loop_start()
    stack.callback(client.loop_stop)

    return lambda: values.get(last)


def compare(topics: int, rounds: int, round_s: float) -> None:
    """Print the table for so many topics."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        address = stack.enter_context(reserved_port())
        broker = Mosquitto(folder, address)
        broker.start()
        stack.callback(broker.stop)
        device = stack.enter_context(Child("mqtt_peer.py", address.port, topics))
        clients: dict[str, Connect] = {
            "shmio": lambda stack: follow(device, connector(stack, address, topics), PERIOD_S),
            "paho": lambda stack: follow(device, library(stack, address, topics), PERIOD_S),
        }
        compare_clients(f"{topics} topics", clients, topics, rounds, round_s)


def main() -> None:
    quick = begin("MQTT as a source: values a second of the connector and of paho's client")
    if reason := missing():
        print(reason)
        return
    for topics in (100,) if quick else (1000, 5000):
        compare(topics, *((1, 0.3) if quick else (5, 2.0)))


if __name__ == "__main__":
    main()
