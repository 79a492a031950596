"""Subscribes to a register that holds a time stamp. Prints ``ready``, then the age in ms of each message."""

from __future__ import annotations

import sys
import time

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

from shmio.config import Address


def main() -> None:
    address, count = Address.parse(sys.argv[1]), int(sys.argv[2])
    ages_ms: list[float] = []

    def heard(_client: Client, _data: object, message: MQTTMessage) -> None:
        now_ns = time.monotonic_ns()
        if message.payload and not message.retain:
            ages_ms.append((now_ns - int(message.payload)) / 1e6)

    def ready(*_: object) -> None:
        print("ready", flush=True)

    client = Client(CallbackAPIVersion.VERSION2)
    client.on_message = heard
    client.on_subscribe = ready
    client.connect(address.host, address.port)
    client.subscribe("bench/cell/Stamp/out", 0)
    while len(ages_ms) < count:
        client.loop(1.0)
    client.disconnect()
    print(*ages_ms, sep="\n")


if __name__ == "__main__":
    main()
