"""A connector to a server, and what its images say."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from shmio.connectors.opcua.connector import OpcUaConnector
from shmio.connectors.opcua.options import OpcUaOptions
from shmio.layout.tags import place_tags
from shmio.layout.topic import find
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import encode
from shmio.model.statuses import RegisterStatus, StatusArea
from shmio.testing.conformance import connect
from shmio.testing.write_conformance import write

PATIENCE_S = 20.0
_NEVER = threading.Event()


def until(condition: Callable[[], bool], what: str) -> None:
    """Wait until a condition holds."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, f"not seen in time: {what}"
        _NEVER.wait(0.002)


class Source:
    """A connector with a tag table; its address is ``ns=2;s=PATH`` unless a tag has one."""

    def __init__(self, url: str, tags: Mapping[str, Any], **options: Any) -> None:
        keys = {"timeout": 1000, "publishing_ms": 10, "sampling_ms": 5} | options
        self._options = OpcUaOptions(url=url, **keys)
        self._make(tags)

    def _make(self, tags: Mapping[str, Any]) -> None:
        given = {
            path: {"address": f"ns=2;s={path}", **(tag if isinstance(tag, dict) else {"type": tag})}
            for path, tag in tags.items()
        }
        self.layout = place_tags("device", given).with_statuses()
        self._area = StatusArea(self.layout)
        self.connector = OpcUaConnector(self._options, self.layout)

    def reload(self, tags: Mapping[str, Any]) -> None:
        """Let a connector with other tags take over the connection."""
        before = self.connector
        self._make(tags)
        try:
            assert self.connector.take_over(before)
        finally:
            before.close()

    def value(self, path: str, image: bytes | None = None) -> Value:
        register = self.layout.registers[self.layout.by_path[path]]
        return codec(register, self.layout.byte_order).decode(self.connector.read() if image is None else image)

    def status(self, path: str, image: bytes | None = None) -> RegisterStatus:
        return self._area.get(self.connector.read() if image is None else image, self.layout.by_path[path])

    def write_all(self, values: Mapping[str, Value]) -> list[str]:
        """Write several registers in one command; return the outcome of each."""
        writes = []
        for path, value in values.items():
            register = self.layout.registers[self.layout.by_path[path]]
            writes += encode(register, value, self.layout.byte_order)
        return write(self.connector, writes)

    def write(self, path: str, value: Value) -> str:
        register = find(self.layout, path)
        outcomes = write(self.connector, encode(register, value, self.layout.byte_order))
        return "; ".join(outcomes)


@contextmanager
def connected(url: str, tags: Mapping[str, Any], **options: Any) -> Iterator[Source]:
    source = Source(url, tags, **options)
    try:
        connect(source.connector)
        yield source
    finally:
        source.connector.close()
