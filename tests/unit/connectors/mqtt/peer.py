"""A device made with Node's mqtt, a broker made with Node's aedes, and a source that reads them."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import pytest

from shmio.config import Address
from shmio.connectors.base import Connector
from shmio.connectors.mqtt.connector import MqttConnector
from shmio.connectors.mqtt.options import MqttOptions
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import encode
from shmio.model.statuses import StatusArea
from shmio.testing.write_conformance import write

NODE = Path(__file__).parents[2] / "endpoints/node"
MISSING = "" if shutil.which("node") and (NODE / "node_modules/aedes").exists() else "needs Node's aedes and mqtt"
PATIENCE_S = 20.0
_NEVER = threading.Event()


class Peer:
    """The Node process with the device and the broker. ``ask`` runs its commands."""

    def __enter__(self) -> Self:
        if MISSING:
            pytest.skip(MISSING)
        self._process = subprocess.Popen(
            ["node", str(NODE / "mqtt_peer.js")],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        assert self._line() == "ready"
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate(timeout=PATIENCE_S)

    def _line(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def ask(self, *words: object) -> Any:
        """Send a command; return its result."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(words) + "\n")
        self._process.stdin.flush()
        found = self._line()
        assert not (isinstance(found, dict) and "error" in found), found
        return found

    def publish(self, topic: str, payload: object, *, retain: bool = False) -> None:
        """Publish a text, or another value as JSON. Return when the broker has acknowledged it."""
        text = payload if isinstance(payload, str) else json.dumps(payload)
        self.ask("publish", topic, text, {"qos": 1, "retain": retain})

    def clear(self, *topics: str) -> None:
        """Remove the retained messages of topics from the broker."""
        for topic in topics:
            self.ask("publish", topic, "", {"qos": 1, "retain": True})


def layout_of(tags: Mapping[str, tuple[str, str] | dict[str, Any]]) -> Layout:
    """Return a layout. Each tag is (type, address), or a dict with the keys of a tag table."""
    given = {path: {"type": tag[0], "address": tag[1]} if isinstance(tag, tuple) else tag for path, tag in tags.items()}
    return place_tags("robot", given).with_statuses()


class Source:
    """A connector, and the values and statuses of its last image."""

    def __init__(self, connector: Connector, layout: Layout) -> None:
        self.connector, self.layout = connector, layout
        self._area = StatusArea(layout)
        self.image = b""

    def reload(self, tags: Mapping[str, tuple[str, str] | dict[str, Any]], **options: Any) -> None:
        """Let a connector with other tags, and with some other options, take over the connection."""
        before, self.layout = self.connector, layout_of(tags)
        given = msgspec.structs.asdict(before._options) | options  # type: ignore[attr-defined]
        self.connector = type(before)(msgspec.convert(given, before.Options), self.layout)
        self._area = StatusArea(self.layout)
        try:
            assert self.connector.take_over(before)
        finally:
            before.close()

    def read(self) -> None:
        self.image = self.connector.read()

    def value(self, path: str) -> Value:
        register = self.layout.registers[self.layout.by_path[path]]
        return codec(register, self.layout.byte_order).decode(self.image)

    def code(self, path: str) -> int:
        return self._area.get(self.image, self.layout.by_path[path]).code

    def source_ns(self, path: str) -> int:
        return self._area.get(self.image, self.layout.by_path[path]).source_ns

    def until(self, condition: Callable[[], bool]) -> None:
        """Read images until one satisfies a condition."""
        end_s = time.monotonic() + PATIENCE_S
        while True:
            self.read()
            if condition():
                return
            assert time.monotonic() < end_s, "not seen in time"
            _NEVER.wait(0.002)

    def write(self, **values: Value) -> list[str]:
        """Write registers in one command; return the outcome of each."""
        writes = []
        for path, value in values.items():
            writes += encode(self.layout.registers[self.layout.by_path[path]], value, self.layout.byte_order)
        return write(self.connector, writes)


@contextmanager
def connected(
    address: Address, tags: Mapping[str, tuple[str, str] | dict[str, Any]], **options: Any
) -> Iterator[Source]:
    layout = layout_of(tags)
    given: dict[str, Any] = {"url": f"mqtt://{address}", "timeout": 2000, "max_age_ms": 0} | options
    source = Source(MqttConnector(msgspec.convert(given, MqttOptions), layout), layout)
    try:
        source.connector.connect()
        yield source
    finally:
        source.connector.close()


def framing(data: bytes | bytearray) -> int:
    """Return the length of the MQTT packet at the start of ``data``; 0 if the packet's length is not complete."""
    size = 0
    for place, byte in enumerate(data[1:5]):
        size |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return 2 + place + size
    return 0
