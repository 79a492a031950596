"""Data blocks that are shorter than their layout, or were changed in the controller."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import snap7
from snap7.error import S7ProtocolError
from snap7.type import Block

from shmio.config import Address
from shmio.connectors.base import Connector
from shmio.connectors.s7.block_check import INTERVAL_NS
from shmio.connectors.s7.connector import S7Connector, S7Options
from shmio.connectors.s7.userdata import BlockInfo, parse_block
from shmio.emulators.s7 import Fault, S7Server, ServerOptions
from shmio.errors import ConnectorError
from shmio.layout import compiler
from shmio.layout.model import Layout
from shmio.model.statuses import BAD_OUT_OF_RANGE, GOOD, UNCERTAIN
from tests.unit.connectors.s7.test_table import Plc, codes, connected, later, served_by_snap7, table

BLOCK = """DATA_BLOCK "Press"
{ S7_Optimized_Access := 'FALSE' }
STRUCT
   Speed : Real;
   Counts : Array[1..46] of Int;
   Door : Bool;
   Mode : Int;
END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
SIZE = 100


def press() -> Layout:
    (layout,) = compiler.Program([compiler.Source("press.db", BLOCK.encode())]).compile(None).layouts
    assert layout.size == SIZE
    return layout


@contextlib.contextmanager
def emulated(data: bytearray, options: ServerOptions | None = None) -> Iterator[S7Server]:
    server = S7Server(Address("127.0.0.1", 0), options=options)
    server.add_block(1, data)
    server.start()
    try:
        yield server
    finally:
        server.stop()


@contextlib.contextmanager
def reading(layout: Layout, port: int) -> Iterator[Connector]:
    """Connect a source whose layout is the data block DB1."""
    options = S7Options(host="127.0.0.1", port=port, timeout=2000, dbNumber=1)
    with contextlib.closing(S7Connector.for_layout(layout)(options, layout)) as connector:
        connector.connect()
        yield connector


def again(connector: Connector) -> None:
    connector.close()
    connector.connect()


@pytest.fixture
def pass_a_minute(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Return a function that advances the clock until the source examines the block again."""
    return lambda: monkeypatch.setattr("shmio.connectors.s7.session.time.monotonic_ns", later(INTERVAL_NS))


def test_a_block_that_is_too_short_names_itself_both_lengths_and_what_is_missing() -> None:
    with (
        emulated(bytearray(60)) as server,
        reading(press(), server.address.port) as connector,
        pytest.raises(ConnectorError) as caught,
    ):
        connector.read()
    assert str(caught.value) == (
        'DB1 "Press" has 60 bytes, not 100 as in its layout (item code 0x05); export the layout again; beyond the '
        "end of the block: Counts, "
        "Door, Mode"
    )
    assert len(str(caught.value)) < 256


def test_a_block_that_becomes_shorter_while_it_is_read() -> None:
    with emulated(bytearray(SIZE)) as server, reading(press(), server.address.port) as connector:
        connector.read()
        server.load_block(1, bytearray(98))
        with pytest.raises(
            ConnectorError, match=r'^DB1 "Press" has 98 bytes, not 100 .* beyond the end of the block: Mode$'
        ):
            connector.read()


def test_a_block_that_becomes_longer_is_uncertain(
    caplog: pytest.LogCaptureFixture, pass_a_minute: Callable[[], None]
) -> None:
    with emulated(bytearray(SIZE)) as server, reading(press(), server.address.port) as connector:
        for _ in range(3):
            connector.read()
        server.load_block(1, bytearray(104))
        connector.read()
        assert connector.doubt == ""
        pass_a_minute()
        for _ in range(3):
            connector.read()
        doubt = 'DB1 "Press" was changed in the controller: it had 100 bytes and now has 104, but its layout has 100'
        assert connector.doubt == doubt
        server.cpu_state = snap7.server.CPUState.STOP
        again(connector)
        connector.read()
        assert connector.doubt.startswith(f"{doubt}; the PLC is in STOP")
        server.load_block(1, bytearray(SIZE))
        server.cpu_state = snap7.server.CPUState.RUN
        again(connector)
        for _ in range(3):
            connector.read()
        assert connector.doubt == ""
    found = [record.getMessage() for record in caplog.records]
    assert len(found) == 2
    assert found[0].startswith('DB1 "Press" was changed in the controller since 20')
    assert found[0].endswith(
        " UTC: it had 100 bytes and now has 104, but its layout has 100; compare the layout with the block"
    )
    assert found[1].endswith(
        " UTC: it had 104 bytes and now has 100, as in its layout; compare the layout with the block"
    )


@pytest.mark.parametrize("layout", [press(), table({"x": {"type": "INT", "address": "DB1.DBW4"}})])
def test_another_checksum_is_a_warning(layout: Layout, caplog: pytest.LogCaptureFixture) -> None:
    with emulated(bytearray(SIZE)) as server, reading_any(layout, server.address.port) as connector:
        for count in range(10):
            server.load_block(1, bytearray(SIZE - 1) + bytes((count,)))
            again(connector)
            for _ in range(3):
                connector.read()
        assert connector.doubt == ""
    found = [record.getMessage() for record in caplog.records]
    assert len(found) == 5, "a checksum that changes all the time is not reported for ever"
    assert "it has 100 bytes as before, but another checksum or time of compilation" in found[0]


def reading_any(layout: Layout, port: int) -> contextlib.AbstractContextManager[Connector]:
    return reading(layout, port) if layout.status_offset is None else connected(layout, port)


def test_written_values_are_no_change(caplog: pytest.LogCaptureFixture, pass_a_minute: Callable[[], None]) -> None:
    data = bytearray(SIZE)
    with emulated(data) as server, reading(press(), server.address.port) as connector:
        for _ in range(3):
            connector.read()
        data[0] = 7
        pass_a_minute()
        for _ in range(3):
            connector.read()
    assert not caplog.records


TAGS: dict[str, object] = {
    **{f"r{at}": {"type": "INT", "address": f"DB1.DBW{at}"} for at in range(0, 20, 2)},
    "other": {"type": "INT", "address": "DB2.DBW0"},
    "marker": {"type": "INT", "address": "%MW0"},
}


@pytest.fixture
def plc() -> Iterator[S7Server]:
    with emulated(bytearray(20)) as server:
        server.add_block(2, bytearray(20))
        server.add_area(snap7.type.SrvArea.MK, bytearray(20))
        yield server


def test_of_a_tag_table_only_the_registers_beyond_the_end_are_bad(
    plc: S7Server, caplog: pytest.LogCaptureFixture, pass_a_minute: Callable[[], None]
) -> None:
    """The registers that remain in a shortened block are uncertain, because they may have moved."""
    layout = table(TAGS)
    with connected(layout, plc.address.port) as connector:
        for _ in range(5):
            raw = connector.read()
        assert codes(layout, raw) == [GOOD] * 12
        assert not caplog.records
        plc.load_block(1, bytearray(12))
        assert codes(layout, connector.read()) == [GOOD] * 6 + [BAD_OUT_OF_RANGE] * 4 + [GOOD] * 2
        assert "r12 (%DB1.DBW12) is bad: DB1 has no byte 13 (item code 0x05)" in caplog.text
        caplog.clear()
        pass_a_minute()
        for _ in range(5):
            raw = connector.read()
        assert codes(layout, raw) == [UNCERTAIN] * 6 + [BAD_OUT_OF_RANGE] * 4 + [GOOD] * 2
        (said,) = [record.getMessage() for record in caplog.records]
        assert said.startswith("DB1 was changed in the controller since 20")
        assert said.endswith(
            "UTC: it had 20 bytes and now has 12, but its registers need 20; beyond its end: r12 (%DB1.DBW12), "
            "r14 (%DB1.DBW14), r16 (%DB1.DBW16) and 1 more; compare the layout with the block"
        )
        assert connector.doubt == ""
        plc.load_block(1, bytearray(20))
        again(connector)
        for _ in range(5):
            raw = connector.read()
        assert codes(layout, raw) == [GOOD] * 6 + [BAD_OUT_OF_RANGE] * 4 + [GOOD] * 2


def test_a_table_that_never_fitted_is_reported_once(plc: S7Server, caplog: pytest.LogCaptureFixture) -> None:
    plc.load_block(1, bytearray(18))
    layout = table(TAGS)
    with connected(layout, plc.address.port) as connector:
        for _ in range(3):
            again(connector)
            for _ in range(5):
                raw = connector.read()
    assert codes(layout, raw) == [GOOD] * 9 + [BAD_OUT_OF_RANGE] + [GOOD] * 2
    (said,) = [record.getMessage() for record in caplog.records if "in the controller," in record.getMessage()]
    assert said == (
        "DB1 has 18 bytes in the controller, but its registers need 20; beyond its end: r18 (%DB1.DBW18); compare the "
        "layout with the block"
    )


def test_a_controller_that_tells_nothing_of_its_blocks_is_asked_once_a_session(
    caplog: pytest.LogCaptureFixture,
) -> None:
    asked = 0

    class Silent(S7Server):
        def _handle_get_block_info(self, request: dict[str, Any], *others: object) -> bytes:
            nonlocal asked
            asked += 1
            refused: bytes = self._build_userdata_error_response(request, 0x8104)
            return refused

    caplog.set_level(logging.INFO, "shmio.source")
    caplog.set_level(logging.WARNING, "snap7")
    server = Silent(Address("127.0.0.1", 0))
    server.add_block(1, bytearray(SIZE))
    server.start()
    try:
        with reading(press(), server.address.port) as connector:
            for _ in range(2):
                for _ in range(20):
                    connector.read()
                again(connector)
    finally:
        server.stop()
    assert asked == 2
    assert not caplog.records


def test_python_snap7s_server_tells_the_length(caplog: pytest.LogCaptureFixture) -> None:
    """This server reports no checksum. The blocks of Plc have 100 bytes."""
    plc = Plc()
    with served_by_snap7(plc) as port, reading(press(), port) as connector:
        for _ in range(5):
            connector.read()
        plc.blocks[1].extend(bytes(20))
        again(connector)
        for _ in range(5):
            connector.read()
        assert "it had 100 bytes and now has 120, but its layout has 100" in connector.doubt


def test_python_snap7s_client_reads_the_emulators_information() -> None:
    client = snap7.Client()
    with emulated(bytearray(SIZE), ServerOptions(block_size=60)) as server:
        client.connect("127.0.0.1", 0, 1, server.address.port)
        try:
            info = client.get_block_info(Block.DB, 1)
            with pytest.raises(S7ProtocolError, match="0xd209"):
                client.get_block_info(Block.DB, 2)
        finally:
            client.disconnect()
    assert (info.BlkNumber, info.MC7Size, info.LoadSize, info.Author) == (1, 60, 96, b"shmio")
    assert info.CheckSum


def test_information_about_a_block() -> None:
    """The answer follows the description in Snap7: DB 5 of 84 bytes, compiled on days 11,000 and 12,000."""
    data = bytes.fromhex(
        "30 41 0001 0022 0000 00 01 05 0a 0005 0000007c 00000000 00000102 2af8 00000304 2ee0 0000 0000 0000 0054"
        "0000000000000000 0000000000000000 0000000000000000 01 00 beef 00000000 00000000"
    )
    assert len(data) == 78
    assert parse_block(data, 5) == BlockInfo(124, (11_000, 0x102), (12_000, 0x304), 84, 0xBEEF)
    with pytest.raises(ConnectorError, match="of DB6, but of DB5"):
        parse_block(data, 6)
    with pytest.raises(ConnectorError, match="too short"):
        parse_block(data[:60], 5)


def test_an_optimized_block_is_not_told_of() -> None:
    with (
        emulated(bytearray(SIZE), ServerOptions(fault=Fault.OPTIMIZED)) as server,
        reading(press(), server.address.port) as connector,
        pytest.raises(ConnectorError, match="optimized"),
    ):
        connector.read()
