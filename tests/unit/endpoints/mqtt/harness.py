"""A bridge in a thread, and a client that subscribes to everything at its broker."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from paho.mqtt.client import Client, MQTTMessage, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from shmio.config import Address, Mqtt
from shmio.endpoints.mqtt.bridge import Bridge
from shmio.segment import Segment

TIMEOUT_S = 30
PREFIX = "shmio/test"


class Listener:
    """A client that receives everything, in order."""

    def __init__(
        self, address: Address, *filters: str, protocol: MQTTProtocolVersion = MQTTv5, qos: int = 1, **account: Any
    ) -> None:
        self.heard: list[tuple[str, bytes]] = []
        self._come: queue.SimpleQueue[MQTTMessage] = queue.SimpleQueue()
        subscribed = threading.Event()
        self.client = Client(CallbackAPIVersion.VERSION2, protocol=protocol, reconnect_on_failure=False)
        if account:
            self.client.username_pw_set(account["username"], account["password"])
        self.client.on_connect = self._subscribe
        self._filters = [(one, qos) for one in filters or ("#",)]
        self.client.on_subscribe = lambda *_: subscribed.set()
        self.client.on_message = lambda _client, _data, message: self._come.put(message)
        self.client.connect(address.host, address.port)
        self.client.loop_start()
        assert subscribed.wait(TIMEOUT_S)

    def _subscribe(self, client: Client, *_: Any) -> None:
        client.subscribe(self._filters)

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()
        del self.client  # only its deletion closes the socket pair of its thread; a failed test keeps the listener

    def message(self) -> MQTTMessage:
        message = self._come.get(timeout=TIMEOUT_S)
        self.heard.append((message.topic, bytes(message.payload)))
        return message

    def taken(self) -> None:
        """Take the messages that have arrived, without waiting."""
        while not self._come.empty():
            self.message()

    def until(self, topic: str, payload: bytes | None = None) -> bytes:
        """Return the next payload on this topic, equal to ``payload`` if it is given."""
        while True:
            message = self.message()
            if message.topic == f"{PREFIX}/{topic}" and payload in (None, message.payload):
                return bytes(message.payload)

    def json(self, topic: str) -> dict[str, Any]:
        """Return the next payload on this topic, decoded from JSON."""
        found: dict[str, Any] = json.loads(self.until(topic))
        return found

    def values(self, topic: str) -> list[str]:
        """Return all payloads received on this topic so far."""
        return [payload.decode() for heard, payload in self.heard if heard == f"{PREFIX}/{topic}"]

    def shown(self, topic: str, value: str) -> None:
        """Wait until the last payload on this topic equals ``value``."""
        while self.values(topic)[-1:] != [value]:
            self.message()

    def publish(self, topic: str, payload: bytes | str, *, retain: bool = False, **named: Any) -> None:
        """Publish, and wait until the broker has the message."""
        properties = None
        if named:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            for name, value in named.items():
                setattr(properties, name, value)
        self.client.publish(f"{PREFIX}/{topic}", payload, 1, retain, properties).wait_for_publish(TIMEOUT_S)


@contextmanager
def listening(address: Address, *filters: str, **how: Any) -> Iterator[Listener]:
    listener = Listener(address, *filters, **how)
    try:
        yield listener
    finally:
        listener.close()


class Running:
    """A bridge in its own thread."""

    def __init__(self, segment: Segment, settings: Mqtt) -> None:
        slot = segment.processes.find("mqtt")
        assert slot.take()
        self.bridge = Bridge(segment, slot, settings)
        self._stopping = False
        self._turned = threading.Condition()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopping:
            self.bridge.run_once()
            with self._turned:
                self._turned.notify_all()
        self.bridge.close()

    def until(self, condition: Any) -> None:
        """Wait until the bridge or its peer has made a condition true."""
        with self._turned:
            assert self._turned.wait_for(condition, TIMEOUT_S), self.bridge.problem

    def stop(self) -> None:
        self._stopping = True
        self.bridge.wake()
        self._thread.join(TIMEOUT_S)
        assert not self._thread.is_alive()


@contextmanager
def bridge(segment: Segment, address: Address | list[Address], **settings: Any) -> Iterator[Running]:
    addresses = address if isinstance(address, list) else [address]
    running = Running(segment, Mqtt(broker="external", host=[str(one) for one in addresses], prefix=PREFIX, **settings))
    try:
        yield running
    finally:
        running.stop()
