"""The common conformance suites, run with the Modbus connector against a device made with libmodbus."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar

import pytest

from shmio.config import Address
from shmio.connectors.base import Connector
from shmio.connectors.modbus.connector import ModbusConnector, ModbusOptions
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec
from shmio.segment import EventKind, Quality, Write
from shmio.testing.conformance import TIMEOUT_MS, Run
from shmio.testing.proxy import FaultProxy
from shmio.testing.table_conformance import TableConformance, Tags
from shmio.testing.write_conformance import SPARE, WriteConformance, Writer
from tests.unit.connectors.modbus.device import Device

NODE = Path(__file__).parents[1] / "unit/endpoints/node"


def framing(data: bytes | bytearray) -> int:
    """Return the length of the frame at the start of ``data``; 0 if it is not known yet."""
    return 6 + int.from_bytes(data[4:6], "big") if len(data) >= 6 else 0


def layout(words: int, *, changed: bool = False) -> Layout:
    tags = {"added": {"type": "UINT", "address": "holding 0"}} if changed else {}
    tags |= {
        "counted": {"type": f"ARRAY[1..{words}] OF UINT", "address": "holding 0"},
        "flags": {"type": "BYTE", "address": f"holding {words}"},
        "copy": {"type": "BYTE", "address": f"holding {words + 1}"},
    }
    if changed:
        return place_tags("device", tags).with_statuses()
    tags |= {
        "spare": {"type": f"ARRAY[1..{SPARE}] OF BYTE", "address": "holding 1000"},
        "missing": {"type": "UINT", "address": "holding 3000"},
    }
    return place_tags("device", tags).with_statuses()


class ModbusRig:
    """The device behind a proxy."""

    def __init__(self, proxy: FaultProxy, words: int, *, changed: bool = False) -> None:
        self.proxy = proxy
        self.timeout_ms = TIMEOUT_MS
        self.layout = layout(words, changed=changed)
        registers = {one.path: one for one in self.layout.registers}
        self._codecs = [codec(registers[name], "little") for name in ("counted", "flags", "copy")]
        self._added = codec(registers["added"], "little") if changed else None
        self._words = words
        self._one_request = words < 100
        if not changed:
            self.flags, self.spare = registers["flags"].offset, registers["spare"].offset
            self.refused = Write(registers["missing"].offset, 0, b"\1\0")

    def changed(self) -> ModbusRig:
        return ModbusRig(self.proxy, self._words, changed=True)

    def connector(self) -> Connector:
        address = self.proxy.address
        return ModbusConnector(
            ModbusOptions(host=address.host, port=address.port, timeout=self.timeout_ms), self.layout
        )

    def generation(self, raw: bytes) -> int:
        counted, flags, copy = (one.decode(raw) for one in self._codecs)
        assert isinstance(counted, list)
        assert isinstance(flags, int)
        numbers = [one for one in counted if isinstance(one, int)]
        if self._one_request:
            assert len(set(numbers)) == 1, "words of different moments in one request"
        assert sorted(numbers) == numbers, "a request has an older answer than the one before it"
        if self._added:
            assert self._added.decode(raw) == numbers[0], "the added register has another value"
        assert flags & 0xFE == copy, "a write has changed the neighbours of its bit"
        return numbers[0]


_WORDS = {
    "INT": 1, "DINT": 2, "LINT": 4, "UINT": 1, "UDINT": 2, "ULINT": 4, "WORD": 1, "DWORD": 2, "LWORD": 4, "REAL": 2,
    "LREAL": 4, "TIME": 2, "SINT": 1, "USINT": 1, "BYTE": 1, "STRING[11]": 6,
}  # fmt: skip


class ModbusTable:
    """Two units of the device, as a tag table names their entries."""

    unknown: ClassVar[Mapping[str, object]] = {"type": "INT", "address": "holding 3000"}
    many: ClassVar[Tags] = {
        f"v{at}": {"type": "INT", "address": f"unit {1 + at % 2} holding {1200 + at}"} for at in range(300)
    }

    def __init__(self, address: Address) -> None:
        self._address = address
        types: dict[str, dict[str, object]] = {
            "coil": {"type": "BOOL", "address": "coil 3"},
            "coils": {"type": "ARRAY[1..19] OF BOOL", "address": "coil 5"},
            "bit": {"type": "BOOL", "address": "holding 0.3"},
        }
        at = 1
        for kind, words in _WORDS.items():
            types[kind.partition("[")[0].lower()] = {"type": kind, "address": f"holding {at}"}
            types[f"array of {kind.partition('[')[0].lower()}"] = {
                "type": f"ARRAY[1..3] OF {kind}", "address": f"unit 2 holding {at}",
            }  # fmt: skip
            at += 3 * words
        self.types: Tags = types

    def connector(self, layout: Layout) -> Connector:
        return ModbusConnector(ModbusOptions(host=self._address.host, port=self._address.port), layout)


class TestModbus(TableConformance, WriteConformance):
    repeats_reads = True

    @pytest.fixture
    def table(self) -> Iterator[ModbusTable]:
        with Device() as device:
            yield ModbusTable(device.address)

    @pytest.fixture(params=[50, 300], ids=["one request", "several requests"])
    def rig(self, request: pytest.FixtureRequest) -> Iterator[ModbusRig]:
        with Device() as device:
            device.count(0, request.param)
            with FaultProxy(device.address, framing=framing) as proxy:
                yield ModbusRig(proxy, request.param)

    @pytest.mark.parametrize("at", [0, 2, 5, 6, 7, 8])
    def test_an_answer_with_any_wrong_byte_in_its_header_is_dropped(self, run: Run, rig: ModbusRig, at: int) -> None:
        """Transaction, protocol, length, unit, function and byte count must all match the request."""
        run.good()
        rig.proxy.edit(lambda frame: frame[:at] + bytes((frame[at] ^ 0x11,)) + frame[at + 1 :])
        run.bad()
        rig.proxy.pass_all()
        run.good()

    def test_a_confirmation_of_another_write_confirms_nothing(self, run: Run, writer: Writer, rig: ModbusRig) -> None:
        """The outcome is unknown, and the connection is dropped."""
        rig.proxy.edit(
            lambda frame: frame[:9] + bytes((frame[9] ^ 1,)) + frame[10:] if frame[7] in (6, 16, 22) else frame
        )
        end = writer.write(Write(rig.spare, 0, b"x"))
        assert end.kind == EventKind.UNKNOWN
        assert "does not match the write" in end.text
        run.until(lambda frame: frame.quality is Quality.BAD)
        rig.proxy.pass_all()
        run.good()


class TestModbusSerial(TableConformance):
    """The device is made with modbus-serial. It does not know function 22."""

    @pytest.fixture
    def table(self) -> Iterator[ModbusTable]:
        if not shutil.which("node") or not (NODE / "node_modules/modbus-serial").exists():
            pytest.skip("needs Node's modbus-serial")
        with subprocess.Popen(
            ["node", str(NODE / "modbus_server.js")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            yield ModbusTable(Address("127.0.0.1", int(process.stdout.readline())))
            process.communicate(timeout=60)
