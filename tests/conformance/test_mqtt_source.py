"""The common conformance suites, run with the MQTT connector: with mosquitto by MQTT 5, with aedes by MQTT 3.1.1."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar, Literal

import pytest

from shmio.config import Address
from shmio.connectors.base import Connector
from shmio.connectors.mqtt.connector import MqttConnector
from shmio.connectors.mqtt.options import MqttOptions
from shmio.layout.model import Layout
from shmio.layout.values.codec import codec
from shmio.segment import Write
from shmio.testing.conformance import TIMEOUT_MS, ConnectorConformance, Rig, Run
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port
from shmio.testing.proxy import FaultProxy
from shmio.testing.table_conformance import TableConformance, Tags
from shmio.testing.write_conformance import SPARE, WriteConformance, Writer, WriteRig
from tests.unit.connectors.mqtt.peer import Peer, framing
from tests.unit.connectors.source import layout_of

COUNTS = 20


def layout(*, changed: bool = False) -> Layout:
    if changed:
        return layout_of(
            {"added": ("INT", "plant/added"), "counted": (f"ARRAY[1..{COUNTS}] OF LREAL", "plant/counted $")}
        )
    return layout_of(
        {
            "counted": {"type": f"ARRAY[1..{COUNTS}] OF LREAL", "address": "plant/counted $"},
            "spare": {
                "type": f"ARRAY[1..{SPARE}] OF BYTE",
                "address": "plant/spare $ -> plant/spare $",
                "writable": True,
            },
            "fixed": {"type": "INT", "address": "plant/fixed", "writable": True},
        }
    )


class MqttRig:
    """The broker behind a proxy."""

    def __init__(self, proxy: FaultProxy, version: Literal["auto", "5", "3.1.1"], *, changed: bool = False) -> None:
        self.proxy = proxy
        self.timeout_ms = TIMEOUT_MS
        self.layout = layout(changed=changed)
        self._version = version
        by_path = {register.path: register for register in self.layout.registers}
        self._counted = codec(by_path["counted"], "little")
        if changed:
            return
        self.spare = self.flags = by_path["spare"].offset
        self.refused = Write(by_path["fixed"].offset, 0, b"\1\0")

    def changed(self) -> MqttRig:
        return MqttRig(self.proxy, self._version, changed=True)

    def connector(self) -> Connector:
        options = MqttOptions(
            url=f"mqtt://{self.proxy.address}", timeout=self.timeout_ms, max_age_ms=0, version=self._version,
            retain=True,  # for the next connection, as a device would keep its values
        )  # fmt: skip
        return MqttConnector(options, self.layout)

    def generation(self, raw: bytes) -> int:
        counted = self._counted.decode(raw)
        assert isinstance(counted, list)
        numbers = {one for one in counted if isinstance(one, float)}
        assert len(numbers) == 1, "an array with elements of different moments"
        return int(numbers.pop())


class Late:
    """Overrides for a connector whose device sends values by itself."""

    def test_a_late_answer_is_not_taken_for_the_next(self, run: Run, rig: Rig) -> None:
        """There are no requests. A late message on an old connection must not be seen on the next connection."""
        run.good()
        rig.proxy.hold()
        run.bad()
        rig.proxy.release()
        run.good()


def counting(peer: Peer, address: Address, version: int) -> None:
    """Let a device publish at a broker."""
    peer.ask("connect", address.port, {"protocolVersion": version})
    peer.ask("count", "plant/counted", COUNTS, 4)


@pytest.fixture(scope="module")
def mosquitto(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Address, Peer]]:
    if reason := missing():
        pytest.skip(reason)
    folder: Path = tmp_path_factory.mktemp("mosquitto")
    open_topics = ("plant/counted", "plant/spare", "plant/added", "types/#", "arrays/#", "many/#")
    rules = [*(f"topic readwrite {topic}" for topic in open_topics), "topic read plant/fixed", ""]
    (folder / "acl").write_text("\n".join(rules))
    lines = ("allow_anonymous true", f"acl_file {folder / 'acl'}")
    with reserved_port() as address, Peer() as peer:
        broker = Mosquitto(folder, address, *lines)
        broker.start()
        try:
            counting(peer, address, 5)
            yield address, peer
        finally:
            broker.stop()


@pytest.fixture(scope="module")
def aedes() -> Iterator[Address]:
    with reserved_port() as address, Peer() as peer:
        peer.ask("broker", address.port)
        counting(peer, address, 4)
        yield address


_KINDS = (
    "BOOL", "SINT", "INT", "DINT", "LINT", "USINT", "UINT", "UDINT", "ULINT", "BYTE", "WORD", "DWORD", "LWORD", "REAL",
    "LREAL", "STRING[20]",
)  # fmt: skip


class MqttTable:
    """Topics that are written and read: as text, and arrays as JSON."""

    unknown: ClassVar[Mapping[str, object]] = {"type": "INT", "address": "nowhere/at/all"}
    types: ClassVar[Tags] = {
        **{kind[:6].lower(): {"type": kind, "address": f"types/{kind[:6]}", "writable": True} for kind in _KINDS},
        **{
            f"array of {kind[:6].lower()}": {
                "type": f"ARRAY[1..3] OF {kind}", "address": f"arrays/{kind[:6]} $ -> arrays/{kind[:6]} $",
                "writable": True,
            }
            for kind in _KINDS
        },
    }  # fmt: skip
    many: ClassVar[Tags] = {f"v{at}": {"type": "INT", "address": f"many/{at}", "writable": True} for at in range(200)}

    def __init__(self, address: Address) -> None:
        self._options = MqttOptions(url=f"mqtt://{address}", max_age_ms=0)

    def connector(self, layout: Layout) -> Connector:
        return MqttConnector(self._options, layout)


class TestMosquitto(Late, TableConformance, WriteConformance):
    @pytest.fixture
    def table(self, mosquitto: tuple[Address, Peer]) -> MqttTable:
        return MqttTable(mosquitto[0])

    @pytest.fixture
    def rig(self, mosquitto: tuple[Address, Peer]) -> Iterator[MqttRig]:
        address, peer = mosquitto
        peer.publish("plant/spare", [0] * SPARE, retain=True)
        with FaultProxy(address, framing=framing) as proxy:
            yield MqttRig(proxy, "5")

    def test_several_writes_in_one_command(self, run: Run, writer: Writer, rig: WriteRig) -> None:
        """A command for several elements of an array is one message."""
        frame = writer.written(Write(rig.spare, 0, b"ab"), Write(rig.spare + 4, 0, b"\x42"))
        assert frame.raw[rig.spare : rig.spare + SPARE] == b"ab\0\0\x42\0\0\0"

    def test_a_bit_is_written_without_its_neighbours(self, run: Run, writer: Writer, rig: WriteRig) -> None:
        """A message cannot carry a single bit of a number: the write is refused, and changes nothing."""
        writer.written(Write(rig.spare, 0, b"\x0f"))
        end = writer.write(Write(rig.spare, 1, b"\0"))
        assert "write the whole register" in end.text
        assert run.good().raw[rig.spare] == 0x0F


class TestAedes(Late, ConnectorConformance):
    @pytest.fixture
    def rig(self, aedes: Address) -> Iterator[MqttRig]:
        with FaultProxy(aedes, framing=framing) as proxy:
            yield MqttRig(proxy, "auto")
