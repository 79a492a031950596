"""The broker limits how many messages it has not acknowledged (MQTT 5.0, section 4.9)."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator

from shmio.config import Address
from shmio.segment import Segment
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.mqtt.harness import PREFIX, bridge

CONNACK = bytes.fromhex("20 06 00 00 03 21 00 01")  # Receive Maximum 1
CONNECT, PUBLISH, SUBSCRIBE, PINGREQ = 1, 3, 8, 12


def take(data: bytearray) -> Iterator[tuple[int, bytes]]:
    """Remove the complete packets from received data, and yield the first byte and the rest of each."""
    while True:
        length, at, more = 0, 1, True
        while more and at < len(data):
            length |= (data[at] & 0x7F) << 7 * (at - 1)
            more = bool(data[at] & 0x80)
            at += 1
        if more or at + length > len(data):
            return
        packet = data[0], bytes(data[at : at + length])
        del data[: at + length]
        yield packet


class Strict:
    """A broker that takes one message at a time. It acknowledges all that it has received together."""

    def __init__(self) -> None:
        self.topics: list[str] = []
        self.most = 0
        """Largest number of messages that a client had sent before the broker acknowledged one."""
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = Address("127.0.0.1", self._server.getsockname()[1])
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def _accept(self) -> None:
        while True:
            client, _ = self._server.accept()
            first = client.recv(1 << 16)
            if not first:
                client.close()
                return
            self._threads.append(threading.Thread(target=self._serve, args=[client, bytearray(first)]))
            self._threads[-1].start()

    def _serve(self, client: socket.socket, data: bytearray) -> None:
        with client:
            while True:
                answers, published = b"", 0
                for first, body in take(data):
                    kind = first >> 4
                    if kind == CONNECT:
                        answers += CONNACK
                    elif kind == SUBSCRIBE:
                        answers += b"\x90\x04" + body[:2] + b"\0\1"
                    elif kind == PINGREQ:
                        answers += b"\xd0\0"
                    elif kind == PUBLISH:
                        end = 2 + int.from_bytes(body[:2])
                        self.topics.append(body[2:end].decode().removeprefix(f"{PREFIX}/"))
                        if first & 0x02:
                            published += 1
                            answers += b"\x40\x02" + body[end : end + 2]
                self.most = max(self.most, published)
                client.sendall(answers)
                more = client.recv(1 << 16)
                if not more:
                    return
                data += more

    def close(self) -> None:
        with socket.create_connection((self.address.host, self.address.port)):
            pass
        for thread in self._threads:
            thread.join()
        self._server.close()


def test_no_more_messages_than_the_broker_takes_even_at_the_end(segment: Segment) -> None:
    segment.writer("cell").publish(image(step=1), cycle=1)
    broker = Strict()
    try:
        with bridge(segment, broker.address) as running:
            running.until(lambda: running.bridge.connection.connects and not running.bridge.outbox.busy)
        assert "cell/step/out" in broker.topics
        assert broker.topics[-2:] == ["cell/status", "status"]
        assert broker.most == 1
    finally:
        broker.close()
