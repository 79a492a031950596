from __future__ import annotations

import msgspec
import pytest

from shmio.connectors.s7 import S7Options

PRINTED = {
    "model": "S7_1500",
    "host": "10.76.0.12",
    "port": "102",
    "rack": "0",
    "slot": "1",
    "timeout": "5000",
    "packetSize": "96",
    "dbNumber": "201",
}


def test_reads_the_printed_properties() -> None:
    options = msgspec.convert(PRINTED, S7Options, strict=False)
    assert options == S7Options(
        model="S7_1500", host="10.76.0.12", port=102, rack=0, slot=1, timeout=5000, packetSize=96, dbNumber=201
    )
    assert options.peer == "10.76.0.12:102"


@pytest.mark.parametrize(("model", "slot"), [(None, 1), ("S7_1500", 1), ("S7_1200", 1), ("S7-300", 2), ("s7_400", 3)])
def test_slot_follows_the_model_unless_given(model: str | None, slot: int) -> None:
    assert S7Options(host="plc", model=model).cpu_slot == slot
    assert S7Options(host="plc", model=model, slot=7).cpu_slot == 7


@pytest.mark.parametrize(
    "wrong",
    [
        {"port": 0},
        {"port": 65536},
        {"rack": 8},
        {"slot": 32},
        {"timeout": 0},
        {"timeout": "soon"},
        {"packetSize": 0},
        {"dbNumber": 0},
        {"maxJobs": 0},
        {"host": ""},
        {"packetsize": 96},
        {"host": "127.0.0.1:102"},
        {"host": "plc:102"},
        {"host": "s7://plc"},
        {"host": "[::1]"},
        {"host": "the plc"},
        {"host": "plc..example"},
        {"host": f"{'x' * 64}.example"},
        {"model": "S7_2000"},
        {"model": "LOGO"},
        {"model": ""},
    ],
)
def test_invalid_options_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"host": "plc", **wrong}, S7Options, strict=False)


@pytest.mark.parametrize("host", ["plc", "plc-7.cell.example", "10.76.0.12", "::1", "fe80::1%eth0", "werk_plc"])
def test_a_host_is_a_name_or_an_address(host: str) -> None:
    assert S7Options(host=host).host == host


def test_peer_has_brackets_around_ipv6() -> None:
    assert S7Options(host="::1").peer == "[::1]:102"
