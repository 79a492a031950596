"""A connector with a tag table, for tests of its images and writes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from shmio.connectors.base import Connector
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import encode
from shmio.model.statuses import StatusArea
from shmio.testing.write_conformance import write

PATIENCE_S = 20.0
_NEVER = threading.Event()


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
