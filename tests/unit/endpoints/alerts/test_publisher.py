"""Notices at a real broker: they wait while it is away, and each arrives."""

from __future__ import annotations

import json
import os
import selectors
import socket
import threading
from pathlib import Path
from typing import Any

import pytest

from shmio.config import Alert, Mqtt
from shmio.endpoints.alerts.publisher import Publisher, queued
from shmio.endpoints.alerts.sender import MAX_WAITING
from shmio.segment import Segment
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port
from tests.unit.endpoints.alerts.harness import notice
from tests.unit.endpoints.mqtt.harness import listening

ALERT = Alert(name="hot", when="x", mqtt_topic="plant/hot", mqtt_retain=True)
TIMEOUT_S = 30


class Running:
    """A publisher, and the loop that runs it."""

    def __init__(self, segment: Segment, settings: Mqtt) -> None:
        self.selector = selectors.DefaultSelector()
        self._wakeup = os.eventfd(0, os.EFD_NONBLOCK)
        self.selector.register(self._wakeup, selectors.EVENT_READ, lambda _: os.eventfd_read(self._wakeup))
        self.publisher = Publisher(settings, segment, self.selector, lambda: os.eventfd_write(self._wakeup, 1))

    def until(self, condition: Any) -> None:
        while not condition():
            rest_s = self.publisher.run_once()
            for key, events in self.selector.select(min(rest_s, 0.1)):
                key.data(events)

    def close(self) -> None:
        self.publisher.close()
        self.selector.close()
        os.close(self._wakeup)


def accept(listener: socket.socket) -> socket.socket:
    """Accept a client of MQTT 5."""
    client, _ = listener.accept()
    client.settimeout(TIMEOUT_S)
    assert client.recv(65536)[0] == 0x10
    client.sendall(b"\x20\x03\0\0\0")
    return client


def published(client: socket.socket) -> bytes:
    """Return the identifier of the next PUBLISH with QoS 1."""
    packet = client.recv(65536)
    assert packet[0] & 0xF6 == 0x32
    at = packet.index(b"plant/hot") + len(b"plant/hot")
    return packet[at : at + 2]


def test_a_notice_waits_until_the_broker_acknowledges_it(segment: Segment) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        one = Running(segment, Mqtt(broker="external", host=f"127.0.0.1:{listener.getsockname()[1]}"))
        got, seen = threading.Event(), threading.Event()

        def serve() -> None:
            with accept(listener) as first:
                published(first)
                got.set()
                assert seen.wait(TIMEOUT_S)
            with accept(listener) as second:
                second.sendall(b"\x40\x02" + published(second))
                assert second.recv(65536)[:1] in (b"", b"\xe0"), "it disconnects"

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            one.publisher.put(ALERT, notice())
            one.until(got.is_set)
            one.publisher.run_once()
            waiting = one.publisher.waiting_count
            seen.set()
            one.until(lambda: not one.publisher.waiting_count)
        finally:
            one.close()
            thread.join(TIMEOUT_S)
        assert waiting == 1
        assert one.publisher.failed == 0


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_notices_wait_for_the_broker(segment: Segment, tmp_path: Path) -> None:
    with reserved_port() as address:
        broker = Mosquitto(tmp_path, address)
        one = Running(segment, Mqtt(broker="external", host=str(address)))
        try:
            for number in range(MAX_WAITING + 5):
                one.publisher.put(ALERT, notice(number=number))
            one.until(lambda: one.publisher.problem)
            assert (one.publisher.waiting_count, one.publisher.failed) == (MAX_WAITING, 5)
            broker.start()
            one.until(lambda: not one.publisher.waiting_count)
            assert one.publisher.problem == ""
            with listening(address, "plant/#") as late:
                message = late.message()
                assert message.retain
                assert json.loads(message.payload)["id"] == notice(number=MAX_WAITING + 4).id
                queued(one.publisher, [ALERT], [notice(number=7), notice("removed")])
                one.until(lambda: not one.publisher.waiting_count)
                assert json.loads(late.message().payload)["id"] == notice(number=7).id
                late.taken()
                assert len(late.heard) == 2
        finally:
            one.close()
            broker.stop()
