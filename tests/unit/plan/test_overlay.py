"""Names over a data block in a configuration: each connector that takes a data block takes them."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.errors import ConfigError, LayoutError
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.plan.prepare import prepare
from shmio.segment.model_channel import model_ports
from shmio.simulation import Input, Model, ModelRunner, Output

BLOCK = """DATA_BLOCK DB7 { S7_Optimized_Access := 'FALSE' } STRUCT
  Inputs : Array[0..9] of Byte; Level : Real; END_STRUCT; BEGIN END_DATA_BLOCK"""
NAMES = """[registers]
Closed = "Inputs/8.%X0"
"door/Speed" = { address = "Inputs/2", type = "REAL", writable = true }
"""
BEGIN = '[instance]\nname = "names"\n'
SOURCE = '[[source]]\nname = "cell"\nlayout = "cell.db"\ntags = "names.toml"\nconnector = '
GRPC = '[grpc]\nlisten = ["127.0.0.1:0"]\n'
EMULATOR = '[[emulator]]\nname = "plc"\nkind = "s7"\nlisten = "127.0.0.1:1102"\n'
CONNECTORS = {
    "s7": 'host = "127.0.0.1"\nport = 1102\ntimeout = 500\n' + EMULATOR,
    "opcua": 'url = "opc.tcp://127.0.0.1:4840"\nnodes = "siemens"\n',
    "memory": "",
    "remote": f'outputs = ["**"]\n{GRPC}',
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "cell.db").write_text(BLOCK)
    (tmp_path / "names.toml").write_text(NAMES)
    return tmp_path


@pytest.mark.parametrize("connector", CONNECTORS)
def test_each_connector_that_takes_a_block_takes_names_over_it(folder: Path, connector: str) -> None:
    file = folder / "supervisor.toml"
    file.write_text(f'{BEGIN}{SOURCE}"{connector}"\n{CONNECTORS[connector]}')
    found = prepare(file)
    (block,) = found.plan.blocks
    assert [register.path for register in block.layout.registers] == ["Inputs", "Level", "Closed", "door/Speed"]
    assert (block.layout.status_offset is None) == (connector != "opcua")
    assert block.attributes.writable == ("door/Speed",)
    assert found.plan.warnings == ()
    for ((layout, _),) in found.emulated.values():
        assert [register.path for register in layout.registers] == ["Inputs", "Level"]


def test_faults_of_a_table_have_its_lines(folder: Path) -> None:
    (folder / "names.toml").write_text('[registers]\nClosed = "Inputs/88.%X0"\n')
    file = folder / "supervisor.toml"
    file.write_text(f'{BEGIN}{SOURCE}"memory"\n')
    with pytest.raises(LayoutError, match=r"names\.toml:2:1: error: Closed: Inputs: index \[88\] is outside"):
        prepare(file)


def test_a_program_elsewhere_computes_the_registers_of_the_block(folder: Path) -> None:
    file = folder / "supervisor.toml"
    file.write_text(f'{BEGIN}{SOURCE}"memory"\n')
    layout = prepare(file).layouts["cell"]
    ports = model_ports(layout, ["**"], [])
    assert [register.path for register in ports.outputs] == ["Inputs", "Level"]
    with pytest.raises(ConfigError, match="only whole registers"):
        model_ports(layout, ["Closed"], [])


def test_a_model_may_compute_names(folder: Path) -> None:
    class Door(Model):
        speed = Input("REAL", path="door/Speed")
        closed = Output("BOOL", path="Closed")

        def step(self, time_s: float, dt_s: float) -> None:
            self.closed = self.speed == 0

    file = folder / "supervisor.toml"
    file.write_text(f'{BEGIN}{SOURCE}"memory"\n')
    layout = prepare(file).layouts["cell"]
    image = ModelRunner(Door, layout).step(1, 1)
    assert codec(find(layout, "Inputs/8")).decode(image) == 1
