"""Registers with values of the CPU.

The tests read them from shmio's emulator, from python-snap7's server, and from CPUs that refuse.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import logging
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import snap7
from hypothesis import given
from hypothesis import strategies as st

from shmio.config import Address
from shmio.connectors.s7 import userdata
from shmio.connectors.s7.connector import S7Connector, S7Options
from shmio.connectors.s7.query import MAX_PARTS
from shmio.connectors.s7.userdata import parse_clock, szl_records
from shmio.emulators.s7 import S7Server, ServerOptions
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.values.codec import Value
from shmio.model.statuses import BAD_NO_DATA, BAD_NOT_SUPPORTED, BAD_WAITING_FOR_INITIAL_DATA, GOOD, StatusArea
from shmio.testing.proxy import FaultProxy
from tests.unit.connectors.s7 import noise as frames
from tests.unit.connectors.s7.test_table import (
    Plc,
    codes,
    connected,
    later,
    served_by_snap7,
    table,
    values,
    write,
)

CPU: dict[str, object] = {
    "int": {"type": "INT", "address": "DB1.DBW4"},
    "state": {"type": "STRING[9]", "address": "cpu.state"},
    "number": {"type": "USINT", "address": "CPU.State"},
    "runs": {"type": "BOOL", "address": "cpu.state"},
    "code": {"type": "STRING[20]", "address": "cpu.order_code"},
    "firmware": {"type": "STRING[12]", "address": "cpu.firmware"},
    "name": {"type": "WSTRING[24]", "address": "cpu.name"},
    "module": {"type": "STRING[24]", "address": "cpu.module_name"},
    "plant": {"type": "STRING", "address": "cpu.plant"},
    "serial": {"type": "STRING[24]", "address": "cpu.serial_number"},
    "kind": {"type": "STRING[32]", "address": "cpu.module_type"},
    "clock/dt": {"type": "DATE_AND_TIME", "address": "cpu.clock"},
    "clock/dtl": {"type": "DTL", "address": "cpu.clock"},
    "clock/ldt": {"type": "LDT", "address": "cpu.clock"},
    "clock/text": {"type": "STRING[23]", "address": "cpu.clock"},
}
IDENTITY: dict[str, Value] = {
    "code": "SHMIO EMULATED S7", "firmware": "V0.1.0", "name": "shmio", "module": "Emulated S7", "plant": "",
    "serial": "0", "kind": "Emulated S7",
}  # fmt: skip


class Refusing(S7Server):
    """An emulator that refuses some questions, as CPUs with older firmware do, or answers them differently."""

    refused: Callable[[bytes], bool] = staticmethod(lambda _: True)
    asked = 0

    def _process_request(self, request_data: bytes, client_address: tuple[str, int]) -> bytes | None:
        if request_data[1] == 7:
            self.asked += 1
            if self.refused(request_data):
                return struct.pack(">BBHHHHH", 0x32, 2, 0, int.from_bytes(request_data[4:6], "big"), 0, 0, 0x8104)
        return super()._process_request(request_data, client_address)


@contextlib.contextmanager
def serving(plc: Plc, kind: type[S7Server] = S7Server, options: ServerOptions | None = None) -> Iterator[S7Server]:
    server = kind(Address("127.0.0.1", 0), options=options)
    server.add_block(1, plc.blocks[1])
    server.start()
    try:
        yield server
    finally:
        server.stop()


def settled(layout_tags: dict[str, object], port: int) -> tuple[dict[str, Value], dict[str, int]]:
    """Return values and statuses as soon as every register has received its first value."""
    layout = table(layout_tags)
    with connected(layout, port) as connector:
        for _ in range(1000):
            raw = connector.read()
            found = dict(zip(layout.by_path, codes(layout, raw), strict=True))
            if BAD_WAITING_FOR_INITIAL_DATA not in found.values():
                break
        area = StatusArea(layout)
        assert area.get(raw, 0).source_ns == 0
        assert all(area.get(raw, index).source_ns for index in range(1, len(layout.registers)))
        return values(layout, raw), found


@pytest.mark.parametrize("pdu_size", [100, 240, 960])
def test_what_the_cpu_is_does_and_says_of_the_time(pdu_size: int) -> None:
    """With a PDU of 100 bytes, the CPU's names arrive in three parts."""
    before = dt.datetime.now().replace(microsecond=0)
    with serving(Plc(), options=ServerOptions(max_pdu_size=pdu_size)) as server:
        found, statuses = settled(CPU, server.address.port)
    assert set(statuses.values()) == {GOOD}
    assert {name: found[name] for name in IDENTITY} == IDENTITY
    assert (found["int"], found["state"], found["number"], found["runs"]) == (-2, "RUN", 8, True)
    clocks = {dt.datetime.fromisoformat(str(found[f"clock/{kind}"])[:23]) for kind in ("dt", "dtl", "ldt", "text")}
    (clock,) = clocks
    assert before <= clock <= dt.datetime.now()


def test_python_snap7s_server_is_read_as_far_as_it_answers() -> None:
    """This server has no lists of mode and firmware, and its list of names has no records."""
    with served_by_snap7(Plc()) as port:
        found, statuses = settled(CPU, port)
    assert found["code"] == "6ES7 315-2EH14-0AB0"
    assert found["clock/dt"] is not None
    good = {"int", "code", "clock/dt", "clock/dtl", "clock/ldt", "clock/text"}
    assert {name for name, status in statuses.items() if status == GOOD} == good
    assert {statuses[name] for name in ("state", "number", "runs")} == {BAD_NOT_SUPPORTED}
    assert {statuses[name] for name in ("firmware", "name", "module", "plant", "serial", "kind")} == {BAD_NO_DATA}


@pytest.mark.parametrize("pdu_size", [100, 960])
def test_python_snap7s_client_reads_what_the_emulator_is(pdu_size: int) -> None:
    client = snap7.Client()
    with serving(Plc(), options=ServerOptions(max_pdu_size=pdu_size)) as server:
        client.connect("127.0.0.1", 0, 1, server.address.port)
        try:
            info, code = client.get_cpu_info(), client.get_order_code()
        finally:
            client.disconnect()
    assert (info.ASName, info.ModuleName, info.ModuleTypeName) == (b"shmio", b"Emulated S7", b"Emulated S7")
    assert (code.OrderCode, code.V1, code.V2, code.V3) == (b"SHMIO EMULATED S7", 0, 1, 0)


def test_a_cpu_that_refuses_turns_only_these_registers_bad(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "shmio.source")
    with serving(Plc(), Refusing) as server:
        found, statuses = settled(CPU, server.address.port)
    assert (found.pop("int"), statuses.pop("int")) == (-2, GOOD)
    assert set(statuses.values()) == {BAD_NOT_SUPPORTED}
    assert len(caplog.records) == 4
    assert (
        "code (cpu.order_code), firmware (cpu.firmware): bad: the CPU refuses the request 'read SZL' (error 0x8104)"
        in caplog.text
    )
    assert "state (cpu.state), number (cpu.state), runs (cpu.state): bad: the controller does not" in caplog.text


def test_a_refusal_is_asked_about_again_in_the_next_session() -> None:
    layout = table(CPU)
    with serving(Plc(), Refusing) as server, connected(layout, server.address.port) as connector:
        assert isinstance(server, Refusing)
        for _ in range(100):
            raw = connector.read()
        assert server.asked == 5  # mode, two lists, the clock, and DB1
        assert codes(layout, raw).count(GOOD) == 1
        server.refused = lambda request: request[-4:-2] == b"\4\x24"
        connector.close()
        connector.connect()
        for _ in range(100):
            raw = connector.read()
        assert codes(layout, raw).count(GOOD) == len(CPU) - 3


def test_values_of_another_session_are_not_shown() -> None:
    layout = table(CPU)
    with serving(Plc()) as server, connected(layout, server.address.port) as connector:
        for _ in range(100):
            raw = connector.read()
        assert set(codes(layout, raw)) == {GOOD}
        connector.close()
        connector.connect()
        found = dict(zip(layout.by_path, codes(layout, connector.read()), strict=True))
        assert {found[name] for name in ("name", "plant", "kind", "clock/dt")} == {BAD_WAITING_FOR_INITIAL_DATA}


def test_a_cpu_that_never_answers_is_not_asked_for_ever(caplog: pytest.LogCaptureFixture) -> None:
    """The CPU closes the connection at each question. After two attempts at each of the four, the source reads data."""

    class Closing(Refusing):
        def _process_request(self, request_data: bytes, client_address: tuple[str, int]) -> bytes | None:
            return None if request_data[1] == 7 else super()._process_request(request_data, client_address)

    layout = table(CPU)
    with serving(Plc(), Closing) as server:
        connector = S7Connector.for_layout(layout)(
            S7Options(host="127.0.0.1", port=server.address.port, timeout=2000), layout
        )
        failures = reads = 0
        with contextlib.closing(connector):
            while reads < 20 and failures < 20:
                try:
                    connector.connect()
                    while reads < 20:
                        raw = connector.read()
                        reads += 1
                except ConnectorError:
                    failures += 1
                    reads = 0
    assert failures == 8
    assert codes(layout, raw) == [GOOD] + [BAD_NOT_SUPPORTED] * (len(CPU) - 1)
    assert "does not ask again" in caplog.text


def test_a_cable_that_is_pulled_while_a_question_is_open_is_no_refusal() -> None:
    layout = table(CPU)
    with serving(Plc()) as server, FaultProxy(server.address) as proxy:
        options = S7Options(host="127.0.0.1", port=proxy.address.port, timeout=2000)
        connector = S7Connector.for_layout(layout)(options, layout)
        with contextlib.closing(connector):
            for _ in range(4):
                connector.connect()
                proxy.edit(lambda _: None)  # from now on no answer comes
                connector.submit()
                proxy.cut()
                with pytest.raises(ConnectorError):
                    connector.collect(time.monotonic_ns() + 10**10)
                proxy.pass_all()
            connector.connect()
            for _ in range(100):
                raw = connector.read()
    assert set(codes(layout, raw)) == {GOOD}


def test_stop_and_the_clock_are_seen_a_second_later(monkeypatch: pytest.MonkeyPatch) -> None:
    layout = table(CPU)
    with serving(Plc()) as server, connected(layout, server.address.port) as connector:
        first = [values(layout, connector.read()) for _ in range(100)][-1]
        server.cpu_state = snap7.server.CPUState.STOP
        monkeypatch.setattr("shmio.connectors.s7.session.time.monotonic_ns", later(1_000_000_000))
        second = [values(layout, connector.read()) for _ in range(100)][-1]
        assert "STOP" in connector.doubt
    assert (second["state"], second["number"], second["runs"]) == ("STOP", 4, False)
    assert str(second["clock/text"]) > str(first["clock/text"])


def test_values_of_the_cpu_cannot_be_written() -> None:
    layout = table(CPU)
    with serving(Plc()) as server, connected(layout, server.address.port) as connector:
        (refusal,) = write(connector, layout, "state", "RUN")
        assert refusal == "values of the CPU can only be read"


@pytest.mark.parametrize(
    ("tag", "reason"),
    [
        (
            {"type": "INT", "address": "cpu.stat"},
            r"address: unknown value 'cpu\.stat' of the CPU; did you mean 'cpu.state'",
        ),
        ({"type": "REAL", "address": "cpu.state"}, r"type: .*STRING\[9\] or longer, not REAL"),
        ({"type": "STRING[8]", "address": "cpu.state"}, r"type: .*STRING\[9\]"),
        ({"type": "INT", "address": "cpu.clock"}, "type: .*DATE_AND_TIME, DTL, LDT"),
        ({"type": "DTL", "address": "cpu.order_code"}, r"type: .* must be STRING\[20\]"),
        ({"type": "ARRAY[1..2] OF INT", "address": "cpu.state"}, "type: .*single value"),
        ({"type": "INT", "address": "cpu.state", "scale": 2}, "scale: .*single value"),
        ({"type": "BOOL", "address": "cpu.state", "writable": True}, "writable: .*only be read"),
    ],
)
def test_a_wrong_register_is_a_fault_of_the_configuration(tag: dict[str, object], reason: str) -> None:
    layout = table({"y": {"type": "INT", "address": "%MW0"}, "x": tag})
    with pytest.raises(ConfigError, match=f"layout: x: {reason}"):
        S7Connector.for_layout(layout)(S7Options(host="127.0.0.1"), layout)


def test_a_table_of_nothing_else_is_a_fault_of_the_configuration() -> None:
    layout = table({"x": CPU["state"]})
    with pytest.raises(ConfigError, match="add a register with an address such as %MB0"):
        S7Connector.for_layout(layout)(S7Options(host="127.0.0.1"), layout)


# -- answers -----------------------------------------------------------------------------------------------------------


def test_requests() -> None:
    """The requests equal those of python-snap7, except for the reference."""
    wanted = "03000021 02f080 32 07 0000 0102 0008 0008 00 01 12 04 11 44 01 00 ff 09 0004 001c 0000"
    assert userdata.request(0x0102, userdata.READ_SZL, userdata.szl_data(0x1C)) == bytes.fromhex(wanted)
    wanted = "0300001d 02f080 32 07 0000 0102 0008 0004 00 01 12 04 11 47 01 00 0a 00 0000"
    assert userdata.request(0x0102, userdata.READ_CLOCK) == bytes.fromhex(wanted)
    wanted = "03000021 02f080 32 07 0000 0003 000c 0004 00 01 12 08 12 44 01 05 0000 0000 0a 00 0000"
    assert userdata.next_request(3, userdata.READ_SZL, 5) == bytes.fromhex(wanted)


@pytest.mark.parametrize(
    ("digits", "wanted"),
    [
        ("00 19 24 02 29 12 34 56 78 95", dt.datetime(2024, 2, 29, 12, 34, 56, 789_000)),
        ("00 19 16 02 08 14 51 37 91 62", dt.datetime(2016, 2, 8, 14, 51, 37, 916_000)),  # of a real CPU
        ("00 20 89 12 31 23 59 59 99 97", dt.datetime(2089, 12, 31, 23, 59, 59, 999_000)),
        ("00 19 90 01 01 00 00 00 00 02", dt.datetime(1990, 1, 1)),
        ("00 19 23 02 29 12 34 56 78 95", None),
        ("00 19 2a 02 28 12 34 56 78 95", None),
        ("00 19 24 02 28 12 34 56 78", None),
        ("", None),
    ],
)
def test_clock(digits: str, wanted: dt.datetime | None) -> None:
    assert parse_clock(bytes.fromhex(digits)) == wanted


def test_records_that_are_cut_off_are_left_out() -> None:
    assert szl_records(bytes.fromhex("0011 0000 0002 0003 aaaa bbbb cc"), 0x11) == [b"\xaa\xaa", b"\xbb\xbb"]
    assert szl_records(bytes.fromhex("0011 0000 0000 ffff aaaa"), 0x11) == []
    assert szl_records(bytes.fromhex("0011 0000 ffff ffff aaaa"), 0x11) == []
    with pytest.raises(ConnectorError, match="0x001C, but to 0x0011"):
        szl_records(bytes.fromhex("0011 0000 0002 0000"), 0x1C)


def test_an_answer_in_endless_parts_is_refused() -> None:
    """The server always says that another part follows."""

    class Endless(S7Server):
        asked = 0

        def _process_in_parts(self, request: bytes, *others: Any) -> bytes:
            if request[1] != 7 or request[15] & 15 != 4 or request[-4:-2] == b"\4\x24":
                return super()._process_in_parts(request, *others)
            self.asked += 1
            parameters = bytes.fromhex("000112 08 12") + bytes((0x80 | request[15] & 15, 1, 7)) + b"\0\1\0\0"
            head = struct.pack(">BBHHHH", 0x32, 7, 0, int.from_bytes(request[4:6], "big"), 12, 8)
            return head + parameters + b"\xff\x09\0\4" + bytes(4)

    tags = {"int": CPU["int"], "code": CPU["code"]}
    with serving(Plc(), Endless) as server:
        found, statuses = settled(tags, server.address.port)
        assert isinstance(server, Endless)
        assert server.asked == MAX_PARTS
    assert (found["int"], statuses) == (-2, {"int": GOOD, "code": BAD_NOT_SUPPORTED})


ANSWER = bytes.fromhex("00 01 12 08 12 84 01 00 00 00 0000"), bytes.fromhex("ff 09 0004 00110000")


@given(frames.answers(7, *ANSWER) | frames.answers(3, b"", ANSWER[1]) | st.binary(min_size=7, max_size=80))
def test_noise_gives_an_answer_or_a_connector_error(noise: bytes) -> None:
    for service in (userdata.READ_SZL, userdata.READ_CLOCK, userdata.BLOCK_INFO):
        with contextlib.suppress(ConnectorError):
            assert len(userdata.parse_answer(memoryview(noise), service).data) <= len(noise)
    with contextlib.suppress(ConnectorError):
        assert sum(map(len, szl_records(noise, 0x11))) <= len(noise)
    with contextlib.suppress(ConnectorError):
        userdata.parse_block(noise, 1)
    parse_clock(noise)
