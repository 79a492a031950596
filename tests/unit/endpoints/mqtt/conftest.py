"""A segment, a broker and its listeners."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port
from tests.unit.endpoints.harness import LAYOUT, STALE_NS, WRITABLE


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE))
    processes = [ProcessSpec("cell", "source"), ProcessSpec("mqtt", "mqtt"), ProcessSpec("grpc", "grpc")]
    with Segment.create(instance, [block], processes) as segment:
        yield segment
        segment.unlink()


@pytest.fixture
def make_segment(instance: str) -> Iterator[Callable[[], Segment]]:
    """Return a function that makes further segments, each of another instance."""
    with ExitStack() as stack:

        def make() -> Segment:
            block = BlockSpec("cell", LAYOUT, 20_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE))
            processes = [ProcessSpec("cell", "source"), ProcessSpec("mqtt", "mqtt")]
            made = stack.enter_context(Segment.create(f"{instance}-2", [block], processes))
            stack.callback(made.unlink)
            return made

        yield make


@pytest.fixture
def make_broker(tmp_path: Path) -> Iterator[Callable[..., Mosquitto]]:
    """Return a function that starts a mosquitto for this test."""
    if reason := missing():
        pytest.skip(reason)
    with ExitStack() as stack:

        def make(*lines: str) -> Mosquitto:
            address = stack.enter_context(reserved_port())
            broker = Mosquitto(tmp_path, address, *lines)
            stack.callback(broker.stop)
            broker.start()
            return broker

        yield make


@pytest.fixture
def broker(make_broker: Callable[..., Mosquitto]) -> Mosquitto:
    return make_broker()
