"""A reload that changes the registers of an emulator and of its source: both keep their processes and connections."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from shmio.testing.cell import Cell, until

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "pumps"
connector = "KIND"
layout = "pump.toml"
period_ms = 20
KEYS
[[emulator]]
name = "plc"
kind = "KIND"
listen = "{plc}"
[grpc]
listen = ["{grpc}"]
"""
KEYS = {
    "s7": 'host = "127.0.0.1"\nport = {plc.port}',
    "modbus": 'host = "127.0.0.1"\nport = {plc.port}',
    "opcua": 'url = "opc.tcp://127.0.0.1:{plc.port}"',
}
ADDRESSES = {
    "s7": ("DB5.DBW0", "DB5.DBW600", "%MW4"),
    "modbus": ("holding 1", "holding 600", "unit 2 holding 4"),
    "opcua": ("ns=2;s=a", "ns=2;s=b", "ns=3;s=c"),
}


@pytest.mark.parametrize("kind", KEYS)
def test_registers_come_and_go_and_nothing_connects_again(kind: str, make_cell: Callable[..., Cell]) -> None:
    pytest.importorskip({"s7": "snap7", "modbus": "pymodbus", "opcua": "asyncua"}[kind])
    cell = make_cell(config=CONFIG.replace("KEYS", KEYS[kind]).replace("KIND", kind))
    first, second, third = (
        f'"{name}" = {{ type = "INT", address = "{address}", initial = {at}, writable = true }}'
        for at, (name, address) in enumerate(zip("abc", ADDRESSES[kind], strict=True), 1)
    )

    def table(*rows: str) -> None:
        (cell.folder / "pump.toml").write_text("\n".join(["[registers]", *rows]))

    def found() -> dict[str, object]:
        shown = json.loads(cell.output("shmio", "get", "--json", "pumps"))
        return {path: one["value"] for path, one in shown.items() if one["quality"] == "good"}

    table(first)
    cell.up()
    until(lambda: found() == {"pumps/a": 1}, "the first register")
    cell.output("shmio", "set", "pumps/a", "77")
    before = {name: one["pid"] for name, one in cell.processes().items()}
    table(third, first, second)
    assert "would keep the connection of plc: layouts has changed" in cell.supervisor("reload", "--dry-run").stdout
    for rows, values in (
        ((third, first, second), {"pumps/c": 3, "pumps/a": 77, "pumps/b": 2}),
        ((first,), {"pumps/a": 77}),
    ):
        table(*rows)
        done = cell.supervisor("reload")
        assert (done.returncode, done.stderr) == (0, "")
        assert sorted(done.stdout.splitlines())[:2] == [
            "plc: changed, and keeps its clients", "pumps: changed, and keeps its connection",
        ]  # fmt: skip
        until(lambda: found() == values, "the new registers")  # noqa: B023
    assert {name: one["pid"] for name, one in cell.processes().items()} == before
