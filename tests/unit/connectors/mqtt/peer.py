"""A device made with Node's mqtt, a broker made with Node's aedes, and a source that reads them."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import pytest

from shmio.config import Address
from shmio.connectors.mqtt.connector import MqttConnector
from shmio.connectors.mqtt.options import MqttOptions
from tests.unit.connectors.source import PATIENCE_S, Source, layout_of

NODE = Path(__file__).parents[2] / "endpoints/node"
MISSING = "" if shutil.which("node") and (NODE / "node_modules/aedes").exists() else "needs Node's aedes and mqtt"


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
