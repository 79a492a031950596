"""The conformance suite for all connectors of shmio, run with an agent in another language."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from agent import Agent
from shmio.connectors.base import Connector
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec
from shmio.testing.conformance import TIMEOUT_MS, ConnectorConformance
from shmio.testing.proxy import FaultProxy
from shmio_mtconnect.connector import MTConnectConnector, MTConnectOptions

PIECE = 64


class Rig:
    """The agent behind a proxy, which can break the connection."""

    def __init__(self, proxy: FaultProxy) -> None:
        self.proxy = proxy
        self.timeout_ms = TIMEOUT_MS
        tags: dict[str, object] = {
            "count": {"type": "UDINT", "address": "count"},
            "copy": {"type": "LREAL", "address": "VMC/copy"},
        }
        self.layout: Layout = place_tags("device", tags).with_statuses()

    def connector(self) -> Connector:
        """Return a connector to the agent."""
        options = MTConnectOptions(
            url=f"http://{self.proxy.address}", timeout=self.timeout_ms, interval=5, heartbeat=50
        )
        return MTConnectConnector(options, self.layout)

    def generation(self, raw: bytes) -> int:
        """Return the count in an image."""
        count, copy = (codec(register, "little").decode(raw) for register in self.layout.registers)
        assert isinstance(count, int)
        assert copy == count, "values of two moments in one image"
        return count


class TestMTConnect(ConnectorConformance):
    """Runs the suite of all connectors."""

    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        """Provide the agent, which counts, behind the proxy."""
        with Agent() as agent:
            agent.tell(count=True)
            agent.set(count="0", copy="0")
            # A frame is a piece of the stream, so that faults hit the middle of a document.
            with FaultProxy(agent.address, framing=lambda data: min(len(data), PIECE)) as proxy:
                yield Rig(proxy)
