"""The HTTP endpoint over a real socket: the test publishes into a segment, and clients request figures."""

from __future__ import annotations

import asyncio
import http.client
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from prometheus_client.parser import text_string_to_metric_families

from shmio.config import Address
from shmio.config.credentials import Secret
from shmio.endpoints.web.app import metrics_app
from shmio.endpoints.web.measurements import Measurements
from shmio.endpoints.web.server import HttpServer
from shmio.endpoints.web.sessions import Sessions
from shmio.segment import Attributes, BlockSpec, BlockWriter, ProcessSpec, Quality, Segment
from tests.unit.endpoints.harness import LAYOUT, STALE_NS, WRITABLE

TIMEOUT_S = 30


def spec(source: str = "cell", *, stepped: bool = False) -> BlockSpec:
    return BlockSpec(source, LAYOUT, 20_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE, stepped=stepped))


def processes() -> list[ProcessSpec]:
    names = [("cell", "source"), ("grpc", "grpc"), ("broker", "mqtt"), ("mqtt", "mqtt"), ("metrics", "web")]
    return [ProcessSpec(*name) for name in names]


class Served:
    """An endpoint that serves a segment. The server runs in a thread."""

    def __init__(self, segment: Segment, measurements: Measurements, server: HttpServer) -> None:
        self.segment, self.measurements, self.server = segment, measurements, server
        self.cycle = 0

    @cached_property
    def writer(self) -> BlockWriter:
        return self.segment.writer("cell")

    def publish(self, raw: bytes, quality: Quality = Quality.GOOD, **more: Any) -> None:
        self.cycle += 1
        self.writer.publish(raw, cycle=self.cycle, quality=quality, **more)

    def get(
        self, path: str = "/metrics", headers: Mapping[str, str] | None = None, method: str = "GET"
    ) -> tuple[int, Mapping[str, str], str]:
        """Send a request; return status, headers and text of the answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=TIMEOUT_S)
        try:
            connection.request(method, path, headers=dict(headers or {}))
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read().decode()
        finally:
            connection.close()

    def figures(self) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
        """Return all figures by name and labels, parsed by Prometheus' own library."""
        status, _, text = self.get()
        assert status == 200
        return {
            (sample.name, frozenset(sample.labels.items())): sample.value
            for family in text_string_to_metric_families(text)
            for sample in family.samples
        }

    def figure(self, name: str, **labels: str) -> float | None:
        return self.figures().get((name, frozenset(labels.items())))


@contextmanager
def served(
    segment: Segment,
    registers: Sequence[str] = (),
    folders: Mapping[str, str] | None = None,
    hosts: Sequence[str] = (),
    secrets: Sequence[Secret] = (),
) -> Iterator[Served]:
    """Serve a segment on a free port."""
    measurements = Measurements(segment)
    sessions = Sessions(secrets, () if secrets else ("read",))
    app = metrics_app(segment, measurements, folders or {}, registers, sessions)
    server = HttpServer(app, Address("127.0.0.1", 0), hosts=tuple(hosts))
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        asyncio.run_coroutine_threadsafe(server.start(), loop).result(TIMEOUT_S)
        yield Served(segment, measurements, server)
    finally:
        asyncio.run_coroutine_threadsafe(server.stop(), loop).result(TIMEOUT_S)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()
