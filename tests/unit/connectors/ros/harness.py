"""A source that is connected to a rosbridge server."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from shmio.connectors.ros.rosbridge import RosbridgeConnector, RosbridgeOptions
from tests.unit.connectors.source import Source, layout_of


@contextmanager
def connected(url: str, tags: Mapping[str, tuple[str, str] | dict[str, Any]], **options: Any) -> Iterator[Source]:
    layout = layout_of(tags)
    source = Source(RosbridgeConnector(RosbridgeOptions(url=url, **{"timeout": 1000} | options), layout), layout)
    try:
        source.connector.connect()
        yield source
    finally:
        source.connector.close()
