"""Follow registers by MQTT, or write one, with an ordinary MQTT client.

examples/mqtt.py 127.0.0.1:1883 shmio/a50 cell/Robot_800/Axs1_Pos
examples/mqtt.py 127.0.0.1:1883 shmio/a50 --write cell/Outputs/13=1
"""

from __future__ import annotations

import argparse
import queue
import sys

from paho.mqtt.client import Client, ConnectFlags, MQTTMessage, topic_matches_sub
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode


def main() -> int:
    """Print the messages about the registers. Return 1, after a line with the reason, if they do not arrive."""
    parser = argparse.ArgumentParser()
    parser.add_argument("broker", metavar="HOST:PORT")
    parser.add_argument("prefix")
    parser.add_argument("paths", nargs="*", metavar="PATH")
    parser.add_argument("--write", metavar="PATH=VALUE")
    parser.add_argument("--count", type=int, default=0, help="end after this number of messages")
    parser.add_argument(
        "--timeout",
        type=float,
        default=10,
        metavar="S",
        help="with --count or --write: wait at most this long (default: 10)",
    )
    arguments = parser.parse_intermixed_args()
    host, _, port = arguments.broker.rpartition(":")
    if not host or not port.isdecimal():
        parser.error(f"{arguments.broker!r} is not HOST:PORT")
    prefix, (path, _, value) = arguments.prefix, (arguments.write or "").partition("=")
    topics = [f"{prefix}/{path}/out" for path in arguments.paths] + ([f"{prefix}/{path}/in/result"] if path else [])
    if not topics:
        parser.error("name a PATH, or --write PATH=VALUE")
    over: queue.SimpleQueue[str] = queue.SimpleQueue()  # the reason for the end; empty if all messages have arrived
    seen = 0

    def heard(_client: Client, _data: object, message: MQTTMessage) -> None:
        nonlocal seen
        if 0 < arguments.count <= seen:  # it arrived before we had disconnected
            return
        if not any(topic_matches_sub(topic, message.topic) for topic in topics):  # aMQTT sends more than was asked for
            return
        print(message.topic.removeprefix(f"{prefix}/"), message.payload.decode() or "no good value", flush=True)
        seen += 1
        if message.topic.endswith("/in/result") or seen == arguments.count:
            over.put("")

    def subscribe(client: Client, _data: object, _flags: ConnectFlags, code: ReasonCode, _: Properties | None) -> None:
        if code.is_failure:
            over.put(f"{arguments.broker}: the broker refuses this client: {code}")
        else:
            client.subscribe([(topic, 1) for topic in topics])

    def write(client: Client, *_: object) -> None:
        if path:
            client.publish(f"{prefix}/{path}/in", value, qos=1)

    def lost(*_: object) -> None:
        over.put(f"{arguments.broker}: the broker has closed the connection; shmio-supervisor status shows its state")

    client = Client(CallbackAPIVersion.VERSION2, reconnect_on_failure=False)
    client.on_message = heard
    client.on_connect = subscribe
    client.on_subscribe = write
    client.on_disconnect = lost
    try:
        client.connect(host, int(port))
        client.loop_start()
        why = over.get(timeout=arguments.timeout if path or arguments.count else None)
    except OSError as error:
        why = f"{arguments.broker}: {error.strerror or error}; shmio-supervisor status says whether the broker runs"
    except queue.Empty:
        told = ", ".join(topics)
        why = f"received {seen} messages in {arguments.timeout:g} s on {told}; shmio list names the registers"
    client.disconnect()
    client.loop_stop()
    if why:
        print(why, file=sys.stderr)
    return 1 if why else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
