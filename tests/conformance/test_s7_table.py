"""The common conformance suites, run with an S7 tag table against the emulated PLC."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

import pytest

from shmio.config import Address
from shmio.connectors.base import Connector
from shmio.connectors.s7.connector import S7Connector, S7Options
from shmio.emulators.emulator import Emulator
from shmio.emulators.programs import generations
from shmio.emulators.s7 import ServerOptions
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.model.statuses import BAD_OUT_OF_RANGE, GOOD, StatusArea
from shmio.segment import Quality, Write
from shmio.testing.conformance import TIMEOUT_MS, Run
from shmio.testing.proxy import FaultProxy
from shmio.testing.table_conformance import TableConformance, Tags
from shmio.testing.write_conformance import SPARE, WriteConformance
from tests.conformance.test_s7 import TAIL, Shared
from tests.conformance.test_s7 import layout as block

PART = 80


class TableRig:
    """The emulated PLC, read by a table of parts of its block, one of which does not exist."""

    def __init__(self, proxy: FaultProxy, plc: Emulator, size: int, *, changed: bool = False) -> None:
        self.proxy, self.plc = proxy, plc
        self.timeout_ms = TIMEOUT_MS
        self._size, self._changed = size, changed
        self._counted = counted = size - TAIL
        self._one_pdu = size <= 400
        tags: dict[str, object] = {}
        if changed:  # two registers more, then the same data, and two registers less
            tags["added"] = {"type": "BYTE", "address": f"DB7.DBB{size - 1}"}
            tags["marker"] = {"type": "BYTE", "address": "%MB5"}
        tags |= {
            f"data/{start}": {
                "type": f"ARRAY[1..{min(PART, counted - start)}] OF BYTE",
                "address": f"DB7.DBB{start}",
            }
            for start in range(0, counted, PART)
        }
        if not changed:
            tags["spare"] = {"type": f"ARRAY[1..{SPARE}] OF BYTE", "address": f"DB7.DBB{counted}"}
        tags["flags"] = {"type": "BYTE", "address": f"DB7.DBB{size - 2}"}
        tags["copy"] = {"type": "BYTE", "address": f"DB7.DBB{size - 1}"}
        if not changed:
            tags["missing"] = {"type": "INT", "address": "DB7.DBW60000"}
        self.layout = place_tags("device", tags).with_statuses()
        offsets = {one.path: one.offset for one in self.layout.registers}
        self._data, self.flags, self.copy = offsets["data/0"], offsets["flags"], offsets["copy"]
        if not changed:
            self.spare = offsets["spare"]
            self.refused = Write(offsets["missing"], 0, b"\1\0")

    def changed(self) -> TableRig:
        return TableRig(self.proxy, self.plc, self._size, changed=True)

    def connector(self) -> Connector:
        address = self.proxy.address
        options = S7Options(host=address.host, port=address.port, timeout=self.timeout_ms)
        return S7Connector.for_layout(self.layout)(options, self.layout)

    def generation(self, raw: bytes) -> int:
        found = generations(raw[self._data : self._data + self._counted])
        assert len(found) == 1 or not self._one_pdu, f"mixed cycles {found}"
        assert found[-1] - found[0] < 10_000, f"bytes that the PLC never had: {found}"
        if self._one_pdu:
            assert raw[self.flags] & 0xFE == raw[self.copy], "a write has changed the neighbours of its bit"
            assert not self._changed or raw[0] == raw[self.copy], "the added register has another value"
        return found[0]


_BYTES = {
    "SINT": 1, "INT": 2, "DINT": 4, "LINT": 8, "USINT": 1, "UINT": 2, "UDINT": 4, "ULINT": 8, "BYTE": 1, "WORD": 2,
    "DWORD": 4, "LWORD": 8, "REAL": 4, "LREAL": 8, "TIME": 4, "STRING[10]": 12,
}  # fmt: skip


class S7Types:
    """Two blocks and the markers of an emulated PLC, as a tag table names them."""

    unknown: ClassVar[Mapping[str, object]] = {"type": "INT", "address": "DB5.DBW60000"}
    many: ClassVar[Tags] = {
        f"v{at}": {"type": "INT", "address": f"DB{5 + at % 2}.DBW{2000 + 10 * at}"} for at in range(400)
    }

    def __init__(self) -> None:
        types: dict[str, dict[str, object]] = {
            "bit": {"type": "BOOL", "address": "%M3.7"},
            "bits": {"type": "ARRAY[1..19] OF BOOL", "address": "DB5.DBX0.0"},
            "output": {"type": "WORD", "address": "%QW10"},
        }
        at = 10
        for kind, size in _BYTES.items():
            name = kind.partition("[")[0].lower()
            types[name] = {"type": kind, "address": f"DB5.DBX{at}.0" if size > 4 else f"DB5.DB{' BW D'[size]}{at}"}
            types[f"array of {name}"] = {"type": f"ARRAY[1..3] OF {kind}", "address": f"DB6.DBX{at}.0"}
            at += 3 * size + 1 & ~1
        self.types: Tags = types
        self.device = place_tags("plc", {**types, **self.many})
        self.address = Address("127.0.0.1", 0)

    def connector(self, layout: Layout) -> Connector:
        options = S7Options(host=self.address.host, port=self.address.port)
        return S7Connector.for_layout(layout)(options, layout)


class TestS7Table(TableConformance, WriteConformance):
    @pytest.fixture
    def table(self) -> Iterator[S7Types]:
        made = S7Types()
        with Emulator(made.device, "idle", Address("127.0.0.1", 0)) as plc:
            made.address = plc.address
            yield made

    @pytest.fixture(params=[pytest.param((400, 960), id="one PDU"), pytest.param((1500, 480), id="several PDUs")])
    def rig(self, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[TableRig]:
        size, pdu_size = request.param
        monkeypatch.setattr("shmio.emulators.programs.PROGRAMS", {"shared": Shared})
        options = ServerOptions(max_pdu_size=pdu_size)
        with (
            Emulator(block(size), "shared", Address("127.0.0.1", 0), options=options) as plc,
            FaultProxy(plc.address) as proxy,
        ):
            yield TableRig(proxy, plc, size)

    def test_an_address_that_does_not_exist_is_bad_by_itself(self, run: Run, rig: TableRig) -> None:
        frame = run.good()
        area, last = StatusArea(rig.layout), len(rig.layout.registers) - 1
        assert [area.get(frame.raw, index).code for index in range(last)] == [GOOD] * last
        assert area.get(frame.raw, last).code == BAD_OUT_OF_RANGE

    def test_a_reply_with_a_wrong_reference_is_never_accepted(self, run: Run, rig: TableRig) -> None:
        run.good()
        rig.proxy.rewrite_reference(lambda reference: reference + 1000, frames=1)
        run.until(lambda frame: frame.quality is Quality.BAD)
        rig.proxy.pass_all()
        run.good()
