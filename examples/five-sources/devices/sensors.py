"""A device with an MQTT client: it publishes its sensors, and switches its lamp on command.

Usage: sensors.py [HOST:PORT]
"""

from __future__ import annotations

import json
import math
import sys
import time

from paho.mqtt.client import Client, ConnectFlags, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

PERIOD_S = 0.05
STATE, SET, STATUS = "hall/sensors/state", "hall/sensors/set", "hall/sensors/status"


class Sensors:
    """The device: its lamp, and its connection to the broker."""

    def __init__(self) -> None:
        self.lamp = False
        self.client = Client(CallbackAPIVersion.VERSION2, client_id="hall-sensors")
        self.client.will_set(STATUS, "offline", qos=1, retain=True)
        self.client.reconnect_delay_set(1, 1)
        self.client.on_connect = self._connected
        self.client.on_message = self._commanded

    def run(self, host: str, port: int) -> None:
        """Publish until the process ends; connect again whenever the broker was away."""
        self.client.connect_async(host, port, keepalive=5)
        self.client.loop_start()
        while True:
            now_s = time.time()
            state = {
                "temperature": round(21.0 + 2.0 * math.sin(now_s / 3), 3),
                "humidity": round(45.0 + 5.0 * math.cos(now_s / 5), 3),
                "gate": int(now_s) % 4 < 2,
                "lamp": self.lamp,
            }
            if self.client.is_connected():  # otherwise paho would keep old states for later
                self.client.publish(STATE, json.dumps(state))
            time.sleep(PERIOD_S)

    def _connected(
        self, client: Client, _data: object, _flags: ConnectFlags, code: ReasonCode, _properties: Properties | None
    ) -> None:
        if not code.is_failure:
            client.subscribe(SET, qos=1)
            client.publish(STATUS, "online", qos=1, retain=True)

    def _commanded(self, _client: Client, _data: object, message: MQTTMessage) -> None:
        command = json.loads(message.payload)
        self.lamp = bool(command["lamp"])


if __name__ == "__main__":
    host, _, port = (sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:11883").rpartition(":")
    Sensors().run(host, int(port))
