"""The broker that shmio starts, run in a thread, and a client that sends raw packets."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from shmio.config import Address, Mqtt
from shmio.endpoints.mqtt.__main__ import run_broker
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from shmio.testing.ports import reserved_port
from tests.unit.endpoints.harness import LAYOUT, STALE_NS, WRITABLE, image
from tests.unit.endpoints.mqtt.harness import PREFIX, TIMEOUT_S, Running


@pytest.fixture
def segment(instance: str, tmp_path: Path) -> Iterator[Segment]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE))
    processes = [ProcessSpec("cell", "source"), ProcessSpec("broker", "mqtt"), ProcessSpec("mqtt", "mqtt")]
    with Segment.create(instance, [block], processes, control=str(tmp_path / "a.sock")) as segment:
        segment.writer("cell").publish(image(step=7), cycle=1)
        yield segment
        segment.unlink()


@pytest.fixture
def address() -> Iterator[Address]:
    with reserved_port() as address:
        yield address


class Process:
    """The parts of the broker's process that the broker uses."""

    def __init__(self, segment: Segment, **config: Any) -> None:
        self.stopping, self.ready = threading.Event(), threading.Event()
        self.failure: Exception | None = None
        self.notes: list[str] = []
        self._stops: list[Callable[[], object]] = []
        self._worker: Any = SimpleNamespace(
            name="broker",
            config=config,
            segment=segment,
            log=logging.getLogger("test"),
            stopping=self.stopping,
            on_stop=self._stops.append,
            running=self.ready.set,
            report=self._report,
        )
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _report(self, note: str | None = None) -> None:
        if note is not None:
            self.notes.append(note)

    def _run(self) -> None:
        try:
            run_broker(self._worker)
        except Exception as error:  # noqa: BLE001  the test handles every exception
            self.failure = error
        finally:
            self.ready.set()

    def stop(self) -> None:
        self.stopping.set()
        for stop in self._stops:
            stop()
        self._thread.join(TIMEOUT_S)
        assert not self._thread.is_alive()


@contextmanager
def serving(segment: Segment, address: Address, program: str = "embedded", **config: Any) -> Iterator[Process]:
    """Serve a broker. By default, clients without an account may do everything."""
    config.setdefault("prefix", PREFIX)
    config.setdefault("account", [{"roles": ["read", "write"], "publish": ["#"]}])
    process = Process(segment, broker=program, listen=str(address), **config)
    try:
        assert process.ready.wait(TIMEOUT_S)
        if process.failure is not None:
            raise process.failure
        yield process
    finally:
        process.stop()


@contextmanager
def bridged(segment: Segment) -> Iterator[Running]:
    """Run a bridge to the broker of this instance."""
    running = Running(segment, Mqtt(listen="127.0.0.1:1", prefix=PREFIX))
    try:
        running.until(lambda: running.bridge.connection.up)
        yield running
    finally:
        running.stop()


class Raw:
    """A client of MQTT 3.1.1 that can send any packet."""

    def __init__(
        self,
        address: Address,
        name: str,
        *,
        clean: bool = True,
        account: tuple[str, ...] = (),
        will: tuple[str, str] | None = None,
    ) -> None:
        """Connect. ``will``: topic and payload of a retained last will."""
        self._socket = socket.create_connection((address.host, address.port), TIMEOUT_S)
        self._numbers = 0
        flags = 2 * clean | (0xC0 if account else 0) | (0x24 if will else 0)
        fields = (name, *(will or ()), *account)
        self.send(0x10, b"\0\4MQTT\4" + bytes([flags]) + b"\0\0" + b"".join(map(_text, fields)))
        kind, told = self.packet()
        assert kind == 0x20
        self.before, self.code = bool(told[0]), told[1]
        """From CONNACK: whether a session existed, and the return code; 0: accepted."""

    def __enter__(self) -> Raw:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send(self, kind: int, body: bytes) -> None:
        length, rest = bytearray(), len(body)
        while rest > 127:
            length.append(rest & 0x7F | 0x80)
            rest >>= 7
        self._socket.sendall(bytes([kind, *length, rest]) + body)

    def packet(self) -> tuple[int, bytes]:
        """Return the next packet; ConnectionError if the connection has ended."""
        (kind,) = self._exactly(1)
        size, place = 0, 0
        while True:
            (byte,) = self._exactly(1)
            size |= (byte & 0x7F) << place
            place += 7
            if byte < 0x80:
                return kind, self._exactly(size)

    def _exactly(self, size: int) -> bytes:
        read = b""
        while len(read) < size:
            part = self._socket.recv(size - len(read))
            if not part:
                raise ConnectionResetError
            read += part
        return read

    def ended(self) -> bool:
        """Wait until the broker closes the connection; TimeoutError if it does not."""
        with suppress(ConnectionError):
            while True:
                self.packet()
        return True

    def number(self) -> bytes:
        self._numbers += 1
        return self._numbers.to_bytes(2, "big")

    def publish(self, topic: str, payload: bytes, *, qos: int = 0, retain: bool = False) -> None:
        self.send(0x30 | qos << 1 | retain, _text(topic) + (self.number() if qos else b"") + payload)

    def subscribe(self, *filters: str) -> bytes:
        """Subscribe; return the broker's code for each filter: 0, or 0x80 for a refusal."""
        self.send(0x82, self.number() + b"".join(_text(one) + b"\1" for one in filters))
        while True:
            kind, told = self.packet()
            if kind == 0x90:
                return told[2:]

    def unsubscribe(self, *filters: str) -> None:
        self.send(0xA2, self.number() + b"".join(map(_text, filters)))
        while self.packet()[0] != 0xB0:
            pass

    def ping(self) -> None:
        """Wait until the broker has read all packets."""
        self.send(0xC0, b"")
        while self.packet()[0] != 0xD0:
            pass


def _text(text: str) -> bytes:
    return len(text).to_bytes(2, "big") + text.encode()
