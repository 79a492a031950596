"""A device at an MQTT broker, as a program: it publishes each line of its standard input on all topics.

Usage: mqtt_peer.py PORT TOPICS
"""

from __future__ import annotations

import sys

from common import tell
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion


def main() -> None:
    client = Client(CallbackAPIVersion.VERSION2, "device")
    client.connect("127.0.0.1", int(sys.argv[1]))
    client.loop_start()
    tell(True)
    for line in sys.stdin:
        for topic in range(int(sys.argv[2])):
            client.publish(f"plant/{topic}", line.strip())
        tell(True)
    client.loop_stop()


if __name__ == "__main__":
    main()
