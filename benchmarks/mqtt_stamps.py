"""Subscribes to a topic whose values are time stamps. Keeps each value with the time of its arrival, in ns."""

from __future__ import annotations

import sys
import threading
import time

from common import tell, wait_for_parent
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

from shmio.config import Address


def main() -> None:
    address, topic = Address.parse(sys.argv[1]), sys.argv[2]
    stamps: list[tuple[int, int]] = []
    first = threading.Event()

    def heard(_client: Client, _data: object, message: MQTTMessage) -> None:
        if message.payload:
            stamps.append((int(message.payload), time.monotonic_ns()))
            first.set()

    client = Client(CallbackAPIVersion.VERSION2)
    client.on_message = heard
    client.connect(address.host, address.port)
    client.subscribe(topic, 0)
    client.loop_start()
    if not first.wait(20):
        raise SystemExit(f"no value of {topic} within 20 s")
    tell("ready")
    wait_for_parent()
    client.loop_stop()
    tell(stamps)


if __name__ == "__main__":
    main()
