"""Follow registers by MQTT, and write one: any client of MQTT does it so.

examples/mqtt.py 127.0.0.1:1883 shmio/a50 cell/Robot_800/Axs1_Pos
examples/mqtt.py 127.0.0.1:1883 shmio/a50 --write cell/Outputs/13=1
"""

from __future__ import annotations

import argparse
import sys
import threading

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

TIMEOUT_S = 10


def main() -> int:
    """Follow, or write and follow what becomes of it; 1: nothing came in time."""
    parser = argparse.ArgumentParser()
    parser.add_argument("broker", metavar="HOST:PORT")
    parser.add_argument("prefix")
    parser.add_argument("paths", nargs="*", metavar="PATH")
    parser.add_argument("--write", metavar="PATH=VALUE")
    parser.add_argument("--count", type=int, default=0, help="end after so many messages")
    arguments = parser.parse_intermixed_args()
    host, _, port = arguments.broker.rpartition(":")
    prefix, (path, _, value) = arguments.prefix, (arguments.write or "").partition("=")
    topics = [f"{prefix}/{path}/out" for path in arguments.paths] + ([f"{prefix}/{path}/in/result"] if path else [])
    done, seen = threading.Event(), 0

    def heard(_client: Client, _data: object, message: MQTTMessage) -> None:
        nonlocal seen
        print(message.topic.removeprefix(f"{prefix}/"), message.payload.decode() or "no good value")
        seen += 1
        if message.topic.endswith("/in/result") or seen == arguments.count:
            done.set()

    def subscribe(client: Client, *_: object) -> None:
        client.subscribe([(topic, 1) for topic in topics])

    def write(client: Client, *_: object) -> None:
        if path:
            client.publish(f"{prefix}/{path}/in", value, qos=1)

    client = Client(CallbackAPIVersion.VERSION2)
    client.on_message = heard
    client.on_connect = subscribe
    client.on_subscribe = write
    client.connect(host, int(port))
    client.loop_start()
    ended = done.wait(TIMEOUT_S if path or arguments.count else None)
    client.disconnect()
    client.loop_stop()
    return 0 if ended else 1


if __name__ == "__main__":
    sys.exit(main())
