"""Classic S7 against the emulated PLC, held to the common suite: blocks of one PDU and of several."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from shmio.config import Address
from shmio.connectors.base import Connector
from shmio.connectors.s7.connector import S7Connector
from shmio.connectors.s7.options import S7Options
from shmio.emulators.counter import generations
from shmio.emulators.emulator import Emulator
from shmio.layout.model import Layout, Register
from shmio.segment import Quality
from shmio.testing.conformance import ConnectorConformance, Run
from shmio.testing.proxy import FaultProxy


class S7Rig:
    """The emulated PLC with the counter program."""

    def __init__(self, proxy: FaultProxy, size: int) -> None:
        self.proxy = proxy
        self.layout = layout(size)
        self.one_pdu = size <= 900

    def connector(self) -> Connector:
        address = self.proxy.address
        return S7Connector(S7Options(host=address.host, port=address.port, timeout=200, dbNumber=7), self.layout)

    def generation(self, raw: bytes) -> int:
        """A read of one PDU is one cycle of the PLC; one of several may span a few."""
        found = generations(raw)
        assert len(found) == 1 or not self.one_pdu, f"mixed cycles {found}"
        assert found[-1] - found[0] < 10_000, f"not the PLC's bytes: {found}"
        return found[0]


def layout(size: int) -> Layout:
    return Layout("DB7", 7, size, False, (Register("data", "BYTE", ((0, size - 1),), 0, None, size, size),))


class TestS7(ConnectorConformance):
    @pytest.fixture(params=[400, 2180], ids=["one PDU", "several PDUs"])
    def rig(self, request: pytest.FixtureRequest) -> Iterator[S7Rig]:
        with (
            Emulator(layout(request.param), "counter", Address("127.0.0.1", 0)) as plc,
            FaultProxy(plc.address) as proxy,
        ):
            yield S7Rig(proxy, request.param)

    def test_a_wrong_reference_is_never_taken(self, run: Run, rig: S7Rig) -> None:
        """An answer that names another request than any under way drops the connection."""
        run.good()
        rig.proxy.rewrite_reference(lambda reference: reference + 1000, frames=1)
        run.until(lambda frame: frame.quality is Quality.BAD)
        rig.proxy.pass_all()
        run.good()
