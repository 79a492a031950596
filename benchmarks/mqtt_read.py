"""MQTT as a source: values a second and CPU of the connector ``mqtt``, beside a bare paho client at the same broker.

A device in a process of its own publishes a number on all topics at once, again as soon as the client has the last of
them. The clients take turns in this process, and both use MQTT 5. paho's client makes a float of each payload. The
connector also puts each value with its status and time into an image, which it makes 100 times a second.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from common import Child, begin, interleave, table
from paho.mqtt.client import Client, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion

from shmio.config import Address
from shmio.connectors.mqtt.connector import MqttConnector
from shmio.connectors.mqtt.options import MqttOptions
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port

OURS, BARE = "shmio", "paho"
PERIOD_S = 0.01
Wait = Callable[[float], None]
"""Wait until the client has a number from the last topic."""


def connector(stack: ExitStack, address: Address, topics: int) -> Wait:
    """Connect the connector."""
    layout = place_tags("bench", {f"v{n}": {"type": "REAL", "address": f"plant/{n}"} for n in range(topics)})
    layout = layout.with_statuses()
    made = MqttConnector(MqttOptions(url=f"mqtt://{address}", version="5", qos=0, max_age_ms=0), layout)
    made.connect()
    stack.callback(made.close)
    last = codec(layout.registers[-1], layout.byte_order)

    def wait(number: float) -> None:
        while last.decode(made.read()) != number:
            time.sleep(PERIOD_S)

    return wait


def library(stack: ExitStack, address: Address, topics: int) -> Wait:
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

    def wait(number: float) -> None:
        while values.get(last) != number:
            time.sleep(PERIOD_S)

    return wait


def sampler(
    client: str, device: Child, address: Address, topics: int, duration_s: float, costs: list[float]
) -> Callable[[], float]:
    """Make a function that returns a client's values a second, and adds its CPU time for each, in us, to a list."""

    def sample() -> float:
        with ExitStack() as stack:
            wait = (connector if client == OURS else library)(stack, address, topics)
            device.ask(0)
            wait(0)
            cycles, used_s, begun_s = 0, time.process_time(), time.perf_counter()
            while (taken_s := time.perf_counter() - begun_s) < duration_s:
                cycles += 1
                device.ask(cycles)
                wait(cycles)
            costs.append(1e6 * (time.process_time() - used_s) / (cycles * topics))
        return cycles * topics / taken_s

    return sample


def compare(topics: int, rounds: int, round_s: float) -> None:
    """Print the table for so many topics."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        address = stack.enter_context(reserved_port())
        broker = Mosquitto(folder, address)
        broker.start()
        stack.callback(broker.stop)
        device = stack.enter_context(Child("mqtt_peer.py", address.port, topics))
        used: dict[str, list[float]] = {OURS: [], BARE: []}
        samplers = {name: sampler(name, device, address, topics, round_s, used[name]) for name in used}
        rates = {name: statistics.median(found) for name, found in interleave(samplers, rounds).items()}
    costs = {name: statistics.median(found) for name, found in used.items()}
    ratios = [f"{rates[OURS] / rates[BARE]:.2f}", f"{costs[OURS] / costs[BARE]:.2f}"]
    rows = [
        [name, f"{rates[name]:.0f}", f"{costs[name]:.2f}", *(["", ""] if name == OURS else ratios)] for name in rates
    ]
    table([f"{topics} topics", "values/s", "µs of CPU a value", "shmio's rate to it", "shmio's CPU to it"], rows)


def main() -> None:
    quick = begin("MQTT as a source: values a second of the connector and of paho's client")
    if reason := missing():
        print(reason)
        return
    for topics in (100,) if quick else (1000, 5000):
        compare(topics, *((1, 0.3) if quick else (5, 2.0)))


if __name__ == "__main__":
    main()
