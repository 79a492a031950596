"""The common conformance suites, run with the OPC UA connector against a server made with asyncua."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar, Literal

import pytest

from shmio.connectors.base import Connector
from shmio.connectors.opcua.connector import OpcUaConnector
from shmio.connectors.opcua.options import OpcUaOptions
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec
from shmio.segment import Write
from shmio.testing.conformance import TIMEOUT_MS, Run
from shmio.testing.proxy import FaultProxy
from shmio.testing.table_conformance import TableConformance, Tags
from shmio.testing.write_conformance import SPARE, WriteConformance, Writer, WriteRig
from tests.unit.connectors.opcua.device import Device, framing

WORDS = 50
MANY = 1100
"""More than the nodes of a request and of a subscription."""


def layout(*, changed: bool = False) -> Layout:
    tags: dict[str, object] = {"added": {"type": "UINT", "address": "ns=2;s=added"}} if changed else {}
    tags["counted"] = {"type": f"ARRAY[1..{WORDS}] OF UDINT", "address": "ns=2;s=counted"}
    if changed:
        return place_tags("device", tags).with_statuses()
    tags |= {f"spare/{place}": {"type": "BYTE", "address": f"ns=2;s=spare{place}"} for place in range(SPARE)}
    tags["fixed"] = {"type": "UINT", "address": "/Objects/2:Device/2:fixed"}
    return place_tags("device", tags).with_statuses()


class OpcUaRig:
    """The server behind a proxy."""

    def __init__(self, proxy: FaultProxy, mode: Literal["subscribe", "poll"], *, changed: bool = False) -> None:
        self.proxy = proxy
        self.timeout_ms = TIMEOUT_MS
        self.layout = layout(changed=changed)
        self._mode = mode
        by_path = {register.path: register for register in self.layout.registers}
        self._counted = codec(by_path["counted"], "little")
        if changed:
            return
        self.spare = by_path["spare/0"].offset
        self.flags = self.spare
        self.refused = Write(by_path["fixed"].offset, 0, b"\1\0")

    def changed(self) -> OpcUaRig:
        return OpcUaRig(self.proxy, self._mode, changed=True)

    def connector(self) -> Connector:
        options = OpcUaOptions(
            url=f"opc.tcp://{self.proxy.address}",
            timeout=self.timeout_ms,
            mode=self._mode,
            sampling_ms=5,
            publishing_ms=10,
        )
        return OpcUaConnector(options, self.layout)

    def generation(self, raw: bytes) -> int:
        counted = self._counted.decode(raw)
        assert isinstance(counted, list)
        numbers = {one for one in counted if isinstance(one, int)}
        assert len(numbers) == 1, "an array with elements of different moments"
        return numbers.pop()


@pytest.fixture(scope="module")
def device() -> Iterator[Device]:
    with Device() as device:
        device.ask("add", "counted", "UInt32", [0] * WORDS)
        device.ask("add", "added", "UInt16", 9)
        device.ask("add", "fixed", "UInt16", 7, False)
        for place in range(SPARE):
            device.ask("add", f"spare{place}", "Byte", 0)
        device.ask("count", "counted", WORDS, 0.004)
        yield device


_NODES = {
    "BOOL": "Boolean", "SINT": "SByte", "INT": "Int16", "DINT": "Int32", "LINT": "Int64", "USINT": "Byte",
    "UINT": "UInt16", "UDINT": "UInt32", "ULINT": "UInt64", "BYTE": "Byte", "WORD": "UInt16", "DWORD": "UInt32",
    "LWORD": "UInt64", "REAL": "Float", "LREAL": "Double", "STRING[20]": "String", "TIME": "Int32",
}  # fmt: skip


class OpcUaTable:
    """The server's nodes, one for each type."""

    unknown: ClassVar[Mapping[str, object]] = {"type": "INT", "address": "ns=2;s=nowhere"}
    types: ClassVar[Tags] = {
        f"{what}{kind.partition('[')[0].lower()}": {
            "type": f"ARRAY[1..3] OF {kind}" if what else kind,
            "address": f"ns=2;s={what}{kind.partition('[')[0]}",
        }
        for kind in _NODES
        for what in ("", "array of ")
    }
    many: ClassVar[Tags] = {f"v{at}": {"type": "INT", "address": f"ns=2;s=many{at}"} for at in range(MANY)}

    def __init__(self, url: str, mode: Literal["subscribe", "poll"]) -> None:
        self._options = OpcUaOptions(url=url, mode=mode, sampling_ms=5, publishing_ms=10)

    def connector(self, layout: Layout) -> Connector:
        return OpcUaConnector(self._options, layout)

    @staticmethod
    def make(device: Device) -> None:
        for kind, node in _NODES.items():
            zero = False if kind == "BOOL" else "" if node == "String" else 0
            name = kind.partition("[")[0]
            device.ask("add", name, node, zero)
            device.ask("add", f"array of {name}", node, [zero] * 3)
        for at in range(MANY):
            device.ask("add", f"many{at}", "Int16", 0)


@pytest.fixture(scope="module")
def other() -> Iterator[Device]:
    """A server with many nodes, which would delay the answers that the suite's short time-outs allow."""
    with Device() as other:
        OpcUaTable.make(other)
        yield other


class TestOpcUa(TableConformance, WriteConformance):
    @pytest.fixture(params=["subscribe", "poll"])
    def table(self, request: pytest.FixtureRequest, other: Device) -> OpcUaTable:
        return OpcUaTable(other.url, request.param)

    @pytest.fixture(params=["subscribe", "poll"])
    def rig(self, request: pytest.FixtureRequest, device: Device) -> Iterator[OpcUaRig]:
        for place in range(SPARE):
            device.ask("set", f"spare{place}", "Byte", 0)
        with FaultProxy(device.address, framing=framing) as proxy:
            yield OpcUaRig(proxy, request.param)

    def test_several_writes_in_one_command(self, run: Run, writer: Writer, rig: WriteRig) -> None:
        """A command for several nodes has an outcome for each of them."""
        frame = writer.written(Write(rig.spare, 0, b"ab"), Write(rig.spare + 4, 0, b"\x42"))
        assert frame.raw[rig.spare : rig.spare + SPARE] == b"ab\0\0\x42\0\0\0"

    def test_a_bit_is_written_without_its_neighbours(self, run: Run, writer: Writer, rig: WriteRig) -> None:
        """OPC UA cannot write a single bit of a number: the write is refused, and changes nothing."""
        writer.written(Write(rig.spare, 0, b"\x0f"))
        end = writer.write(Write(rig.spare, 1, b"\0"))
        assert "write the whole register" in end.text
        assert run.good().raw[rig.spare] == 0x0F
